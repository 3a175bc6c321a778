"""Equation 7 of 001: parameters and similarity transformation by least squares on the matrices."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from lpvid._linalg import continuous_lyapunov, excess_growth
from lpvid._solve import Bounds, least_squares
from lpvid.models import AbstractStructure, StateSpace

Parameters = Float[Array, " parameter"]


class Weights(NamedTuple):
    """How the black box and the structure are measured, so that no choice of basis counts.

    By equation 11 the error of the response is the sum of the three matrix errors seen through
    the black box's outputs and the structure's states: square roots of their Gramians.
    """

    outputs: Float[Array, "own own"]
    states: Float[Array, "nx nx"]
    time: Float[Array, ""]


def similarity_search(
    structure: AbstractStructure, start: Parameters, black_box: StateSpace, max_steps: int
) -> Parameters:
    """ϑ that minimises ‖𝔄T − TA(ϑ)‖² + ‖𝔅 − TB(ϑ)‖² + ‖ℭT − C(ϑ)‖² over ϑ and T, from one start.

    The cost is quadratic in T alone: its minimum over T is put in, and Levenberg–Marquardt
    searches ϑ within its bounds. That meets the same minima as steps in T and ϑ by turns and
    does not crawl along their valley. T need not be square: a black box of another order is met
    as far as its states can be mapped. D, outside the equation, joins with the error of D.

    Source: 001, equation 7, weighted as equation 11 has it.
    """
    bounds = Bounds(*structure.bounds())
    weights = _weights(structure.matrices(start), black_box)

    def residual(free):
        model = structure.matrices(bounds.bounded(free))
        return _residual(model, black_box, weights)

    found = least_squares(residual, bounds.free(start), max_steps=max_steps)
    return bounds.bounded(found.value)


def linear_conditions(
    structure: AbstractStructure, start: Parameters, black_box: StateSpace
) -> Parameters:
    """ϑ from the entries of the structure that hold no parameter, which are linear in T (34).

    With ẋ = A(ϑ)x in the states T𝔵: a row of A without parameters gives A_k T = (T𝔄)_k, an entry
    of B or a row of C likewise. T is the solution of least norm; ϑ is then fitted to T𝔄T⁻¹, T𝔅
    and ℭT⁻¹. `start` only says which entries vary, and where a structure that is not affine is
    linearised. Exact where the conditions fix T, which those of (32) do not.

    Source: 001, equation 34.
    """
    nx, own = structure.matrices(start).nx, black_box.nx

    def entries(parameters):
        model = structure.matrices(parameters)
        return model.A, model.B, model.C

    A, B, C = entries(start)
    varies = [jnp.any(m != 0.0, axis=-1) for m in jax.jacfwd(entries)(start)]
    rows = jnp.where(jnp.any(varies[0], axis=1), 0.0, 1.0)
    inputs = jnp.where(varies[1], 0.0, 1.0)
    outputs = jnp.where(jnp.any(varies[2], axis=1), 0.0, 1.0)
    rate = _rate(black_box)

    def conditions(flat):
        T = flat.reshape(nx, own)
        dynamics = rows[:, None] * (T @ black_box.A - A @ T) / rate
        return jnp.concatenate(
            [
                dynamics.reshape(-1),
                (inputs * (T @ black_box.B)).reshape(-1),
                (outputs[:, None] * (C @ T)).reshape(-1),
            ]
        )

    right = [jnp.zeros(nx * own), (inputs * B).reshape(-1)]
    right.append((outputs[:, None] * black_box.C).reshape(-1))
    matrix = jax.jacfwd(conditions)(jnp.zeros(nx * own))
    T = jnp.linalg.lstsq(matrix, jnp.concatenate(right))[0].reshape(nx, own)
    # Not its inverse: the T of least norm may be singular.
    inverse = jnp.linalg.pinv(T, rtol=1e-8)
    wanted = (T @ black_box.A @ inverse, T @ black_box.B, black_box.C @ inverse)
    size = [jnp.linalg.norm(m) + jnp.finfo(float).tiny for m in wanted]

    def misfit(parameters):
        parts = zip(entries(parameters), wanted, size, strict=True)
        return jnp.concatenate([((m - w) / s).reshape(-1) for m, w, s in parts])

    bounds = Bounds(*structure.bounds())
    found = least_squares(
        lambda free: misfit(bounds.bounded(free)), bounds.free(start), max_steps=20
    )
    return bounds.bounded(found.value)


def _residual(model: StateSpace, black_box: StateSpace, weights: Weights) -> Array:
    """The residual of equation 7 with the best T put in."""
    own, nx = black_box.nx, model.nx
    left, right, time = weights
    # vec of rows: (X ⊗ Yᵀ) vec(T) = vec(X T Y).
    dynamics = jnp.kron(left @ black_box.A, right.T) - jnp.kron(left, (model.A @ right).T)
    inputs = jnp.kron(left, model.B.T)
    outputs = jnp.kron(black_box.C, right.T)
    # A trace of T itself keeps the columns independent where the black box is not minimal.
    trace = 1e-10 * jnp.linalg.norm(black_box.C) * jnp.eye(own * nx)
    matrix = jnp.concatenate([dynamics * time, inputs, outputs, trace])
    known = [jnp.zeros(own * nx), (left @ black_box.B).reshape(-1)]
    known += [(model.C @ right).reshape(-1), jnp.zeros(own * nx)]
    known = jnp.concatenate(known)
    Q, R = jnp.linalg.qr(matrix)
    T = solve_triangular(R, Q.T @ known)
    return jnp.concatenate([matrix @ T - known, (model.D - black_box.D).reshape(-1)])


def _weights(model: StateSpace, black_box: StateSpace) -> Weights:
    A, B = _decaying(model.A), model.B
    states = _root(continuous_lyapunov(A, B @ B.T))
    A, C = _decaying(black_box.A), black_box.C
    outputs = _root(continuous_lyapunov(A.T, C.T @ C)).T
    return Weights(outputs, states, jnp.sqrt(1.0 / _rate(black_box)))


def _root(gramian: Array) -> Array:
    values, vectors = jnp.linalg.eigh(0.5 * (gramian + gramian.T))
    # A state that is hardly seen still has its equation.
    floor = 1e-10 * jnp.max(values) + jnp.finfo(float).tiny
    return vectors * jnp.sqrt(jnp.maximum(values, floor))[None]


def _decaying(A: Array) -> Array:
    """A − αI: stable, so that an unstable model has its Gramians too."""
    return A - excess_growth(A) * jnp.eye(A.shape[0])


def _rate(black_box: StateSpace) -> Float[Array, ""]:
    size = jnp.abs(black_box.poles())
    return jnp.exp(jnp.mean(jnp.log(jnp.maximum(size, 1e-3 * jnp.max(size) + 1e-300))))
