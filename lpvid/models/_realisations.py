"""Gramians, and balanced and modal realisations."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid._linalg import continuous_lyapunov, discrete_lyapunov
from lpvid.models._state_space import StateSpace

# Eigenvectors worse conditioned than this stand for a matrix that has too few of them.
_EIGENVECTOR_CONDITION = 1e10


def gramians(
    system: StateSpace,
) -> tuple[Float[Array, "*batch nx nx"], Float[Array, "*batch nx nx"]]:
    """Controllability and observability Gramians of a stable model, in that order.

    Solutions of A P + P Aᵀ + B Bᵀ = 0 and Aᵀ Q + Q A + Cᵀ C = 0, or of P = A P Aᵀ + B Bᵀ and
    Q = Aᵀ Q A + Cᵀ C in discrete time. Differentiable; NaN for an unstable model.

    Example:
        >>> from lpvid.models import StateSpace, gramians
        >>> gramians(StateSpace([[-1.0]], [[1.0]], [[1.0]]))[0].item()
        0.5
    """
    solve = discrete_lyapunov if system.is_discrete else continuous_lyapunov
    A, B, C = system.A, system.B, system.C
    return solve(A, B @ B.mT), solve(A.mT, C.mT @ C)


def _square_root_factor(gramian: Array) -> Array:
    # Not Cholesky: a Gramian may be singular to rounding where a state hardly takes part.
    values, vectors = jnp.linalg.eigh(0.5 * (gramian + gramian.mT))
    return vectors * jnp.sqrt(jnp.clip(values, 0.0))[..., None, :]


def balancing(
    system: StateSpace,
) -> tuple[Float[Array, "*batch nx nx"], Float[Array, "*batch nx nx"], Float[Array, "*batch nx"]]:
    """Transformation to balanced states, its inverse, and the Hankel singular values."""
    controllability, observability = (_square_root_factor(g) for g in gramians(system))
    left, values, right = jnp.linalg.svd(observability.mT @ controllability)
    scale = 1.0 / jnp.sqrt(values)
    forward = scale[..., :, None] * (left.mT @ observability.mT)
    backward = (controllability @ right.mT) * scale[..., None, :]
    rows = forward @ system.B
    largest = jnp.argmax(jnp.abs(rows), axis=-1, keepdims=True)
    sign = jnp.where(jnp.take_along_axis(rows, largest, axis=-1) < 0.0, -1.0, 1.0)
    return forward * sign, backward * sign.mT, values


@jax.jit
def balance(system: StateSpace) -> tuple[StateSpace, Float[Array, "*batch nx"]]:
    """Balanced realisation of a stable, minimal model, and its Hankel singular values.

    Both Gramians become the diagonal matrix of Hankel singular values, largest first (Laub et al.
    1987, square-root method). Sign convention: in each row of B the entry of largest magnitude is
    positive. Where two Hankel singular values nearly agree the basis may rotate freely between
    their states, so never average balanced matrices of noisy models; see `average`.

    Differentiable where Gramian eigenvalues and Hankel singular values are distinct; NaN for an
    unstable model, not finite for one that is not minimal.

    Example:
        >>> from lpvid.models import StateSpace, balance
        >>> balanced, hankel = balance(StateSpace([[-1.0]], [[4.0]], [[1.0]]))
        >>> round(hankel.item(), 6), round(balanced.B.item(), 6)
        (2.0, 2.0)
    """
    forward, backward, values = balancing(system)
    balanced = StateSpace(
        forward @ system.A @ backward, forward @ system.B, system.C @ backward, system.D, system.dt
    )
    return balanced, values


def modal_form(system: StateSpace) -> StateSpace:
    """Real block-diagonal realisation, [[σ, ω], [−ω, σ]] for a pole pair σ ± jω.

    Real poles have blocks of one; blocks are sorted by natural frequency. Each eigenvector v is
    scaled so that its row of the modal B and its column C v have equal norms, and turned so that
    the entry of C v of largest modulus is real and positive.

    Eigenvectors do not differentiate in JAX and the block structure depends on the numbers: this
    runs eagerly, outside `jit`, `vmap` and `grad`. A batch of models is taken one by one.

    Raises:
        ValueError: called on traced matrices, or A has (nearly) too few eigenvectors, as with a
            double integrator.

    Example:
        >>> from lpvid.models import StateSpace, modal_form
        >>> modal_form(StateSpace([[0.0, 1.0], [-5.0, -2.0]], [[0.0], [1.0]], [[1.0, 0.0]])).A
        Array([[-1.,  2.],
               [-2., -1.]], dtype=float64)
    """
    if isinstance(system.A, Tracer):
        raise ValueError("modal_form needs numbers: call it outside jit, vmap and grad.")
    flat = [np.asarray(m).reshape(-1, *m.shape[-2:]) for m in (system.A, system.B, system.C)]
    forms = [_modal_matrices(*each) for each in zip(*flat, strict=True)]
    A, B, C = (np.reshape(m, (*system.batch_shape, *m[0].shape)) for m in zip(*forms, strict=True))
    return StateSpace(A, B, C, system.D, dt=system.dt)


def _modal_matrices(
    A: np.ndarray, B: np.ndarray, C: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    poles, vectors = np.linalg.eig(A)
    if not np.linalg.cond(vectors) < _EIGENVECTOR_CONDITION:
        raise ValueError(
            "A has repeated poles with too few eigenvectors (a double integrator, say), so there "
            "is no modal form; use balance() for a stable model."
        )
    rows = np.linalg.solve(vectors, B.astype(complex))
    columns = C @ vectors
    blocks, inputs, outputs = [], [], []
    # One of each conjugate pair; the sort is stable so that equal frequencies keep their order.
    for k in np.argsort(np.abs(poles), kind="stable"):
        pole = complex(poles[k])
        if pole.imag < 0.0:
            continue
        row, column = rows[k], columns[:, k]
        sizes = np.linalg.norm(row), np.linalg.norm(column)
        scale = np.sqrt(sizes[0] / sizes[1]) if min(sizes) > 0.0 else 1.0
        largest = column[np.argmax(np.abs(column))] if sizes[1] > 0.0 else 1.0
        scale = scale * np.abs(largest) / largest
        row, column = row / scale, column * scale
        if pole.imag == 0.0:
            blocks.append(np.array([[pole.real]]))
            inputs.append(np.real(row)[None])
            outputs.append(np.real(column)[:, None])
        else:
            blocks.append(np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
            root = np.sqrt(2.0)
            inputs.append(root * np.stack([np.real(row), -np.imag(row)]))
            outputs.append(root * np.stack([np.real(column), np.imag(column)], axis=1))
    diagonal = np.zeros_like(A)
    start = 0
    for block in blocks:
        stop = start + block.shape[0]
        diagonal[start:stop, start:stop] = block
        start = stop
    return diagonal, np.concatenate(inputs), np.concatenate(outputs, axis=1)
