"""From the covariance of parameters to that of what is computed from them (delta method)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from lpvid.analysis._predict import Numbers
from lpvid.models import StateSpace


class ResponseUncertainty(eqx.Module):
    """A frequency response and how well it is known; see `frequency_response_covariance`.

    Attributes:
        omega: frequencies in rad/s, (frequency,).
        response: G(jω), (frequency, ny, nu).
        covariance: of (Re G, Im G), (frequency, ny, nu, 2, 2).
    """

    omega: Float[Array, " frequency"]
    response: Complex[Array, "frequency ny nu"]
    covariance: Float[Array, "frequency ny nu 2 2"]

    @property
    def magnitude_std(self) -> Float[Array, "frequency ny nu"]:
        """Standard deviation of |G|: that along G, and the larger one where G is zero."""
        size = jnp.abs(self.response)
        found = jnp.sqrt(self._along(jnp.stack([self.response.real, self.response.imag], axis=-1)))
        return jnp.where(size > 0.0, found, jnp.sqrt(_larger_eigenvalue(self.covariance)))

    @property
    def phase_std(self) -> Float[Array, "frequency ny nu"]:
        """Standard deviation of the phase in rad; infinite where G is zero."""
        size = jnp.abs(self.response)
        across = self._along(jnp.stack([-self.response.imag, self.response.real], axis=-1))
        return jnp.where(size > 0.0, jnp.sqrt(across) / jnp.where(size > 0.0, size, 1.0), jnp.inf)

    def _along(self, direction: Array) -> Array:
        """Variance in the direction of a vector."""
        square = jnp.sum(direction**2, axis=-1)
        raw = jnp.einsum("...a,...ab,...b->...", direction, self.covariance, direction)
        return jnp.maximum(raw / jnp.where(square > 0.0, square, 1.0), 0.0)


class PoleUncertainty(eqx.Module):
    """Poles and how well they are known, sorted by natural frequency; see `pole_covariance`.

    Attributes:
        poles: in s, or in z for a discrete-time model, (nx,).
        covariance: of (Re, Im) of each, (nx, 2, 2); a real pole moves along the real axis alone.
        frequency: natural frequency |s| in rad/s, with s = log(z) / dt in discrete time, (nx,).
        frequency_std: its standard deviation, (nx,).
        damping: damping ratio −Re s / |s|, (nx,).
        damping_std: its standard deviation, (nx,).
    """

    poles: Complex[Array, " nx"]
    covariance: Float[Array, "nx 2 2"]
    frequency: Float[Array, " nx"]
    frequency_std: Float[Array, " nx"]
    damping: Float[Array, " nx"]
    damping_std: Float[Array, " nx"]


def propagate(
    function: Callable[[Array], Array], parameters: Numbers, covariance: Numbers
) -> tuple[Float[Array, "*value"], Float[Array, "*value_value"]]:
    r"""Value of a function of estimated parameters, and its covariance $J P J^T$ (delta method).

    The Jacobian J is taken in forward mode. First order: right where the function is close to
    linear over the parameters' uncertainty. Works under `jit`, `vmap` and `grad`.

    Args:
        function: from parameters (p,) to a real array of any shape.
        parameters: estimates, (p,).
        covariance: theirs, (p, p).

    Returns:
        The value, and its covariance with the value's axes twice: () for a scalar, (m, m) for a
        vector, (a, b, a, b) for a matrix.

    Raises:
        ValueError: shapes that do not fit, or a complex value.

    Example:
        >>> import jax.numpy as jnp
        >>> from lpvid.analysis import propagate
        >>> value, variance = propagate(jnp.prod, [2.0, 3.0], [[0.01, 0.0], [0.0, 0.04]])
        >>> value.item(), round(variance.item(), 6)
        (6.0, 0.25)
    """
    theta, P = jnp.asarray(parameters, float), jnp.asarray(covariance, float)
    if theta.ndim != 1 or P.shape != (theta.shape[0], theta.shape[0]):
        raise ValueError(
            f"covariance has shape {P.shape} for parameters of shape {theta.shape}; (p, p) for "
            "(p,) is needed."
        )

    def real(values):
        found = jnp.asarray(function(values))
        if not jnp.issubdtype(found.dtype, jnp.floating):
            raise ValueError(
                f"function returns {found.dtype} numbers; return real ones, of a complex value the "
                "real and the imaginary part."
            )
        return found, found

    jacobian, value = jax.jacfwd(real, has_aux=True)(theta)
    return value, jnp.tensordot(jnp.tensordot(jacobian, P, 1), jacobian, (-1, -1))


def frequency_response_covariance(
    model_at: Callable[[Array], Any],
    parameters: Numbers,
    covariance: Numbers,
    omega: Numbers,
) -> ResponseUncertainty:
    """Frequency response with the covariance of its real and imaginary parts.

    Each frequency and channel on its own, as confidence bands need it. Works under `jit`, `vmap`.

    Args:
        model_at: from parameters (p,) to a model: a `StateSpace`, or something whose `state_space`
            is one (`Refined.model_at`).
        parameters: estimates, (p,).
        covariance: theirs, (p, p).
        omega: frequencies in rad/s, (frequency,).

    Returns:
        The response and its covariance.

    Raises:
        ValueError: shapes that do not fit, or a model that is no single `StateSpace`.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import frequency_response_covariance
        >>> from lpvid.models import StateSpace
        >>> def lag(p):
        ...     return StateSpace([[-p[0]]], [[p[0]]], [[1.0]])
        >>> known = frequency_response_covariance(lag, [2.0], [[0.01]], [0.0, 2.0])
        >>> known.magnitude_std[:, 0, 0].round(4).tolist()
        [0.0, 0.0177]
    """
    grid = jnp.atleast_1d(jnp.asarray(omega, float))
    theta, P = jnp.asarray(parameters, float), jnp.asarray(covariance, float)

    value, own = _spread_of(model_at)(_response_parts, model_at, theta, P, grid)
    return ResponseUncertainty(grid, jax.lax.complex(value[..., 0], value[..., 1]), own)


def pole_covariance(
    model_at: Callable[[Array], Any], parameters: Numbers, covariance: Numbers
) -> PoleUncertainty:
    """Poles, natural frequencies and damping ratios with their uncertainty.

    First order in the parameters; not finite where poles coincide, since those split like a root.
    Works under `jit` and `vmap`, on a CPU (eigenvalues of a general matrix).

    Args:
        model_at: as for `frequency_response_covariance`.
        parameters: estimates, (p,).
        covariance: theirs, (p, p).

    Returns:
        Poles with a real 2 x 2 covariance each, frequencies and dampings with standard deviations.

    Raises:
        ValueError: as `frequency_response_covariance`.

    Example:
        >>> from lpvid.analysis import pole_covariance
        >>> from lpvid.models import StateSpace
        >>> def oscillator(p):
        ...     return StateSpace([[0.0, 1.0], [-p[0], -p[1]]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> known = pole_covariance(oscillator, [4.0, 0.2], [[0.0016, 0.0], [0.0, 0.0004]])
        >>> known.frequency.round(6).tolist(), known.frequency_std.round(6).tolist()
        ([2.0, 2.0], [0.01, 0.01])
        >>> round(known.damping_std[0].item(), 5)
        0.00501
    """
    theta, P = jnp.asarray(parameters, float), jnp.asarray(covariance, float)

    value, all_four = _spread_of(model_at)(_pole_parts, model_at, theta, P, None)
    std = jnp.sqrt(jnp.maximum(jnp.diagonal(all_four, axis1=1, axis2=2), 0.0))
    return PoleUncertainty(
        poles=jax.lax.complex(value[:, 0], value[:, 1]),
        covariance=all_four[:, :2, :2],
        frequency=value[:, 2],
        frequency_std=std[:, 2],
        damping=value[:, 3],
        damping_std=std[:, 3],
    )


def state_space_of(item: Any) -> StateSpace:
    """The one state-space model that something is or has as `state_space`.

    Raises:
        ValueError: there is none, or a batch.
    """
    model = getattr(item, "state_space", item)
    if not isinstance(model, StateSpace) or model.A.ndim != 2:
        raise ValueError(
            f"model_at: returns a {type(item).__name__}; one StateSpace is needed, or something "
            "that has it as state_space."
        )
    return model


def _spread_of(model_at: Callable) -> Callable:
    """`_spread`, compiled where a compiled one can be used again without being out of date.

    A method of an `eqx.Module` carries all it depends on; a plain function may read what changes.
    """
    return _spread if jax.tree.leaves(model_at) == [model_at] else _compiled_spread


def _spread(parts, model_at, theta: Array, P: Array, extra) -> tuple[Array, Array]:
    """Parts of a model along the last axis, and the covariance of each group of them."""
    if theta.ndim != 1 or P.shape != (theta.shape[0], theta.shape[0]):
        raise ValueError(
            f"covariance has shape {P.shape} for parameters of shape {theta.shape}; (p, p) for "
            "(p,) is needed."
        )

    def found(values):
        return (parts(state_space_of(model_at(values)), extra),) * 2

    # The covariance between groups, which nobody asks for, is never formed.
    jacobian, value = jax.jacfwd(found, has_aux=True)(theta)
    return value, jnp.einsum("...ap,pq,...bq->...ab", jacobian, P, jacobian)


_compiled_spread = eqx.filter_jit(_spread)


def _response_parts(model: StateSpace, omega: Array) -> Array:
    response = model.frequency_response(omega)
    return jnp.stack([response.real, response.imag], axis=-1)


def _pole_parts(model: StateSpace, _: None) -> Array:
    """Real and imaginary part, natural frequency and damping ratio of each pole."""
    found = model.poles()
    plane = jnp.log(found) / model.dt if model.is_discrete else found
    # By frequency, the upper of a pair first; rounding must not part a pair.
    size = jnp.abs(plane)
    order = jnp.lexsort((-found.imag, jnp.round(size / jnp.max(size) * 1e9)))
    found, plane, size = found[order], plane[order], size[order]
    damping = -plane.real / jnp.where(size > 0.0, size, 1.0)
    return jnp.stack([found.real, found.imag, size, damping], axis=-1)


def _larger_eigenvalue(covariance: Float[Array, "*batch 2 2"]) -> Float[Array, "*batch"]:
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return 0.5 * (a + c + jnp.sqrt((a - c) ** 2 + 4.0 * b**2))
