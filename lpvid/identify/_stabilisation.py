"""Stabilisation diagram: the modes of models of many orders from one factorisation."""

import functools
import itertools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load when first used
from jaxtyping import Array, Bool, Complex, Float

from lpvid.data import IOData
from lpvid.identify._checks import (
    check_varying,
    describe_excitation,
    input_factor,
    largest_order,
    require_samples,
)
from lpvid.identify._engine import range_of_records
from lpvid.identify._factor import ILL_CONDITIONED, Layout, Route
from lpvid.identify._methods import AbstractSubspaceMethod, PastOutputMOESP, projection_only

# Largest order looked at by default.
_LARGEST_DEFAULT = 40


class Stabilisation(eqx.Module):
    """Modes over the order; those that stay where they are, order after order, are physical.

    Rows are orders, columns modes by frequency; NaN (and `False`) where an order has fewer.

    Attributes:
        orders: of the models, rising, (order,).
        frequency: natural frequencies in rad/s, (order, mode).
        damping: damping ratios, negative for unstable modes, (order, mode).
        shapes: mode shapes at the outputs in their units, the largest entry real and one,
            (order, mode, ny).
        frequency_stable: within the tolerance of a mode of the order before, (order, mode).
        damping_stable: that mode's damping agrees too, (order, mode).
        shape_stable: that mode's shape agrees too (MAC), (order, mode).
        singular_values: of the projected data, largest first, (row,).
        spectrum_omega: frequencies of the spectrum in rad/s, (line,).
        spectrum: mean power spectral density of the outputs, each divided by its variance, (line,).
    """

    orders: tuple[int, ...] = eqx.field(static=True)
    frequency: Float[Array, "order mode"]
    damping: Float[Array, "order mode"]
    shapes: Complex[Array, "order mode ny"]
    frequency_stable: Bool[Array, "order mode"]
    damping_stable: Bool[Array, "order mode"]
    shape_stable: Bool[Array, "order mode"]
    singular_values: Float[Array, " row"]
    spectrum_omega: Float[Array, " line"]
    spectrum: Float[Array, " line"]

    @property
    def stable(self) -> Bool[Array, "order mode"]:
        """Modes with frequency, damping and shape stable, and positive damping."""
        return self.frequency_stable & self.damping_stable & self.shape_stable & (self.damping > 0)


def stabilisation(
    data: IOData,
    method: AbstractSubspaceMethod | None = None,
    orders: Sequence[int] | None = None,
    *,
    frequency_tolerance: float = 0.01,
    damping_tolerance: float = 0.05,
    shape_tolerance: float = 0.95,
) -> Stabilisation:
    r"""Modes of the models of many orders, and which of them stay from one order to the next.

    One factorisation and one singular value decomposition serve all orders: with the QR factors of
    the observability matrix without its last block row, A of order n is
    $R_{1:n,1:n}^{-1} (Q^T O_\downarrow)_{1:n,1:n}$. No B, D or initial states are estimated. Not
    for `jit`.

    Args:
        data: one or several records.
        method: as for `identify`, `PastOutputMOESP()` by default; its order is not used, its block
            rows are (by default enough for the largest order).
        orders: of the models, rising; by default every second one up to 40 or to what the record
            carries.
        frequency_tolerance: relative change of the natural frequency from the order before.
        damping_tolerance: relative change of the damping ratio.
        shape_tolerance: least modal assurance criterion, |φᵀφ̄'|² / (|φ|² |φ'|²); always met with
            one output.

    Returns:
        Modes, flags and what is drawn behind them.

    Raises:
        ValueError: orders that do not rise, or above what the block rows carry; constant channels,
            inputs that excite too little.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import stabilisation
        >>> from lpvid.models import StateSpace
        >>> rng = np.random.default_rng(0)
        >>> plant = StateSpace([[0.0, 1.0], [-400.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> u = rng.standard_normal(2000)
        >>> y = plant.simulate(u=u, dt=0.02) + 1e-4 * rng.standard_normal((2000, 1))
        >>> diagram = stabilisation(IOData(u=u, y=y, dt=0.02), orders=[2, 4, 6])
        >>> diagram.frequency[0].round(1).tolist()[:1]
        [20.0]
    """
    method = PastOutputMOESP() if method is None else method
    wanted = _checked_orders(orders)
    block_rows = _block_rows(method, data, _LARGEST_DEFAULT if wanted is None else wanted[-1])
    if wanted is None:
        most = min(_LARGEST_DEFAULT, largest_order(block_rows, data.ny))
        wanted = tuple(range(2, most + 1, 2)) or (1,)
    if wanted[-1] > (block_rows - 1) * data.ny:
        raise ValueError(
            f"orders: {wanted[-1]} is more than block_rows={block_rows} carries with {data.ny} "
            f"outputs, {(block_rows - 1) * data.ny}; lower it, or raise the method's block_rows "
            "(with a longer record, where it leaves them open)."
        )
    layout = Layout(block_rows, data.nu, data.ny, method.past_inputs, method.past_outputs)
    require_samples(layout, data.lengths)
    check_varying(data)
    found = _range(data, method, layout, "gram")
    if not float(found["smallest_pivot"]) > ILL_CONDITIONED:
        found = _range(data, method, layout, "qr")
    if int(found["excitation_rank"]) < layout.input_rows:
        factor = functools.partial(input_factor, data, constant=method.offset)
        raise ValueError(describe_excitation(data.input_names, layout, factor))
    values = np.asarray(found["singular_values"])
    observability = np.asarray(found["vectors"])[:, : wanted[-1]] * np.sqrt(values[: wanted[-1]])
    output_scale = np.asarray(found["scale"])[data.nu :]
    modes = _modes_by_order(observability, output_scale, wanted, data.dt)
    frequency, damping, shapes = _padded(modes, data.ny)
    flags = _agreement(
        frequency, damping, shapes, frequency_tolerance, damping_tolerance, shape_tolerance
    )
    hertz, spectrum = _mean_spectrum(data)
    return Stabilisation(
        orders=wanted,
        frequency=jnp.asarray(frequency),
        damping=jnp.asarray(damping),
        shapes=jnp.asarray(shapes),
        frequency_stable=jnp.asarray(flags[0]),
        damping_stable=jnp.asarray(flags[1]),
        shape_stable=jnp.asarray(flags[2]),
        singular_values=jnp.asarray(values),
        spectrum_omega=jnp.asarray(2.0 * np.pi * hertz),
        spectrum=jnp.asarray(spectrum),
    )


