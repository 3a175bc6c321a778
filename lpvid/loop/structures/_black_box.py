"""Linear models without physics: free entries of a canonical form, forces of free direction."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._companion import (
    CompanionForm,
    companion_form,
    gauge_of,
    in_gauge,
    split_entries,
)
from lpvid.loop.structures._free import free_ports
from lpvid.loop.structures._realise import Model, realise, with_resonance
from lpvid.loop.structures._search import WindowError, best_start
from lpvid.loop.structures._units import per
from lpvid.loop.structures._windows import OVERLAP, Windows, windows_of

_LARGEST_ORDER = 12
_AUTOMATIC = 6
# An order more is worth it from this drop of the mean log squared error on: more where its poles
# are no resonance, since slow and damped ones also follow friction.
_WORTH = 2.0
_WORTH_RESONANCE = 0.9
# The second order is any mechanism's.
_WORTH_SECOND = 0.6
# Damping ratios of what counts as a resonance; a spurious one may be a little unstable.
_DAMPING = (-0.05, 0.3)
# Feedthrough is from this one on, in windows of single samples.
_DIRECT = 0.1


class BlackBox(AbstractPortedStructure):
    r"""ẋ = A x + B u + Σ f, y = C x + D u of any order, in modal companion form.

    A has blocks [[0, s], [−a/s, −b]], one for each pair of poles (the roots of λ² + bλ + a, real or
    not), and [−a] for a last real one. In each block an input direction w is scaled, B w = (0, s):
    the rest of B, and C, are free, so there are no more parameters than a transfer matrix has. The
    scales s and the directions w are taken from the data once and then stay.

    Coordinates are the outputs: q_j = y_j without feedthrough, q̇_j = C_j A x. A force on them may
    enter any state.

    Args:
        data: records; the model is identified from them, to fix the form.
        order: number of states; chosen by the prediction error when left out.
        feedthrough: whether D is free; found from the data when left out.

    Raises:
        ValueError: an order below one or above what the records' windows can tell.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import BlackBox
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(np.r_[0.0, u], 0.8 ** np.arange(50))[:500]
        >>> box = BlackBox(IOData(u=u, y=y, dt=0.1), order=1)
        >>> box.parameter_names
        ('pole rate 1', 'C[y1,1]')
        >>> round(float(np.exp(-0.1 * box.nominal[0])), 3)
        0.8
    """

    labels: Labels = eqx.field(static=True)
    order: int = eqx.field(static=True)
    offset: Float[Array, " entry"]
    linear: Float[Array, "entry parameter"]
    nominal: Float[Array, " parameter"]
    name: str = eqx.field(default="black-box", static=True)

    def __init__(self, data: IOData, *, order: int | None = None, feedthrough: bool | None = None):
        if order is not None and not 1 <= order <= _LARGEST_ORDER:
            raise ValueError(
                f"order={order}: give 1 to {_LARGEST_ORDER}, or leave it out; reduce a larger "
                f"model with balanced_truncation first."
            )
        windows = windows_of(data, _AUTOMATIC if order is None else order)
        found = _chosen(windows, data.nu, data.ny, order)
        if found is None:
            raise ValueError(
                f"data: no model of order {order or 1} comes out of these records; give a longer "
                f"or better excited record, or another order."
            )
        form, nominal = found
        if feedthrough is not False:
            full = form.with_feedthrough()
            start = np.concatenate([nominal, np.zeros(data.ny * data.nu)])
            with_it = _refined(full, windows, [start])
            gained = _refined(form, windows, [nominal]).quickest - with_it.quickest
            if feedthrough or gained > _DIRECT:
                form, nominal = full, with_it.theta
        self.nominal = jnp.asarray(nominal)
        self.order = form.order
        self.offset, self.linear = jnp.asarray(form.offset), jnp.asarray(form.linear)
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=form.names(data.input_names, data.output_names),
            parameter_units=("",) * len(nominal),
            coordinates=data.output_names,
            coordinate_units=data.output_units,
            force_units=tuple(per(unit, "s") for unit in data.output_units),
        )

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ."""
        del kappa
        n, nu, ny = self.order, len(self.labels.inputs), len(self.labels.outputs)
        entries = self.offset + self.linear @ theta
        return free_ports(*split_entries(entries, n, nu, ny))

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """None."""
        size = len(self.labels.parameters)
        return np.full(size, -np.inf), np.full(size, np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ from the model identified when the form was made, searched on in these records."""
        form = CompanionForm(
            self.order,
            len(self.labels.inputs),
            len(self.labels.outputs),
            np.asarray(self.offset),
            np.asarray(self.linear),
        )
        return _refined(form, windows_of(data, self.order), [np.asarray(self.nominal)]).theta


class _Found(NamedTuple):
    theta: np.ndarray
    score: float
    quickest: float


def _chosen(
    windows: list[Windows], nu: int, ny: int, order: int | None
) -> tuple[CompanionForm, np.ndarray] | None:
    """The form and θ of the order asked for, or of the least that predicts nearly best."""
    # A larger model is also looked for by adding a resonance to a smaller one.
    orders = list(range(1, _AUTOMATIC + 1) if order is None else range(2 - order % 2, order + 1, 2))
    models = [realise(entry, nu, ny, orders) for entry in windows]
    smaller: dict[int, Model] = {}
    chosen, least, waited, resonances = None, np.inf, 0, 0
    for size in orders:
        sized = [model for group in models for model in group if len(model[0]) == size]
        if size - 2 in smaller:
            sized += with_resonance(smaller[size - 2], windows, nu, ny)
        start = _start(sized, nu, ny)
        if start is None:
            continue
        form, thetas = start
        found = _refined(form, windows, thetas, thorough=False)
        A, B, C, _ = (matrix[0, 0] for matrix in form.matrices(found.theta[None], np.zeros((1, 0))))
        smaller[size] = (A, B, C)
        # What parameters take from the error of windows as few as these.
        parameters = form.linear.shape[1]
        fitted = np.mean([parameters / (e.number * e.samples * ny / OVERLAP) for e in windows])
        score, resonant = found.score + float(fitted), _resonances(A)
        each = _WORTH_RESONANCE if resonant > resonances else _WORTH
        each = min(each, _WORTH_SECOND) if size == 2 else each
        if order is not None or score < least - each * (waited + 1):
            chosen, least, waited = (form, found.theta), score, 0
            resonances = resonant
        else:
            waited += 1
            if waited > 2:
                break
    if chosen is None or order not in (None, chosen[0].order):
        return None
    form, theta = chosen
    return form, _refined(form, windows, [theta]).theta


def _resonances(A: np.ndarray) -> int:
    """Pairs of lightly damped poles."""
    poles = np.linalg.eigvals(A)
    damping = -poles.real[poles.imag > 0.0] / np.abs(poles[poles.imag > 0.0])
    return int(np.sum((damping > _DAMPING[0]) & (damping < _DAMPING[1])))


def _start(models: list[Model], nu: int, ny: int):
    """A form, and the models' parameters in it."""
    for model in models:
        gauge = gauge_of(*model)
        if gauge is None:
            continue
        thetas = [in_gauge(A, B, C, gauge) for A, B, C in models]
        thetas = [theta for theta in thetas if theta is not None]
        if thetas:
            return companion_form(gauge, len(model[0]), nu, ny), thetas
    return None


def _refined(
    form: CompanionForm, windows: list[Windows], thetas: list[np.ndarray], *, thorough: bool = True
) -> _Found:
    size = form.linear.shape[1]
    free = (np.full(size, -np.inf), np.full(size, np.inf))
    problem = WindowError(windows, ny=form.ny, bounds=free, matrices=form.matrices)
    tries, rounds = (1, 2) if thorough else (0, 2)
    guesses = np.array(thetas)
    theta, score = best_start(problem, guesses, tries=tries, rounds=rounds, followed=2)
    return _Found(theta, score, float(problem.scores(theta[None], [0])[0]))
