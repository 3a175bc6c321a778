"""Local models, operating points and weights as arrays."""

from collections.abc import Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.models import (
    AbstractStructure,
    DiscreteTimeStructure,
    FreeStructure,
    StateSpace,
    StructuredModel,
)
from lpvid.refinement import Refined
from lpvid.restructure import Restructured

Points: TypeAlias = Float[np.ndarray, "point scheduling"]
Local: TypeAlias = Restructured | Refined | StructuredModel | StateSpace


def operating_points(kappas: ArrayLike | Sequence, count: int) -> Points:
    """Operating points, one row each.

    NumPy: what the points determine must be known, inside of jit too.

    Args:
        kappas: shape (n_points,) or (n_points, n_scheduling).
        count: number of models.

    Raises:
        ValueError: there is not one row for each model.
    """
    points = np.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or points.shape[0] != count:
        raise ValueError(
            f"kappas: one row for each of the {count} models is needed, got shape {points.shape}."
        )
    if not np.all(np.isfinite(points)):
        raise ValueError("kappas: NaN or infinity among the operating points; leave those out.")
    return points


def local_parameters(
    models: Sequence[Local],
) -> tuple[AbstractStructure, Float[Array, "point parameter"]]:
    """The structure that all models share, and the parameters of each.

    Raises:
        ValueError: none is given, they differ in structure, size or sample time, or a parameter is
            not finite.
    """
    if not models:
        raise ValueError("models: none given.")
    found = [_structured(model) for model in models]
    first = found[0]
    if len({isinstance(model, StateSpace) for model in found}) > 1:
        raise ValueError("models: structured and state-space models do not mix.")
    if isinstance(first, StateSpace):
        structure, parameters = _entries([m for m in found if isinstance(m, StateSpace)])
    else:
        structured = [model for model in found if isinstance(model, StructuredModel)]
        structure = first.structure
        if any(_differ(model.structure, structure) for model in structured):
            raise ValueError("models: all must be of the same structure.")
        parameters = jnp.stack([model.parameters for model in structured])
    if not isinstance(parameters, Tracer) and not bool(jnp.all(jnp.isfinite(parameters))):
        bad = [i for i in range(len(models)) if not bool(jnp.all(jnp.isfinite(parameters[i])))]
        raise ValueError(f"models: non-finite parameters at point(s) {bad}; leave them out.")
    return structure, parameters


def frozen(model: Local) -> StateSpace:
    """A local model's matrices."""
    found = _structured(model)
    return found if isinstance(found, StateSpace) else found.state_space


def _structured(model: Local) -> StructuredModel | StateSpace:
    if isinstance(model, Refined):
        model = model.model
    if isinstance(model, Restructured):
        return StructuredModel(model.structure, model.parameters)
    if not isinstance(model, StructuredModel | StateSpace):
        raise ValueError(
            f"models: a {type(model).__name__} cannot be interpolated; give results of restructure "
            "or refine, StructuredModel or StateSpace."
        )
    return model


def _entries(models: list[StateSpace]) -> tuple[AbstractStructure, Float[Array, "point parameter"]]:
    first = models[0]
    sizes = {(m.nx, m.nu, m.ny, m.dt, m.batch_shape) for m in models}
    if len(sizes) != 1 or first.batch_shape:
        raise ValueError(
            "models: single models of one size and sample time are needed; got (order, inputs, "
            f"outputs, dt, batch axes) {sorted(sizes)}."
        )
    structure: AbstractStructure = FreeStructure(first.nx, first.nu, first.ny)
    if first.is_discrete:
        structure = DiscreteTimeStructure(structure, first.dt)
    rows = [[block.reshape(-1) for block in (m.A, m.B, m.C, m.D)] for m in models]
    return structure, jnp.stack([jnp.concatenate(row) for row in rows])


def _differ(first: AbstractStructure, second: AbstractStructure) -> bool:
    same = eqx.tree_equal(first, second)
    return not (isinstance(same, Tracer) or bool(same))


@eqx.filter_jit
def responses(structure: AbstractStructure, parameters: Float[Array, "point parameter"]):
    """Each local model's response on its own grid: log-spaced over its poles, poles included."""

    def one(values):
        model = structure.matrices(values)
        size = jnp.sort(model.modes().frequency)
        fast = jnp.where(size[-1] > 0.0, size[-1], 1.0)
        slow = jnp.maximum(size[0], 1e-3 * fast)
        spaced = jnp.exp(jnp.linspace(jnp.log(slow / 10.0), jnp.log(3.0 * fast), 60))
        # Not at a frequency of zero, where an integrator's response is infinite.
        omega = jnp.concatenate([spaced, jnp.maximum(size, slow / 10.0)])
        if model.is_discrete:
            omega = jnp.minimum(omega, jnp.pi / model.dt)
        return omega, model.frequency_response(omega)

    return jax.vmap(one)(parameters)


@eqx.filter_jit
def responses_at(
    structure: AbstractStructure,
    parameters: Float[Array, "point parameter"],
    omega: Float[Array, "point frequency"],
):
    """Responses at given frequencies of each point."""
    return jax.vmap(lambda p, w: structure.matrices(p).frequency_response(w))(parameters, omega)


@eqx.filter_jit
def response_variances(
    structure: AbstractStructure,
    parameters: Float[Array, "point parameter"],
    covariances: Float[Array, "point parameter parameter"],
    omega: Float[Array, "point frequency"],
):
    """Sum over frequencies and channels of the variances that the parameters' errors cause."""

    def one(values, covariance, frequencies):
        def response(p):
            found = structure.matrices(p).frequency_response(frequencies).reshape(-1)
            return jnp.concatenate([found.real, found.imag])

        jacobian = jax.jacfwd(response)(values)
        return jnp.sum((jacobian @ covariance) * jacobian)

    return jax.vmap(one)(parameters, covariances, omega)
