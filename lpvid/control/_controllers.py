"""Controllers of the manipulator: PI, PDP and PDPC (the PD one is in `lpvid.mechanics`)."""

from typing import Literal, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.control._anti_windup import check_limit, limited, optional_floats
from lpvid.mechanics import Quantisation, SampledController

CompensationRule: TypeAlias = Literal["always", "conditional", "precise"]


def _floats(value: ArrayLike) -> Array:
    return jnp.asarray(value, float)


class ProportionalIntegral(SampledController):
    """u(k) = K_P e(k) + K_I Δt Σ_{j≤k} e(j), with e = R − y1 the error of the first output.

    Attributes:
        proportional: K_P, V/V.
        integral: K_I, V/(V·s).
        limit: of the command, V: it is cut to ±limit, and the error is not summed while the cut
            command would be pushed further beyond it (clamping). None for neither.
        dt: sample time Δt, s; static.

    Source: 002, section 4.1 and figure 4-1; Åström & Hägglund, Advanced PID Control (2006),
    section 3.5, for the clamping.

    Example:
        >>> pi = ProportionalIntegral(2.0, 10.0, dt=0.1)
        >>> pi.step(pi.initial(), jnp.ones(1), jnp.zeros(4))[1]
        Array([3.], dtype=float64)
    """

    proportional: Float[Array, ""] = eqx.field(converter=_floats)
    integral: Float[Array, ""] = eqx.field(converter=_floats)
    limit: Float[Array, ""] | None = eqx.field(
        converter=optional_floats, default=None, kw_only=True
    )
    dt: float = eqx.field(static=True, kw_only=True)

    def __check_init__(self):
        if not self.dt > 0.0:
            raise ValueError(f"dt={self.dt} must be positive: give the sample time in seconds.")
        check_limit(self.limit)

    def initial(self) -> Float[Array, "1"]:
        """The error's integral: nothing yet."""
        return jnp.zeros(1)

    def step(
        self, state: Float[Array, "1"], reference: Float[Array, "1"], y: Float[Array, " ny"]
    ) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
        """Integral with this sample's error, and the command."""
        error = reference - y[:1]

        def command(total):
            return self.proportional * error + self.integral * total

        return limited(command, state, self.dt * error, self.limit)


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

    Rules for u_c:

    - conditional: ±c by the sign of u_e (+c at zero) while |R − y1| ≥ band or |y4| ≥ band, else 0;
    - always: ±c by the sign of u_e, without the condition;
    - precise: as conditional, and where that lets go ±c by the sign of the position error itself,
      low-passed, from where it reaches `resolution` until it is back within half of it.

    Near the set-point the sign of u_e is that of the speed's and the strain's noise, and a
    compensation that flickers pushes less than friction holds; the band lets go at ten quantisation
    steps. The precise rule ends within one. Its c is the friction as identified: with less of it an
    error of up to (friction − c) / K_P remains, with more of it small turns back.

    Composes with jit, vmap and grad; the gradient is that between switches, and zero in `band`,
    `resolution` and `averaging`.

    Attributes:
        effort: the `PDP` controller.
        compensation: c, V (002: 0.7).
        band: of position error and speed, V (002: 0.05).
        rule: one of the three; static.
        resolution: of the position sensor, V; of the precise rule alone.
        averaging: time constant of the low-pass, in samples; of the precise rule alone. A noise of
            standard deviation σ becomes one of σ / √(2 averaging).

    Source: 002, section 4.3, equations 4-6 to 4-8; the precise rule is ours.

    Example:
        >>> outputs = jnp.array([2.96, 0.0, 0.0, 0.0])
        >>> for rule in ("conditional", "always"):
        ...     pdpc = PDPC(PDP(0.5, 3.3, 0.07), rule=rule)
        ...     print(pdpc.step(pdpc.initial(), jnp.array([3.0]), outputs)[1].round(3))
        [0.02]
        [0.72]
    """

    effort: PDP
    compensation: Float[Array, ""] = eqx.field(converter=_floats, default=0.7)
    band: Float[Array, ""] = eqx.field(converter=_floats, default=0.05)
    rule: CompensationRule = eqx.field(static=True, default="conditional")
    resolution: Float[Array, ""] = eqx.field(converter=_floats, default=Quantisation().step)
    averaging: Float[Array, ""] = eqx.field(converter=_floats, default=15.0)

    def __check_init__(self):
        if self.rule not in _RULES:
            raise ValueError(f"rule={self.rule!r} is unknown: give one of {', '.join(_RULES)}.")
        if not isinstance(self.averaging, Tracer) and not jnp.all(self.averaging >= 1.0):
            raise ValueError(f"averaging={self.averaging}: give at least one sample.")

    def initial(self) -> tuple[Float[Array, "1"], Float[Array, "1"]] | None:
        """Low-passed error and direction of the precise rule; nothing to remember else."""
        return (jnp.zeros(1), jnp.zeros(1)) if self.rule == "precise" else None

    def step(
        self,
        state: tuple[Float[Array, "1"], Float[Array, "1"]] | None,
        reference: Float[Array, "1"],
        y: Float[Array, "4"],
    ) -> tuple[tuple[Float[Array, "1"], Float[Array, "1"]] | None, Float[Array, "1"]]:
        """Effort and compensation."""
        _, effort = self.effort.step(None, reference, y)
        side = jnp.where(effort >= 0.0, 1.0, -1.0)
        if self.rule == "always":
            return state, effort + self.compensation * side
        error = reference - y[:1]
        away = (jnp.abs(error) >= self.band) | (jnp.abs(y[3:4]) >= self.band)
        if state is None:
            return state, effort + self.compensation * jnp.where(away, side, 0.0)
        mean, direction = state
        mean = mean + (error - mean) / self.averaging
        kept = jnp.where(mean * direction > 0.5 * self.resolution, direction, 0.0)
        direction = jnp.where(jnp.abs(mean) >= self.resolution, jnp.sign(mean), kept)
        added = self.compensation * jnp.where(away, side, direction)
        return (mean, direction), effort + added


_RULES = ("always", "conditional", "precise")
