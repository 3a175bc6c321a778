"""The demo's pictures."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from lpvid import plot
from lpvid.commands._demo_tables import angle
from lpvid.study import MODEL_NAMES, StudyResult

# Samples drawn of a record: more would be a black band.
_SHOWN = 400
# Room beside the measured range that a model may use before it is cut.
_ROOM = 0.8


class Figure(NamedTuple):
    """One picture: file name, caption, and what draws it."""

    name: str
    caption: str
    draw: Callable[[StudyResult], Any]


def _worst(result: StudyResult) -> int:
    return int(np.argmax(np.asarray(result.relative_cost)))


def _systems(result: StudyResult, point: int) -> dict[str, Any]:
    return {
        "local black box": result.black_boxes[point],
        "restructured": result.restructured[point],
        "analytic": result.analytic[point],
    }


def _records(result: StudyResult) -> Any:
    record = result.noisy.records[_worst(result)].replace()
    shown = record[: min(_SHOWN, record.n_samples)].select(scheduling=())
    axes = plot.records(shown)
    axes[0].figure.suptitle(f"θ2 = {angle(result.theta2[_worst(result)])}", fontsize=9)
    return axes


def _local_response(result: StudyResult) -> Any:
    point = _worst(result)
    record = result.records.validation.records[point]
    count = min(_SHOWN, record.n_samples)
    outputs = {
        label: getattr(system, "model", system).simulate(u=record.u, dt=record.dt)[:count]
        for label, system in _systems(result, point).items()
    }
    return plot.compare(record[:count], outputs)


def _bode(result: StudyResult) -> Any:
    names = result.noisy.names
    return plot.bode(
        _systems(result, _worst(result)), input_names=names["u"], output_names=names["y"]
    )


def _minima(result: StudyResult) -> Any:
    labelled = zip(result.theta2, result.restructured, strict=True)
    return plot.minima({f"θ2 = {angle(theta2)}": found for theta2, found in labelled})


def _poles(result: StudyResult) -> Any:
    return plot.poles(_systems(result, _worst(result)))


def _kappas(result: StudyResult) -> np.ndarray:
    return np.cos(np.asarray(result.theta2))


def _parameters(result: StudyResult) -> Any:
    return plot.parameters(
        result.lpv["restructured"],
        _kappas(result),
        result.restructured,
        reference=lambda kappa: result.arm.structured_parameters(jnp.arccos(kappa)),
        name="κ = cos θ2",
    )


def _modes(result: StudyResult) -> Any:
    return plot.mode_frequencies(
        {
            "local models": result.restructured,
            "LPV model": result.lpv["restructured"],
            "physics": lambda kappa: result.arm.linearised(jnp.arccos(kappa)),
        },
        _kappas(result),
        name="κ = cos θ2",
    )


def _sweep(result: StudyResult) -> Any:
    sweep = result.records.sweep
    axes = plot.compare(sweep, {name: result.sweep_outputs[name] for name in MODEL_NAMES})
    measured = np.asarray(sweep.y)
    for k, (main, rest) in enumerate(axes):
        low, high = measured[:, k].min(), measured[:, k].max()
        room = _ROOM * (high - low)
        # A model that runs away would flatten all else; the legend says how far off it is.
        _keep_readable(main, low - room, high + room)
        _keep_readable(rest, -room, room)
    return axes


def _keep_readable(axes: Any, low: float, high: float) -> None:
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low), min(top, high))


FIGURES = (
    Figure(
        "records",
        "The beginning of a noisy local record, at the posture that is hardest to restructure.",
        _records,
    ),
    Figure(
        "local_response",
        "Local models against the arm at the same posture, on the beginning of a noise-free "
        "validation record; the fits are those of the samples shown.",
        _local_response,
    ),
    Figure(
        "bode",
        "Frequency responses at the posture with the largest relative cost.",
        _bode,
    ),
    Figure(
        "minima",
        "Cost that each start of the search ended with, sorted; filled: in the best minimum.",
        _minima,
    ),
    Figure("poles", "Poles at the same posture.", _poles),
    Figure(
        "parameters",
        "Parameters of the restructured models (dots), the LPV model (line), and physics (dashed).",
        _parameters,
    ),
    Figure("modes", "Frequencies of the oscillatory modes over κ.", _modes),
    Figure(
        "sweep",
        "The sweep: measured outputs, the three LPV models, and their residuals. What leaves the "
        "frame is cut off.",
        _sweep,
    ),
)
