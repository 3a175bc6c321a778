"""The H-infinity norm of a linear system, with its gradient and its peak frequencies."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid._results import Status
from lpvid.analysis._eigensolvers import AbstractEigensolver, default_eigensolver
from lpvid.analysis._level_set import certify_by_hamiltonian, sweep_modal
from lpvid.analysis._modal import (
    Modal,
    modal_form,
    reduced_form,
    refine_peaks,
    response,
    rounding,
    squared_gain,
    trustworthy,
)
from lpvid.models import StateSpace


class HinfNorm(eqx.Module):
    """The largest gain of a system over all frequencies and where it is reached.

    Attributes:
        value: the norm, output unit over input unit.
        frequency: where it is reached, rad/s; zero and infinity included.
        status: `successful`; `l_infinity` for an unstable system (the peak of its frequency
            response); `infinite_norm` for a pole on the stability boundary; `max_steps` or
            `nonfinite`.
    """

    value: Float[Array, "*batch"]
    frequency: Float[Array, "*batch"]
    status: Status


def hinf_norm(
    system: StateSpace,
    *,
    tolerance: float = 1e-10,
    eigensolver: AbstractEigensolver | None = None,
) -> HinfNorm:
    """Largest singular value of the frequency response over all frequencies.

    The gain is raised to the local maxima near the poles' frequencies by Newton steps, then the
    level-set method proves that nothing is higher, or finds what is (S. Boyd and V. Balakrishnan,
    Syst. Control Lett. 15 (1990) 1-7; N. A. Bruinsma and M. Steinbuch, ibid. 14 (1990) 287-293).
    Discrete systems go through the bilinear map, which keeps the norm.

    The derivative of the value is that of the largest singular value at the peak (envelope
    theorem), forward and reverse: one element of the subdifferential where peaks or singular values
    tie, zero where the norm is infinite. First derivatives only; `frequency` has none. Works under
    `jit` and `vmap`. A batch costs least as leading axes of `system` or through `vmap`; a system
    for which the cheap certificate (an eigenproblem of size n) does not hold is then treated on its
    own by the Hamiltonian of size 2 n.

    Args:
        system: continuous (`dt = 0`) or discrete model with nx >= 1 states, with or without D, with
            any leading batch axes.
        tolerance: relative accuracy of the value, between 1e-13 and 1e-1. Values below the rounding
            errors of the response (a difference of equal systems) are accurate to those.
        eigensolver: `Lapack()`, for CPUs, or `SimultaneousIteration()`, for every device; by
            default the first where JAX's default device is a CPU, the second elsewhere.

    Returns:
        The norm in the unit of output over input, its frequency in rad/s and the status.

    Raises:
        ValueError: a tolerance outside its range, a system without states, or non-finite matrices
            (those are checked outside `jit` only; inside, the status says `nonfinite`).

    Example:
        >>> from lpvid.analysis import hinf_norm
        >>> from lpvid.models import StateSpace
        >>> system = StateSpace([[0.0, 1.0], [-1.0, -0.02]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> round(float(hinf_norm(system).value), 4)
        50.0025
    """
    if not 1e-13 <= tolerance <= 1e-1:
        raise ValueError(f"tolerance must lie between 1e-13 and 1e-1, got {tolerance}.")
    check_system(system)
    matrices = (system.A, system.B, system.C, system.D)
    batch = system.A.shape[:-2]
    flat = tuple(m.reshape(-1, *m.shape[-2:]) for m in matrices)
    solve = _norms if any(isinstance(m, Tracer) for m in matrices) else _norms_jitted
    eigensolver = default_eigensolver() if eigensolver is None else eigensolver
    value, omega, status = solve(flat, system.dt, tolerance, eigensolver)
    status = jax.tree.map(lambda code: code.reshape(batch), status)
    return HinfNorm(value.reshape(batch), omega.reshape(batch), status)


def check_system(system: StateSpace) -> None:
    """Refuse what has no frequency response: no states, non-finite matrices."""
    if system.A.shape[-1] == 0:
        raise ValueError("system has no states; its norm is the largest singular value of D.")
    for name in ("A", "B", "C", "D"):
        matrix = getattr(system, name)
        if not isinstance(matrix, Tracer) and not bool(jnp.all(jnp.isfinite(matrix))):
            raise ValueError(
                f"system.{name} holds NaN or infinity; look for a failed fit or an overflow in the "
                "parameters it was made from."
            )


def _norms(matrices, dt: float, tolerance: float, eigensolver: AbstractEigensolver):
    norm = partial(_norm, dt=dt, tolerance=tolerance, eigensolver=eigensolver)
    return jax.vmap(norm)(*matrices)


_norms_jitted = jax.jit(_norms, static_argnums=(1, 2, 3))


def _norm(A, B, C, D, *, dt: float, tolerance: float, eigensolver: AbstractEigensolver):
    """One system: peak frequency by the level sets, value and derivative from that frequency."""
    fixed = lax.stop_gradient((A, B, C, D))
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(m)) for m in fixed]))
    # A safe system in place of a broken one: NaN in LAPACK is undefined behaviour at best.
    eye = jnp.eye(A.shape[0])
    still = -eye if dt == 0.0 else jnp.zeros_like(eye)
    fixed = (jnp.where(finite, fixed[0], still), *(jnp.where(finite, m, 0.0) for m in fixed[1:]))
    continuous, unit = to_normalised_continuous(*fixed, dt=dt)
    form = modal_form(*continuous, eigensolver)
    stable, boundary = stability(form.poles, dt)
    boundary = boundary & finite
    usable = ~boundary & finite & jnp.isfinite(jnp.sum(continuous[0]))
    continuous = (
        jnp.where(usable, continuous[0], -eye),
        *(jnp.where(usable, m, 0.0) for m in continuous[1:]),
    )
    omega, done = largest_peak(form, continuous, usable, tolerance, eigensolver)
    frequency = from_normalised(omega, unit, dt)
    attained = usable & done
    value = _gain_at(A, B, C, D, *_point(omega, unit, dt), usable)
    value = jnp.where(finite, jnp.where(boundary | ~usable, jnp.inf, value), jnp.nan)
    status = Status.where(stable, Status.successful, Status.l_infinity)
    status = Status.where(attained, status, Status.max_steps)
    status = Status.where(usable, status, Status.infinite_norm)
    status = Status.where(finite, status, Status.nonfinite)
    return value, jnp.where(finite, frequency, jnp.nan), status


def to_normalised_continuous(A, B, C, D, *, dt: float):
    """The same singular values on the imaginary axis, as a wide-to-tall continuous system.

    Discrete systems go through z = (1 + s) / (1 - s); continuous ones are counted in units of their
    poles' typical frequency, returned as the second value. The shorter side of G comes last.
    """
    if dt == 0.0:
        size = jnp.sqrt(jnp.sum(A * A) / A.shape[0])
        unit = jnp.where(size > 0.0, size, 1.0)
        A, B = A / unit, B / unit
    else:
        unit = jnp.asarray(1.0 / dt)
        eye = jnp.eye(A.shape[0])
        solved = jnp.linalg.solve(A + eye, jnp.concatenate([A - eye, B], axis=1))
        D = D - C @ solved[:, A.shape[0] :]
        C = 2.0 * jnp.linalg.solve((A + eye).T, C.T).T
        A, B = solved[:, : A.shape[0]], solved[:, A.shape[0] :]
    if D.shape[1] > D.shape[0]:
        A, B, C, D = A.T, C.T, B.T, D.T
    return (A, B, C, D), unit


def from_normalised(omega, unit, dt: float):
    """Frequency in rad/s of a normalised one."""
    return omega * unit if dt == 0.0 else 2.0 * jnp.arctan(omega) * unit


def _point(omega, unit, dt: float):
    """The point (real, imaginary, at infinity) of the complex plane to evaluate G at."""
    if dt == 0.0:
        infinite = jnp.isinf(omega)
        return jnp.zeros_like(omega), jnp.where(infinite, 0.0, omega * unit), infinite
    angle = 2.0 * jnp.arctan(omega)
    return jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(omega, dtype=bool)


def stability(poles, dt: float):
    """Whether all poles are stable, and whether one lies on the boundary (normalised system)."""
    stable = jnp.all(poles.real < 0.0)
    if dt == 0.0:
        return stable, jnp.any(jnp.abs(poles.real) <= 1e-14 * jnp.max(jnp.abs(poles)))
    # The distance from the unit circle, seen through the bilinear map.
    distance = (1.0 - poles.real) ** 2 + poles.imag**2
    return stable, jnp.any(jnp.abs(poles.real) <= 5e-15 * distance)


def candidates(form: Modal):
    """Start frequencies and half-power widths: every pole's frequency and zero."""
    size = jnp.abs(form.poles)
    rate = jnp.abs(form.poles.real)
    # Upper half of each pair: where the mode oscillates. Lower half: where it resonates, which is
    # Bruinsma and Steinbuch's choice and lies lower for a damped mode. Real poles: their corner.
    resonance = jnp.sqrt(jnp.maximum(form.poles.imag**2 - form.poles.real**2, 0.0))
    imag = form.poles.imag
    omega = jnp.where(imag > 0.0, imag, jnp.where(imag < 0.0, resonance, size))
    return jnp.append(omega, 0.0), jnp.append(rate, jnp.min(size))


def largest_peak(
    form: Modal, continuous, usable, tolerance: float, eigensolver: AbstractEigensolver
):
    """Peak frequency (normalised) and whether the certificate came to an end."""
    A, B, C, D = continuous
    direct = _direct_gain(D)
    omega, width = candidates(form)
    gains = squared_gain(response(form, omega))
    # Climbing costs a few microseconds a candidate, a missed peak a whole eigenproblem: half of the
    # poles' frequencies, which is one per oscillating mode.
    _, best = lax.top_k(gains, min(max(3, A.shape[0] // 2), 8, omega.shape[0]))
    climbed, reached = refine_peaks(form, omega[best], width[best], 5)
    top = jnp.argmax(reached)
    gain, peak = jnp.sqrt(reached[top]), climbed[top]
    noise = rounding(form)
    # The cheap route needs partial fractions, and a level clear of the gain at infinity.
    cheap = trustworthy(form) & (direct < 0.999 * gain)
    higher, place, sound = sweep_modal(form, gain, tolerance, noise, eigensolver)
    certified = cheap & sound & (higher <= gain * (1.0 + tolerance) + noise)
    start = jnp.where(cheap & (higher > gain), place, peak)
    # A batch of one; `vmap` makes it longer.
    arguments = (certified | ~usable, peak, start, noise, A, B, C, D)
    omega, done = _repair(tolerance, eigensolver)(*(value[None] for value in arguments))
    return omega[0], done[0]


def _direct_gain(D):
    return jnp.sqrt(squared_gain(D[None].astype(complex))[0])


def _repair(tolerance: float, eigensolver: AbstractEigensolver):
    """The general level-set loop for those of a batch whose cheap certificate did not hold.

    Under a plain `vmap` every system would pay for the dearest. Here the loop runs over the failed
    ones alone, and `vmap` only makes the batch longer.
    """

    general = partial(_general, tolerance=tolerance, eigensolver=eigensolver)

    @jax.custom_batching.custom_vmap
    def run(certified, peak, start, noise, A, B, C, D):
        count = certified.shape[0]
        rest = (start, noise, A, B, C, D)
        if count == 1:
            # Alone, or inside `lax.map`: a branch is cheaper than a list of the failed.
            omega, done = lax.cond(
                certified[0],
                lambda: (peak[0], certified[0]),
                lambda: general(*(value[0] for value in rest)),
            )
            return omega[None], done[None]
        (failed,) = jnp.nonzero(~certified, size=count, fill_value=0)

        def repair_one(position, carry):
            omega, done = carry
            index = failed[position]
            found, ended = general(*(value[index] for value in rest))
            return omega.at[index].set(found), done.at[index].set(ended)

        return lax.fori_loop(0, jnp.sum(~certified), repair_one, (peak, certified))

    @run.def_vmap
    def lengthen(axis_size, in_batched, *arguments):
        longer = (
            (value if batched else jnp.broadcast_to(value, (axis_size, *value.shape)))
            for value, batched in zip(arguments, in_batched, strict=True)
        )
        omega, done = run(*(value.reshape(-1, *value.shape[2:]) for value in longer))
        return (omega.reshape(axis_size, -1), done.reshape(axis_size, -1)), (True, True)

    return run


def _general(start, noise, A, B, C, D, *, tolerance: float, eigensolver: AbstractEigensolver):
    omega = jnp.where(jnp.isfinite(start), start, 0.0)
    form = reduced_form(A, B, C, D, eigensolver)
    at_start = jnp.sqrt(squared_gain(response(form, omega[None]))[0])
    direct = _direct_gain(D)
    gain = jnp.maximum(at_start, direct)
    omega = jnp.where(direct >= at_start, jnp.inf, omega)
    return certify_by_hamiltonian(A, B, C, D, gain, omega, tolerance, noise, eigensolver)


@jax.custom_jvp
def _gain_at(A, B, C, D, real, imag, infinite, usable):
    """Largest singular value of G at one fixed point, solved directly for full accuracy."""
    return _singular_triplet(A, B, C, D, real, imag, infinite, usable)[0]


@_gain_at.defjvp
def _gain_at_jvp(primals, tangents):
    A, B, C, D, real, imag, infinite, usable = primals
    value, left, right, states = _singular_triplet(*primals)
    dA, dB, dC, dD = tangents[:4]
    # d sigma = Re u^H dG v, with u^H C (zI - A)^-1 =: w^H and (zI - A)^-1 B v =: x.
    adjoint = jnp.linalg.solve(_pencil(A, real, imag, usable).conj().T, C.T.astype(complex) @ left)
    finite = jnp.where(infinite | ~usable, 0.0, 1.0)

    def pair(row, matrix, column):
        # The real part, in real products, so that tangents stay real under transposition.
        return row.real @ (matrix @ column.real) + row.imag @ (matrix @ column.imag)

    tangent = finite * (
        pair(adjoint, dA, states) + pair(adjoint, dB, right) + pair(left, dC, states)
    ) + jnp.where(usable, 1.0, 0.0) * pair(left, dD, right)
    return value, tangent


def _pencil(A, real, imag, usable):
    eye = jnp.eye(A.shape[0])
    safe = jnp.where(usable, A, 0.0)
    return lax.complex(real * eye - safe, jnp.where(usable, imag, 1.0) * eye)


def _singular_triplet(A, B, C, D, real, imag, infinite, usable):
    """Gain, left and right singular vectors of G and the states (zI - A)^-1 B v."""
    B, C, D = (jnp.where(usable, m, 0.0).astype(complex) for m in (B, C, D))
    solved = jnp.linalg.solve(_pencil(A, real, imag, usable), B)
    G = D + jnp.where(infinite, 0.0, 1.0) * (C @ solved)
    left, gains, right = jnp.linalg.svd(G, full_matrices=False)
    v = right[0].conj()
    return gains[0], left[:, 0], v, solved @ v
