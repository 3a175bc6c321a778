"""Margins of a loop: gain, phase, delay and modulus, with the frequencies at which they are met."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Complex, Float

from lpvid.models import StateSpace

# Frequencies that bracket the crossovers: evenly in the logarithm, and around every pole.
_POINTS = 400
_AROUND = np.linspace(-4.0, 4.0, 10)
# Beyond the slowest and the fastest pole by this factor.
_REACH = 100.0
_CROSSOVERS = 8
_BISECTIONS = 24
# A gain at frequency zero beyond this is an integrator's, up to rounding.
_INFINITE = 1e8
_GOLDEN = 40


class Margins(eqx.Module):
    """Margins of a loop L under negative feedback, 1/(1 + L).

    Infinite where nothing is crossed, with a frequency that is not a number. They mean what their
    names say where `stable` holds.

    Attributes:
        gain_margin: factor on L, of those that bring the closed loop to the edge of stability the
            one nearest to 1 in the logarithm.
        phase_margin: angle between L and −1 where |L| = 1, degrees, the smallest in size.
        delay_margin: least delay that brings the closed loop to the edge of stability, s.
        modulus_margin: least distance of L from −1, the inverse of the sensitivity's peak.
        phase_crossover: frequency of the gain margin, rad/s.
        gain_crossover: frequency of the phase margin, rad/s.
        delay_crossover: frequency of the delay margin, rad/s.
        modulus_frequency: frequency of the modulus margin, rad/s.
        stable: whether the closed loop is.
    """

    gain_margin: Float[Array, "*batch"]
    phase_margin: Float[Array, "*batch"]
    delay_margin: Float[Array, "*batch"]
    modulus_margin: Float[Array, "*batch"]
    phase_crossover: Float[Array, "*batch"]
    gain_crossover: Float[Array, "*batch"]
    delay_crossover: Float[Array, "*batch"]
    modulus_frequency: Float[Array, "*batch"]
    stable: Bool[Array, "*batch"]

    @property
    def gain_margin_decibels(self) -> Float[Array, "*batch"]:
        """Gain margin, dB."""
        return 20.0 * jnp.log10(self.gain_margin)


def margins(loop: StateSpace) -> Margins:
    """Margins of a loop with one input and one output, continuous or discrete.

    Crossovers are bracketed on a grid that is dense around the poles of the loop and of the closed
    loop, and refined to rounding. Composes with jit, vmap and grad (through the implicit function
    theorem; a margin is the least of several smooth ones, and has the derivative of that one).

    Args:
        loop: L, for example from `loop_transfer`; leading batch axes give a batch of margins.

    Returns:
        `Margins`.

    Raises:
        ValueError: several inputs or outputs, or matrices that are not finite (outside `jit`).

    Source: Skogestad and Postlethwaite, Multivariable Feedback Control (Wiley 2005), section 2.4.

    Example:
        >>> loop = StateSpace([[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> margins(loop).phase_margin.round(3)
        Array(51.827, dtype=float64)
    """
    if loop.nu != 1 or loop.ny != 1:
        raise ValueError(
            f"loop has {loop.nu} inputs and {loop.ny} outputs: margins are those of one loop; "
            "take loop_transfer, or one entry of the transfer matrix."
        )
    matrices = (loop.A, loop.B, loop.C, loop.D)
    if not any(isinstance(m, Tracer) for m in matrices):
        if not all(np.all(np.isfinite(np.asarray(m))) for m in matrices):
            raise ValueError("loop has matrices that are not finite; check what it was built from.")
    return _margins(loop)


@eqx.filter_jit
def _margins(loop: StateSpace) -> Margins:
    single = _single
    for _ in loop.batch_shape:
        single = eqx.filter_vmap(single)
    return single(loop)


def _single(loop: StateSpace) -> Margins:
    fixed = lax.stop_gradient(loop)
    # 1/(1 + L) has the poles of A − B (1 + D)⁻¹ C.
    closed = jnp.linalg.eigvals(fixed.A - fixed.B @ fixed.C / (1.0 + fixed.D[0, 0]))
    stable = jnp.all(jnp.abs(closed) < 1.0 if loop.is_discrete else closed.real < 0.0)
    omega = _grid(jnp.concatenate([jnp.linalg.eigvals(fixed.A), closed]), loop.dt)
    response = _finite(_at(fixed, omega))

    crossing = _crossings(response.imag, response.real < 0.0, jnp.abs(_log_size(response)))
    phase = _refine(loop, omega, crossing, lambda value: value.imag)
    value = _finite(_at(loop, phase))
    flat = jnp.abs(value.imag) <= 1e-6 * jnp.abs(value)
    # At frequency zero, and at Nyquist in discrete time, L is real and nothing changes sign; an
    # integrator makes it infinite there.
    ends = jnp.asarray([0.0, np.pi / loop.dt] if loop.is_discrete else [0.0])
    at_ends = _finite(_at(fixed, ends))
    there = (at_ends.real < 0.0) & (jnp.abs(at_ends) < _INFINITE)
    # Elsewhere any frequency will do at which L has a derivative.
    ends = jnp.where(there, ends, omega[0])
    met = jnp.concatenate([flat & (value.real < 0.0) & crossing[1], there])
    phase = jnp.concatenate([phase, ends])
    value = jnp.concatenate([value, _finite(_at(loop, ends))])
    log_gain = -_log_size(value)
    gain_log, phase_crossover = _least(jnp.abs(log_gain), log_gain, phase, met)

    turned = jnp.abs(jnp.angle(-response))
    crossing = _crossings(_log_size(response), jnp.full(response.shape, True), turned)
    gain = _refine(loop, omega, crossing, _log_size)
    value = _finite(_at(loop, gain))
    met = (jnp.abs(_log_size(value)) <= 1e-6) & crossing[1]
    angle = jnp.angle(-value)
    phase_margin, gain_crossover = _least(jnp.abs(angle), angle, gain, met)
    # A delay turns L clockwise, by less than one turn.
    lag = jnp.where(angle < 0.0, angle + 2.0 * np.pi, angle) / gain
    delay_margin, delay_crossover = _least(lag, lag, gain, met)

    modulus, modulus_frequency = _modulus(loop, omega, response)
    return Margins(
        gain_margin=jnp.exp(gain_log),
        phase_margin=phase_margin * (180.0 / np.pi),
        delay_margin=delay_margin,
        modulus_margin=modulus,
        phase_crossover=phase_crossover,
        gain_crossover=gain_crossover,
        delay_crossover=delay_crossover,
        modulus_frequency=modulus_frequency,
        stable=stable,
    )


def _at(loop: StateSpace, omega: Float[Array, " point"]) -> Complex[Array, " point"]:
    return loop.frequency_response(omega)[:, 0, 0]


def _finite(response: Complex[Array, " point"]) -> Complex[Array, " point"]:
    # On a pole of the loop there is no response, and nothing is crossed.
    return jnp.where(jnp.isfinite(response), response, jnp.ones_like(response))


def _log_size(response: Complex[Array, " point"]) -> Float[Array, " point"]:
    square = response.real**2 + response.imag**2
    return 0.5 * jnp.log(jnp.maximum(square, 1e-300))


def _grid(poles: Complex[Array, " pole"], dt: float) -> Float[Array, " point"]:
    """Frequencies from far below the slowest pole to Nyquist, or far above the fastest."""
    if dt > 0.0:
        inside = jnp.abs(poles) > 1e-12
        poles = jnp.log(jnp.where(inside, poles, 1e-12)) / dt
    sizes = jnp.abs(poles)
    # Integrators say nothing about the frequencies of interest.
    moving = sizes > 1e-7 * jnp.max(sizes)
    lowest = jnp.min(jnp.where(moving, sizes, jnp.inf))
    lowest = jnp.where(jnp.isfinite(lowest) & (lowest > 0.0), lowest, 1.0)
    highest = np.pi / dt if dt > 0.0 else _REACH * jnp.maximum(jnp.max(sizes), lowest)
    low = jnp.minimum(lowest, highest) / _REACH
    share = jnp.linspace(0.0, 1.0, _POINTS)
    even = jnp.exp((1.0 - share) * jnp.log(low) + share * jnp.log(highest))
    width = jnp.maximum(jnp.abs(poles.real), 1e-6 * jnp.abs(poles.imag))
    # The other one of a pair lays its points between those of the first.
    shift = jnp.where(poles.imag < 0.0, 0.5 * (_AROUND[1] - _AROUND[0]), 0.0)
    around = width[:, None] * (jnp.asarray(_AROUND)[None] + shift[:, None])
    around = jnp.abs(poles.imag)[:, None] + around
    return jnp.sort(jnp.concatenate([even, jnp.clip(around.ravel(), low, highest)]))


def _crossings(value: Array, counts: Array, rank: Array) -> tuple[Array, Array]:
    """Cells of the grid in which `value` changes sign: those of lowest rank, and which are real."""
    changes = (value[1:] * value[:-1] < 0.0) & (counts[1:] | counts[:-1])
    order = jnp.where(changes, jnp.minimum(rank[1:], rank[:-1]), jnp.inf)
    cells = lax.top_k(-order, _CROSSOVERS)[1]
    return cells, changes[cells]


def _refine(
    loop: StateSpace,
    omega: Float[Array, " point"],
    crossing: tuple[Array, Array],
    function: Callable[[Array], Array],
) -> Float[Array, " crossover"]:
    """Zeros of a function of L in the cells, with their derivatives by a last Newton step."""
    fixed = lax.stop_gradient(loop)
    cells, _ = crossing
    low, high = omega[cells], omega[cells + 1]
    below = function(_finite(_at(fixed, low)))

    def halve(_, carry):
        low, high = carry
        middle = 0.5 * (low + high)
        same = function(_finite(_at(fixed, middle))) * below > 0.0
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    low, high = lax.fori_loop(0, _BISECTIONS, halve, (low, high))
    middle = 0.5 * (low + high)

    def newton(loop, at):
        def along(points):
            return function(_finite(_at(fixed, points)))

        _, slope = jax.jvp(along, (at,), (jnp.ones_like(at),))
        slope = lax.stop_gradient(jnp.where(slope == 0.0, jnp.inf, slope))
        step = function(_finite(_at(loop, at))) / slope
        # Beyond the bracket's size it would not be one towards this zero.
        near = jnp.abs(step) <= 10.0 * (high - low)
        return at - jnp.where(near, step, 0.0)

    middle = lax.stop_gradient(newton(fixed, middle))
    return newton(loop, middle)


def _least(rank: Array, value: Array, omega: Array, met: Array) -> tuple[Array, Array]:
    order = jnp.where(met, rank, jnp.inf)
    best = jnp.argmin(order)
    some = met[best]
    return jnp.where(some, value[best], jnp.inf), jnp.where(some, omega[best], jnp.nan)


def _modulus(
    loop: StateSpace, omega: Float[Array, " point"], response: Complex[Array, " point"]
) -> tuple[Array, Array]:
    """Least distance from −1; by the envelope theorem its frequency needs no derivative."""
    fixed = lax.stop_gradient(loop)
    best = jnp.argmin(jnp.abs(1.0 + response))
    low, high = omega[jnp.maximum(best - 1, 0)], omega[jnp.minimum(best + 1, omega.size - 1)]
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)

    def distance(loop, at):
        away = 1.0 + _finite(_at(loop, at[None]))[0]
        return jnp.sqrt(away.real**2 + away.imag**2)

    def narrow(_, carry):
        low, high = carry
        first, second = high - ratio * (high - low), low + ratio * (high - low)
        left = distance(fixed, first) < distance(fixed, second)
        return jnp.where(left, low, first), jnp.where(left, second, high)

    low, high = lax.fori_loop(0, _GOLDEN, narrow, (low, high))
    at = 0.5 * (low + high)
    found = distance(loop, at)
    if loop.is_discrete:
        return found, at
    # Far above all poles L is its feedthrough.
    end = jnp.abs(1.0 + loop.D[0, 0])
    return jnp.minimum(found, end), jnp.where(found <= end, at, jnp.inf)