def _range(data: IOData, method: AbstractSubspaceMethod, layout: Layout, route: Route):
    return range_of_records(
        data.u,
        data.y,
        method=projection_only(method),
        layout=layout,
        lengths=data.lengths,
        route=route,
        correlate=False,
    )


def _checked_orders(orders: Sequence[int] | None) -> tuple[int, ...] | None:
    if orders is None:
        return None
    found = tuple(int(order) for order in orders)
    if not found or found[0] < 1 or any(b <= a for a, b in itertools.pairwise(found)):
        raise ValueError(f"orders: {list(orders)} given; positive, rising orders are needed.")
    return found


def _block_rows(method: AbstractSubspaceMethod, data: IOData, most: int) -> int:
    """The method's, or enough for half as many states again as the largest order."""
    if method.block_rows is not None:
        return method.block_rows
    target = max(-(-3 * most // (2 * data.ny)) + 1, 15)
    records = len(data.lengths)
    # Twice as many columns as rows, as for `identify`.
    carried = (data.n_samples + records) // (4 * (data.nu + data.ny) + 2 * records)
    return max(2, min(target, carried, min(data.lengths) // 2))


def _modes_by_order(
    observability: np.ndarray, output_scale: np.ndarray, orders: tuple[int, ...], dt: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poles s of the oscillatory modes, by frequency, and their shapes (mode, ny)."""
    ny = output_scale.size
    # QR is nested: its leading columns are those of the smaller orders.
    Q, R = np.linalg.qr(observability[:-ny])
    shifted = Q.T @ observability[ny:]
    C = observability[:ny] * output_scale[:, None]
    modes = []
    for n in orders:
        A = scipy.linalg.solve_triangular(R[:n, :n], shifted[:n, :n])
        found, vectors = np.linalg.eig(A)
        poles = np.asarray(found, np.complex128)
        # The upper of each pair; a real negative z is half the sampling frequency, no mode.
        upper = np.flatnonzero(poles.imag > 1e-9 * np.abs(poles))
        s = np.log(poles[upper]) / dt
        upper, s = upper[np.argsort(np.abs(s))], s[np.argsort(np.abs(s))]
        shapes = (C[:, :n] @ vectors[:, upper]).T
        largest = np.take_along_axis(shapes, np.argmax(np.abs(shapes), axis=1)[:, None], axis=1)
        modes.append((s, shapes / np.where(largest == 0.0, 1.0, largest)))
    return modes


def _padded(modes, ny: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    most = max(max(s.size for s, _ in modes), 1)
    frequency, damping = np.full((2, len(modes), most), np.nan)
    shapes = np.full((len(modes), most, ny), np.nan, complex)
    for row, (s, shape) in enumerate(modes):
        frequency[row, : s.size] = np.abs(s)
        damping[row, : s.size] = -s.real / np.abs(s)
        shapes[row, : s.size] = shape
    return frequency, damping, shapes


def _agreement(
    frequency, damping, shapes, frequency_tolerance, damping_tolerance, shape_tolerance
) -> np.ndarray:
    """Flags (frequency, damping, shape) of each mode against the best of the order before."""
    flags = np.zeros((3, *frequency.shape), bool)
    for row in range(1, frequency.shape[0]):
        now, before = frequency[row][:, None], frequency[row - 1][None]
        # NaN compares as false throughout.
        near = np.abs(now - before) <= frequency_tolerance * before
        ratios = damping[row][:, None], damping[row - 1][None]
        calm = np.abs(ratios[0] - ratios[1]) <= damping_tolerance * np.abs(ratios[1])
        inner = np.abs(np.einsum("ak,bk->ab", shapes[row].conj(), shapes[row - 1])) ** 2
        sizes = np.sum(np.abs(shapes[row]) ** 2, axis=1), np.sum(np.abs(shapes[row - 1]) ** 2, 1)
        alike = inner >= shape_tolerance * sizes[0][:, None] * sizes[1][None] * (1.0 - 1e-12)
        flags[0, row] = np.any(near, axis=1)
        flags[1, row] = np.any(near & calm, axis=1)
        # A shape agrees with that of the same mode: where the damping does, that one's.
        same = near & np.where(flags[1, row][:, None], calm, True)
        flags[2, row] = np.any(same & alike, axis=1)
    return flags


def _mean_spectrum(data: IOData) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz and the outputs' mean density, each output over its variance."""
    segment = min(min(data.lengths), max(64, min(data.n_samples // 8, 4096)))
    hertz = np.fft.rfftfreq(segment, data.dt)
    total = np.zeros(hertz.size)
    for record in data.records:
        y = np.asarray(record.y)
        _, power = scipy.signal.welch(y, fs=1.0 / data.dt, nperseg=segment, axis=0)
        variance = np.maximum(np.var(np.asarray(data.y), axis=0), np.finfo(float).tiny)
        total = total + len(y) / data.n_samples * np.mean(power / variance, axis=1)
    return hertz[1:], total[1:]
