"""ILQR: state feedback from an observer, feed-forward and an integral (002, section 4.4)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.control._anti_windup import check_limit, limited, optional_floats
from lpvid.control._closed_loop import Numbers, check_no_feedthrough
from lpvid.control._riccati import kalman, lqr
from lpvid.mechanics import SampledController
from lpvid.models import StateSpace


def _floats(value: Numbers) -> Array:
    return jnp.asarray(value, float)


class ILQR(SampledController):
    """u = K_P R + K_I Δt Σ_{j≤k} (R − y1(j)) − K_C x̂, x̂⁺ = A x̂ + B u + L (y1 − C1 x̂).

    Only the first output is read. The observer knows the command within `limit`, not what another
    saturation or a delay make of it.

    Attributes:
        model: discrete-time, from the command to y1 alone.
        feedback: K_C (nx,).
        observer: L (nx,).
        feedforward: K_P.
        integral: K_I, V/(V·s).
        limit: of the command, V: it is cut to ±limit, and the error is not summed while the cut
            command would be pushed further beyond it (clamping). None for neither.

    Source: 002, section 4.4 and figure 4-13.

    Example:
        >>> drift = StateSpace([[1.0]], [[1.0]], [[1.0]], dt=0.1)
        >>> ilqr = ILQR(drift, feedback=[0.6], observer=[0.5], feedforward=0.6, integral=1.0)
        >>> ilqr.step(ilqr.initial(), jnp.ones(1), jnp.zeros(4))[1]
        Array([0.7], dtype=float64)
    """

    model: StateSpace
    feedback: Float[Array, "*batch nx"] = eqx.field(converter=_floats)
    observer: Float[Array, "*batch nx"] = eqx.field(converter=_floats)
    feedforward: Float[Array, "*batch"] = eqx.field(converter=_floats)
    integral: Float[Array, "*batch"] = eqx.field(converter=_floats)
    limit: Float[Array, "*batch"] | None = eqx.field(converter=optional_floats, default=None)

    def __check_init__(self):
        check_limit(self.limit)
        if not self.model.is_discrete or (self.model.nu, self.model.ny) != (1, 1):
            raise ValueError(
                f"model is {self.model!r}: a discrete-time one from the command to the first "
                "output is needed."
            )

    def initial(self) -> tuple[Float[Array, " nx"], Float[Array, "1"]]:
        """Observed states and the error's integral, from rest."""
        return jnp.zeros(self.model.nx), jnp.zeros(1)

    def step(
        self,
        state: tuple[Float[Array, " nx"], Float[Array, "1"]],
        reference: Float[Array, "1"],
        y: Float[Array, " ny"],
    ) -> tuple[tuple[Float[Array, " nx"], Float[Array, "1"]], Float[Array, "1"]]:
        """Next observed states, and the command."""
        x, total = state
        fed = self.feedforward * reference - self.feedback @ x
        change = self.model.dt * (reference - y[:1])
        total, command = limited(lambda t: fed + self.integral * t, total, change, self.limit)
        surprise = y[:1] - self.model.C @ x
        x = self.model.A @ x + self.model.B @ command + self.observer * surprise
        return (x, total), command


def design_ilqr(
    model: StateSpace,
    *,
    state_weight: Numbers,
    input_weight: Numbers,
    state_noise: Numbers,
    output_noise: Numbers,
    integral: Numbers = 0.0,
    limit: Numbers | None = None,
) -> ILQR:
    """ILQR from weights: K_C by `lqr`, L by `kalman` from the first output alone.

    K_P makes the first output follow the set-point at rest without the integral. Composes with
    jit, vmap and grad; a model with leading batch axes gives a batch of controllers.

    Args:
        model: discrete-time model of one input without feedthrough.
        state_weight: Q of the regulator (nx, nx), or its diagonal. Cᵀ W C weights the outputs.
        input_weight: R of the regulator.
        state_noise: Q of the observer (nx, nx), or its diagonal.
        output_noise: R of the observer, of the first output.
        integral: K_I, V/(V·s).
        limit: of the command, V, with clamping of the integral; none by default.

    Returns:
        `ILQR`.

    Raises:
        ValueError: a continuous-time model, several inputs, a feedthrough, weights as for `lqr`, a
            limit that is not positive.

    Source: 002, section 4.4.

    Example:
        >>> drift = StateSpace([[1.0]], [[1.0]], [[1.0]], dt=0.1)
        >>> ilqr = design_ilqr(
        ...     drift, state_weight=1.0, input_weight=1.0, state_noise=1.0, output_noise=1.0
        ... )
        >>> ilqr.feedforward.round(6)
        Array(0.618034, dtype=float64)
    """
    if not model.is_discrete:
        raise ValueError("model is in continuous time: discretise it at the controller's rate.")
    if model.nu != 1:
        raise ValueError(f"model has {model.nu} inputs: one is needed.")
    check_no_feedthrough(model)
    first = StateSpace(model.A, model.B, model.C[..., :1, :], dt=model.dt)
    K = lqr(model, state_weight, input_weight).gain
    L = kalman(first, state_noise, output_noise).gain
    closed = StateSpace(first.A - first.B @ K, first.B, first.C, dt=model.dt)
    follows = closed.dc_gain()[..., 0, 0]
    batch = jnp.broadcast_to(jnp.asarray(integral, float), follows.shape)
    if limit is not None:
        limit = jnp.broadcast_to(jnp.asarray(limit, float), follows.shape)
    return ILQR(first, K[..., 0, :], L[..., 0], 1.0 / follows, batch, limit)
