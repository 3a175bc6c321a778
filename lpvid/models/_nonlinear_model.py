"""Nonlinear models in continuous time, sampled with the input held."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.models._runge_kutta import runge_kutta_step
from lpvid.models._state_space import Numbers


class NonlinearModel(eqx.Module):
    """ẋ = f(plant, x, u), y = h(plant, x, u): any plant, to simulate, predict and refine.

    `refine` estimates the plant's inexact arrays, by output error or by innovation. Arrays that
    `dynamics` or `output` hold, where they are modules, are constants: what is to be estimated
    belongs in `plant`, such as `{"arm": arm, "sensor": sensor}`. The states that it simulates,
    estimates and corrects are the plant's less those at `rest`.

    Attributes:
        plant: any pytree, such as an arm of `lpvid.mechanics` or a dictionary of numbers.
        dynamics: (plant, x, u) → ẋ, smooth in all three.
        output: (plant, x, u) → y at the same sample, (ny,): of one output `x[:1]`, not `x[0]`.
        rest: the plant's state where the model's is zero. A search begins here: h must be smooth.
        substeps: Runge–Kutta steps a sample; |λ| dt / substeps < 2.61 for the fastest pole λ.

    Raises:
        ValueError: `rest` holds no finite numbers, or `substeps` is below one.

    Example:
        >>> from lpvid.models import NonlinearModel
        >>> pendulum = NonlinearModel(
        ...     {"stiffness": 9.0, "damping": 0.5},
        ...     lambda p, x, u: jnp.stack(
        ...         [x[1], u[0] - p["stiffness"] * jnp.sin(x[0]) - p["damping"] * x[1]]
        ...     ),
        ...     lambda p, x, u: x[:1],
        ...     rest=[0.0, 0.0],
        ... )
        >>> pendulum.simulate(u=jnp.ones((3, 1)), dt=0.1)[:, 0].round(4).tolist()
        [0.0, 0.0049, 0.0188]
    """

    plant: Any
    dynamics: Callable[[Any, Array, Array], Array]
    output: Callable[[Any, Array, Array], Array]
    rest: tuple[float, ...] = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __init__(
        self,
        plant: Any,
        dynamics: Callable[[Any, Array, Array], Array],
        output: Callable[[Any, Array, Array], Array],
        *,
        rest: ArrayLike | Sequence[float],
        substeps: int = 1,
    ):
        # Plain numbers become arrays: they are parameters too.
        self.plant = jax.tree.map(
            lambda leaf: jnp.asarray(leaf, float) if _is_number(leaf) else leaf, plant
        )
        self.dynamics = dynamics
        self.output = output
        self.rest = tuple(float(state) for state in np.asarray(rest, float).reshape(-1))
        self.substeps = int(substeps)
        if not self.rest or not np.all(np.isfinite(self.rest)):
            raise ValueError(
                f"rest={self.rest}: give the plant's state about which it moves, one finite number "
                "a state."
            )
        if self.substeps < 1:
            raise ValueError(f"substeps={substeps}: at least 1 step a sample is needed.")

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.rest)

    def step(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"], *, dt: ArrayLike
    ) -> tuple[Float[Array, " nx"], Float[Array, " ny"]]:
        """State one sample later, and the output at this one.

        Args:
            x: state, counted from `rest`.
            u: input, held.
            dt: sample time, s.

        Raises:
            ValueError: `dynamics` or `output` return another shape than they have to.

        Example:
            >>> from lpvid.models import NonlinearModel
            >>> lag = NonlinearModel(
            ...     {"rate": 2.0}, lambda p, x, u: u - p["rate"] * x, lambda p, x, u: x, rest=[0.0]
            ... )
            >>> lag.step(jnp.ones(1), jnp.zeros(1), dt=0.1)[0]
            Array([0.81873333], dtype=float64)
        """
        rest = jnp.asarray(self.rest)
        begin = rest + x
        length = jnp.asarray(dt, float) / self.substeps

        def substep(state, _):
            return runge_kutta_step(self._rate, state, u, length), None

        if self.substeps == 1:
            end = substep(begin, None)[0]
        else:
            end = jax.lax.scan(substep, begin, length=self.substeps)[0]
        y = jnp.asarray(self.output(self.plant, begin, u))
        if y.ndim != 1:
            raise ValueError(
                f"output: it returns an array of shape {y.shape}; give all outputs in one of shape "
                "(ny,), a single one as x[:1] or jnp.stack([...])."
            )
        return end - rest, y

    def _rate(self, x: Float[Array, " nx"], u: Float[Array, " nu"]) -> Float[Array, " nx"]:
        rate = jnp.asarray(self.dynamics(self.plant, x, u))
        if rate.shape != x.shape:
            raise ValueError(
                f"dynamics: it returns an array of shape {rate.shape}; ẋ of shape {x.shape} is "
                "needed, one value for each state in rest."
            )
        return rate

    def simulate(
        self, *, u: Numbers, dt: float, x0: Numbers | None = None
    ) -> Float[Array, "time ny"]:
        """Response to an input held over each sample.

        Works under `jit`, `vmap` and `grad`.

        Args:
            u: input (time, nu), or (time,) for one input.
            dt: sample time, s.
            x0: first state (nx,), counted from `rest`; zero by default.

        Returns:
            Output (time, ny).

        Raises:
            ValueError: shapes do not fit, or the sample time is not positive.
        """
        u = jnp.asarray(u, float)
        u = u[:, None] if u.ndim == 1 else u
        if u.ndim != 2:
            raise ValueError(f"u has shape {u.shape}; give (time, nu), time first.")
        if not isinstance(dt, Tracer) and not (float(dt) > 0.0 and math.isfinite(dt)):
            raise ValueError(f"dt is {dt}; the sample time must be a positive number of seconds.")
        start = jnp.zeros(self.n_states) if x0 is None else jnp.asarray(x0, float)
        if start.shape != (self.n_states,):
            raise ValueError(f"x0: {self.n_states} states are needed, got shape {start.shape}.")
        return _simulate(self, u, jnp.asarray(dt, float), start)


@eqx.filter_jit
def _simulate(model: NonlinearModel, u: Array, dt: Array, x0: Array) -> Float[Array, "time ny"]:
    return jax.lax.scan(lambda x, now: model.step(x, now, dt=dt), x0, u)[1]


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, int | float) and not isinstance(leaf, bool)
