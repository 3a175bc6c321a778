"""Stabilisation diagram: modes over the order, the outputs' spectrum behind them."""

from typing import Any

import numpy as np

from lpvid.identify import Stabilisation
from lpvid.plot._figure import FAINT, colour, dress, grid_of_axes, legend_above, styled
from lpvid.plot._systems import HZ

# Sign of each kind of mode: marker, colour, filled, size, drawn over what is before it.
_KINDS = {
    "new": ("x", FAINT, False, 3.5),
    "frequency stable": ("^", "#E69F00", False, 4.5),
    "+ damping": ("s", "#56B4E9", False, 4.5),
    "+ shape": ("o", "#0072B2", True, 4.5),
}


@styled
def stabilisation(
    diagram: Stabilisation, *, frequencies: Any = None, log: bool = False, axes: Any = None
) -> np.ndarray:
    """Natural frequencies over the order, marked by their agreement with the order before.

    Columns of filled circles (frequency, damping and shape agree) are modes of the structure; what
    is marked otherwise comes and goes with the order. Modes of negative damping are never marked
    stable. Behind them, on an axis of its own to the right, the mean spectrum of the outputs;
    below, the singular values.

    Args:
        diagram: result of `lpvid.identify.stabilisation`.
        frequencies: lowest and highest frequency shown in Hz; 0 to half the sampling frequency by
            default.
        log: logarithmic frequencies.
        axes: where to draw, two of them; new ones by default.

    Returns:
        The axes, shape (2,): diagram, singular values.

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import stabilisation
        >>> from lpvid.plot import stabilisation as draw
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.95 ** np.arange(80) * np.cos(np.arange(80)))[:500]
        >>> draw(stabilisation(IOData(u=u, y=y, dt=0.1), orders=[2, 4, 6])).shape
        (2,)
    """
    panels = grid_of_axes(2, 1, axes, size=(7.0, 6.0), height_ratios=[3.2, 1.0])[:, 0]
    main, below = panels
    for panel in panels:
        dress(panel)
    omega = np.asarray(diagram.spectrum_omega)
    low, high = (0.0, omega[-1] / HZ) if frequencies is None else frequencies
    _draw_spectrum(main, omega / HZ, np.asarray(diagram.spectrum), (low, high))
    hertz = np.asarray(diagram.frequency) / HZ
    order = np.broadcast_to(np.asarray(diagram.orders)[:, None], hertz.shape)
    # How many of the tests a mode passed, one after the other.
    rank = np.asarray(diagram.frequency_stable).astype(int)
    rank += np.asarray(diagram.frequency_stable & diagram.damping_stable)
    rank = np.where(np.asarray(diagram.stable), 3, np.minimum(rank, 2))
    growing = np.asarray(diagram.damping) <= 0.0
    rank = np.where(growing, 0, rank)
    shown = np.isfinite(hertz) & (hertz >= low) & (hertz <= high)
    for kind, (label, (marker, shade, filled, size)) in enumerate(_KINDS.items()):
        chosen = shown & (rank == kind)
        main.plot(
            hertz[chosen],
            order[chosen],
            linestyle="none",
            marker=marker,
            markersize=size,
            color=shade,
            markerfacecolor=shade if filled else "none",
            label=label,
            zorder=3 + kind,
        )
    if log:
        main.set_xscale("log")
        low = max(low, omega[0] / HZ)
    main.set_xlim(low, high)
    main.yaxis.get_major_locator().set_params(integer=True)
    main.set_xlabel("frequency (Hz)")
    main.set_ylabel("order")
    legend_above(main)
    values = np.asarray(diagram.singular_values)
    count = min(values.size, 2 * diagram.orders[-1])
    number = np.arange(1, count + 1)
    below.plot(number, np.where(values > 0, values, np.nan)[:count], color=FAINT, linewidth=0.8)
    below.plot(
        number, values[:count], linestyle="none", marker="o", markersize=3.0, color=colour(0)
    )
    below.set_yscale("log")
    below.set_xlabel("number")
    below.set_ylabel("singular value")
    below.xaxis.get_major_locator().set_params(integer=True)
    return panels


def _draw_spectrum(panel: Any, hertz: np.ndarray, spectrum: np.ndarray, limits: Any) -> None:
    shown = (hertz >= limits[0]) & (hertz <= limits[1]) & (spectrum > 0)
    behind = panel.twinx()
    behind.plot(hertz[shown], 10.0 * np.log10(spectrum[shown]), color="#B0B0B0", linewidth=0.9)
    behind.set_ylabel("mean output spectrum (dB)", color="#737373")
    behind.tick_params(colors="#737373", labelsize=8.0)
    behind.spines[["top", "left"]].set_visible(False)
    # The modes stand in front.
    panel.set_zorder(behind.get_zorder() + 1)
    panel.patch.set_visible(False)
