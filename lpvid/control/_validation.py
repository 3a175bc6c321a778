"""Validation of models: by the record they come from, and in a loop that they have not seen."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from lpvid.analysis import relative_error
from lpvid.control._closed_loop import ClosedLoopMotion, simulate_closed_loop
from lpvid.data import IOData
from lpvid.identify import (
    AbstractSubspaceMethod,
    estimate_initial_state,
    identify,
    offset_level,
)
from lpvid.mechanics import ProportionalDerivative, SampledController, SingleLinkFlexibleArm
from lpvid.models import LPVStateSpace, StateSpace

# Gains of the loop in which 002 compares models and plant.
_GAINS = (0.5, 1.4)


class Validation(eqx.Module):
    """Models beside a plant; `str` gives 002's table.

    `lpvid.plot.validation` draws it.

    Attributes:
        kind: "data matching" or "set-point following".
        data: what the plant did.
        labels: of the models.
        outputs: of every model, (model, time, ny).
        relative_error: δ_i = RMS(error) / RMS(output) over the whole record, (model, ny).
        identified: samples at the start of each record that a model could be identified on; zero
            for set-point following.
    """

    kind: str = eqx.field(static=True)
    data: IOData
    labels: tuple[str, ...] = eqx.field(static=True)
    outputs: Float[Array, "model time ny"]
    relative_error: Float[Array, "model ny"]
    identified: tuple[int, ...] = eqx.field(static=True)

    @property
    def mean(self) -> Float[Array, " model"]:
        """Mean of δ_i over the outputs, of every model (002, equation 2-25)."""
        return jnp.mean(self.relative_error, axis=1)

    def rows(self) -> list[dict[str, Any]]:
        """One dictionary for each model: its label, δ by output, and their mean."""
        return [
            {"model": label}
            | dict(zip(self.data.output_names, map(float, errors), strict=True))
            | {"mean": float(mean)}
            for label, errors, mean in zip(self.labels, self.relative_error, self.mean, strict=True)
        ]

    def table(self) -> str:
        """The rows as text."""
        lines = [["δ, " + self.kind, *self.data.output_names, "mean"]]
        for label, *errors in (row.values() for row in self.rows()):
            lines.append([label, *(f"{error:.4f}" for error in errors)])
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join(
                cell.rjust(width) if k else cell.ljust(width)
                for k, (cell, width) in enumerate(zip(line, widths, strict=True))
            )
            for line in lines
        )

    def __str__(self) -> str:
        return self.table()


def data_matching(models: Any, data: IOData, *, fraction: float = 0.5) -> Validation:
    """Data-matching validation: identified on the first part of a record, simulated over all of it.

    A model is simulated from its result's own first state (`x0` of a `Fit`, a `ModalReduction`, an
    `UpdatedModel`), where it holds one for every record, else from the state that matches the first
    part best.

    Args:
        models: one, or a mapping from label to one, of: a `StateSpace` or `LPVStateSpace` (made
            from the first part); a result that holds one; a subspace method, with which the first
            part is identified here; a function from the first part to a model or result.
        data: one or several records, each divided at `fraction`.
        fraction: the part of each record that models may know.

    Returns:
        A `Validation`.

    Raises:
        ValueError: no models, a model of another rate or other channels than the data, a fraction
            that leaves a part without two samples.

    Source: 002, section 2.4 and equations 2-24 and 2-25.

    Example:
        >>> import numpy as np
        >>> from lpvid.control import data_matching
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> u = np.ones(40)
        >>> data = IOData(u=u, y=1.0 - 0.5 ** np.arange(40), dt=0.1)
        >>> print(data_matching({"lag": StateSpace([[0.5]], [[0.4]], [[1.0]], dt=0.1)}, data))
        δ, data matching      y1    mean
        lag               0.1...  0.1...
    """
    known, _ = data.split(fraction)
    outputs = {}
    for label, item in _labelled(models).items():
        if isinstance(item, AbstractSubspaceMethod):
            item = identify(known, item)
        elif _is_function(item):
            item = item(known)
        outputs[label] = _matched(item, data, known)
    return _validation("data matching", data, outputs, known.lengths)


def set_point_following(
    models: Any,
    plant: ClosedLoopMotion | IOData,
    controller: SampledController | None = None,
    *,
    reference: ArrayLike | None = None,
) -> Validation:
    """Set-point-following validation: models and plant under the same controller and set-points.

    The models start from rest. A plant whose friction its controller compensates is compared with
    linear models under the controller without that compensation, as 002 does.

    Args:
        models: one, or a mapping from label to one, of: a `StateSpace` without feedthrough, or a
            result that holds one; a `SingleLinkFlexibleArm`; a `ClosedLoopMotion`, or the outputs
            (time, ny), of any other model simulated already.
        plant: what the plant did, simulated or measured.
        controller: of the models; by default 002's, u = 0.5 (R − y1) − 1.4 y4.
        reference: set-points, (time,) or (time, nr); those of the plant's motion by default.

    Returns:
        A `Validation`.

    Raises:
        ValueError: no models, a record without `reference`, several records, outputs of another
            shape, a model with an output offset or of another rate.

    Source: 002, section 2.4.

    Example:
        >>> import jax.numpy as jnp
        >>> from lpvid.control import set_point_following, simulate_closed_loop
        >>> from lpvid.mechanics import ProportionalDerivative
        >>> from lpvid.models import StateSpace
        >>> pd = ProportionalDerivative(0.5, 1.4)
        >>> motors = [StateSpace([[0.9]], [[gain]], [[0.1]], dt=0.1) for gain in (1.0, 1.1)]
        >>> motion = simulate_closed_loop(motors[0], pd, reference=jnp.ones(60))
        >>> set_point_following({"motor": motors[1]}, motion).mean < 0.1
        Array([ True], dtype=bool)
    """
    if isinstance(plant, ClosedLoopMotion):
        reference = plant.reference if reference is None else reference
        plant = plant.data()
    if reference is None:
        raise ValueError("reference: a record does not hold the set-points; give them too.")
    if len(plant.lengths) > 1:
        raise ValueError(f"plant: {len(plant.lengths)} records; give one at a time.")
    reference = jnp.asarray(reference, float)
    if reference.shape[:1] != (plant.n_samples,):
        raise ValueError(
            f"reference has shape {reference.shape}, the plant's motion {plant.n_samples} samples: "
            "give a set-point for each sample."
        )
    controller = ProportionalDerivative(*_GAINS) if controller is None else controller
    outputs = {
        label: _followed(item, controller, reference, plant.dt)
        for label, item in _labelled(models).items()
    }
    return _validation("set-point following", plant, outputs, (0,))


def _validation(
    kind: str, data: IOData, outputs: dict[str, Array], identified: tuple[int, ...]
) -> Validation:
    for label, output in outputs.items():
        if output.shape != data.y.shape:
            raise ValueError(
                f"models: {label!r} has outputs of shape {output.shape}, the plant's are "
                f"{data.y.shape}."
            )
    return Validation(
        kind=kind,
        data=data,
        labels=tuple(outputs),
        outputs=jnp.stack(list(outputs.values())),
        relative_error=jnp.stack([relative_error(data.y, output) for output in outputs.values()]),
        identified=identified,
    )


def _labelled(models: Any) -> dict[str, Any]:
    found = dict(models) if isinstance(models, Mapping) else {"model": models}
    if not found:
        raise ValueError("models: none given.")
    return found


def _is_function(item: Any) -> bool:
    return isinstance(item, Callable) and not isinstance(item, eqx.Module)


def _model_of(item: Any) -> Any:
    for name in ("model", "state_space"):
        item = getattr(item, name, item)
    return item


def _matched(item: Any, data: IOData, known: IOData) -> Array:
    model = _model_of(item)
    starts = getattr(item, "x0", None)
    if starts is None or jnp.ndim(starts) != 2 or jnp.shape(starts)[0] != len(data.lengths):
        starts = estimate_initial_state(item, known)
    elif isinstance(model, StateSpace) and (model.nu, model.ny) != (data.nu, data.ny):
        raise ValueError(
            f"models: one has {model.nu} inputs and {model.ny} outputs, the data {data.nu} and "
            f"{data.ny}; choose channels with data.select."
        )
    parts = []
    for record, x0 in zip(data.records, starts, strict=True):
        if isinstance(model, LPVStateSpace):
            assert record.kappa is not None  # estimate_initial_state has asked for it
            y = model.simulate(u=record.u, kappa=record.kappa, dt=record.dt, x0=x0)
        else:
            y = model.simulate(u=record.u, dt=record.dt, x0=x0)
        parts.append(y)
    offset = getattr(item, "output_offset", None)
    simulated = jnp.concatenate(parts)
    return simulated if offset is None else simulated + offset_level(jnp.asarray(offset), data)


def _followed(item: Any, controller: SampledController, reference: Array, dt: float) -> Array:
    offset = getattr(item, "output_offset", None)
    if offset is not None and np.any(np.asarray(offset)):
        raise ValueError(
            "models: an output offset would act on the controller; identify with offset=False on "
            "records freed of it."
        )
    if isinstance(item, ClosedLoopMotion):
        return item.y
    model = _model_of(item)
    if isinstance(model, StateSpace | SingleLinkFlexibleArm):
        return simulate_closed_loop(model, controller, reference=reference, dt=dt).y
    output = jnp.asarray(model, float)
    return output[:, None] if output.ndim == 1 else output
