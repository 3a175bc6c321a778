"""Controllers of the manipulator: PI, PDP and PDPC (the PD one is in `lpvid.mechanics`)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from lpvid.mechanics import SampledController


def _floats(value: ArrayLike) -> Array:
    return jnp.asarray(value, float)


class ProportionalIntegral(SampledController):
    """u(k) = K_P e(k) + K_I Δt Σ_{j≤k} e(j), with e = R − y1 the error of the first output.

    Attributes:
        proportional: K_P, V/V.
        integral: K_I, V/(V·s).
        dt: sample time Δt, s; static.

    Source: 002, section 4.1 and figure 4-1.

    Example:
        >>> pi = ProportionalIntegral(2.0, 10.0, dt=0.1)
        >>> pi.step(pi.initial(), jnp.ones(1), jnp.zeros(4))[1]
        Array([3.], dtype=float64)
    """

    proportional: Float[Array, ""] = eqx.field(converter=_floats)
    integral: Float[Array, ""] = eqx.field(converter=_floats)
    dt: float = eqx.field(static=True, kw_only=True)

    def __check_init__(self):
        if not self.dt > 0.0:
            raise ValueError(f"dt={self.dt} must be positive: give the sample time in seconds.")

    def initial(self) -> Float[Array, "1"]:
        """The error's integral: nothing yet."""
        return jnp.zeros(1)

    def step(
        self, state: Float[Array, "1"], reference: Float[Array, "1"], y: Float[Array, " ny"]
    ) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """Integral with this sample's error, and the command."""
        error = reference - y[:1]
        state = state + self.dt * error
        return state, self.proportional * error + self.integral * state


class PDP(SampledController):
    """u = K_P (R − y1) − K_d y4 − K_sg y3: position, speed and middle strain fed back.

    y1 is the hub angle, y3 the middle strain gauge, y4 the tachometer.

    Attributes:
        proportional: K_P, V/V.
        derivative: K_d, V/V.
        strain: K_sg, V/V.

    Source: 002, section 4.2, equation 4-7 and figure 4-7.

    Example:
        >>> outputs = jnp.array([1.0, 0.0, 2.0, 0.5])
        >>> PDP(0.5, 3.3, 0.07).step(None, jnp.array([3.0]), outputs)[1].round(3)
        Array([-0.79], dtype=float64)
    """

    proportional: Float[Array, ""] = eqx.field(converter=_floats)
    derivative: Float[Array, ""] = eqx.field(converter=_floats)
    strain: Float[Array, ""] = eqx.field(converter=_floats)

    def initial(self) -> None:
        """Nothing to remember."""
        return None

    def step(
        self, state: None, reference: Float[Array, "1"], y: Float[Array, "4"]
    ) -> tuple[None, Float[Array, "1"]]:
        """The control effort."""
        effort = self.proportional * (reference - y[:1])
        return state, effort - self.derivative * y[3:4] - self.strain * y[2:3]


class PDPC(SampledController):
    """PDP with Coulomb compensation: u = u_e + u_c, u_e the effort of the PDP controller.

    u_c = ±c by the sign of u_e (+c at zero) while |R − y1| ≥ band or |y4| ≥ band, else 0; or
    always, with `conditional=False`.

    Attributes:
        effort: the `PDP` controller.
        compensation: c, V (002: 0.7).
        band: of position error and speed, V (002: 0.05).
        conditional: whether the compensation ends at rest near the set-point; static.

    Source: 002, section 4.3, equations 4-6 to 4-8.

    Example:
        >>> outputs = jnp.array([2.96, 0.0, 0.0, 0.0])
        >>> for conditional in (True, False):
        ...     pdpc = PDPC(PDP(0.5, 3.3, 0.07), conditional=conditional)
        ...     print(pdpc.step(None, jnp.array([3.0]), outputs)[1].round(3))
        [0.02]
        [0.72]
    """

    effort: PDP
    compensation: Float[Array, ""] = eqx.field(converter=_floats, default=0.7)
    band: Float[Array, ""] = eqx.field(converter=_floats, default=0.05)
    conditional: bool = eqx.field(static=True, default=True)

    def initial(self) -> None:
        """Nothing to remember."""
        return None

    def step(
        self, state: None, reference: Float[Array, "1"], y: Float[Array, "4"]
    ) -> tuple[None, Float[Array, "1"]]:
        """Effort and compensation."""
        state, effort = self.effort.step(state, reference, y)
        added = jnp.where(effort >= 0.0, self.compensation, -self.compensation)
        if self.conditional:
            away = jnp.abs(reference - y[:1]) >= self.band
            moving = jnp.abs(y[3:4]) >= self.band
            added = jnp.where(away | moving, added, 0.0)
        return state, effort + added
