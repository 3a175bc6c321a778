"""Every candidate's remaining matrices from the simulation error, and what it leaves unexplained.

Time is counted in samples and channels have unit RMS throughout; A and C come from the subspace
step. Candidates are taken one after the other, so memory does not grow with their number.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._linalg import expm
from lpvid.identify._linear_fit import solve, solve_positive
from lpvid.identify._simulation_error import NormalEquations, record_equations
from lpvid.identify.gray_box._cone import (
    definite_least_squares,
    nearest_semidefinite,
    symmetric_basis,
)

# Shares of the largest eigenvalue: M must be invertible and K definite; D may be singular.
_LEAST_MASS = 1e-9
_LEAST_STIFFNESS = 1e-9


def held(A: Float[Array, "nx nx"]) -> tuple[Float[Array, "nx nx"], Float[Array, "nx nx"]]:
    """exp(A) and its integral from 0 to 1, by which B is multiplied in a zero-order hold."""
    nx = A.shape[0]
    augmented = jnp.zeros((2 * nx, 2 * nx)).at[:nx, :nx].set(A).at[:nx, nx:].set(jnp.eye(nx))
    exponential = expm(augmented)
    return exponential[:nx, :nx], exponential[:nx, nx:]


@functools.partial(jax.jit, static_argnames="lengths")
def _equations(As, Cs, u, y, *, lengths) -> tuple[Array, NormalEquations]:
    """What B is multiplied by in a hold, and the normal equations, of every candidate.

    A function of its own, so that all uses share one compilation.
    """

    def one(pair):
        A, C = pair
        transition, integral = held(A)
        return integral, record_equations(transition, C, u, y, lengths)

    return jax.lax.map(one, (As, Cs))


def black_boxes(
    As: Float[Array, "candidate nx nx"],
    Cs: Float[Array, "candidate ny nx"],
    u: Float[Array, "time nu"],
    y: Float[Array, "time ny"],
    *,
    feedthrough: bool,
    lengths: tuple[int, ...],
) -> dict[str, Array]:
    """A, B, C, D, x0 and the residual (sum of squares of each output) of every candidate."""
    integrals, equations = _equations(As, Cs, u, y, lengths=lengths)
    found = _black_boxes(integrals, equations, feedthrough=feedthrough)
    return {"A": As, "C": Cs, **found}


@functools.partial(jax.jit, static_argnames="feedthrough")
def _black_boxes(integrals, equations, *, feedthrough):
    def one(integral, equation):
        linear = solve(equation, nx=integral.shape[0], feedthrough=feedthrough)
        B = jnp.linalg.solve(integral, linear.B)
        return {"B": B, "D": linear.D, "x0": linear.x0, "residual": linear.residual}

    return jax.vmap(one)(integrals, equations)


def mechanical(
    As: Float[Array, "candidate nx nx"],
    Cs: Float[Array, "candidate dof nx"],
    u: Float[Array, "time dof"],
    y: Float[Array, "time dof"],
    input_scale: Float[Array, " dof"],
    output_scale: Float[Array, " dof"],
    *,
    lengths: tuple[int, ...],
) -> dict[str, Array]:
    """M, D, K, x0 and the residual of every candidate: sections II-B and C of 000 after A and C.

    Args:
        As: state matrices.
        Cs: output matrices.
        u: inputs of unit RMS.
        y: outputs of unit RMS.
        input_scale: RMS of the inputs, relative to one another.
        output_scale: RMS of the outputs, relative to one another.
        lengths: samples in each record.

    Returns:
        By name. M, D and K carry the relative scales of inputs and outputs, so they are symmetric;
        x0 is [y, ẏ] for outputs of unit RMS.
    """
    n = y.shape[1]
    positions = jnp.broadcast_to(jnp.eye(n, 2 * n)[None], (As.shape[0], n, 2 * n))
    companions = _companions(As, Cs)
    integrals, equations = _equations(companions, positions, u, y, lengths=lengths)
    found, final, B2 = _structured(companions, integrals, equations, input_scale, output_scale)
    integrals, equations = _equations(final, positions, u, y, lengths=lengths)
    x0, residual = _scores(integrals, B2, equations)
    return {**found, "x0": x0, "residual": residual}


@jax.jit
@jax.vmap
def _companions(A, C):
    """A in the states [y, ẏ], by T = [C; C A]."""
    T = jnp.concatenate([C, C @ A])
    accelerations = jnp.linalg.solve(T.T, (C @ A @ A).T).T
    return _companion(accelerations)


def _companion(lower):
    n = lower.shape[0]
    return jnp.concatenate([jnp.eye(n, 2 * n, n), lower])


@jax.jit
def _structured(companions, integrals, equations, input_scale, output_scale):
    """M, D and K, and with them A and the lower block of B anew."""
    n = output_scale.shape[0]
    inverse = 1.0 / output_scale
    # A congruence with the outputs' scales keeps B2 symmetric and definite: B2 = S_y X S_y.
    columns = jnp.asarray(symmetric_basis(n)) * (output_scale * input_scale)[None, None, :]

    def physical(matrix):
        return output_scale[:, None] * matrix * inverse[None, :]

    def one(A, integral, equation):
        X, mass_clipped = _input_block(integral, columns, equation)
        mass = inverse[:, None] * jnp.linalg.inv(X) * inverse[None, :]
        mass = 0.5 * (mass + mass.T)
        stiffness, stiffness_clipped = nearest_semidefinite(
            -mass @ physical(A[n:, :n]), _LEAST_STIFFNESS
        )
        damping, damping_clipped = nearest_semidefinite(-mass @ physical(A[n:, n:]))
        moved = jnp.concatenate([-stiffness, -damping, jnp.eye(n)], axis=1)
        moved = inverse[:, None] * jnp.linalg.solve(mass, moved)
        scales = jnp.concatenate([output_scale, output_scale, input_scale])
        moved = moved * scales[None, :]
        found = dict(
            mass=mass,
            damping=damping,
            stiffness=stiffness,
            mass_clipped=mass_clipped,
            damping_clipped=damping_clipped,
            stiffness_clipped=stiffness_clipped,
        )
        return found, _companion(moved[:, : 2 * n]), moved[:, 2 * n :]

    return jax.vmap(one)(companions, integrals, equations)


def _input_block(integral, columns, equations):
    """X of B2 = Σ_k X_k `columns`_k by least squares over the definite cone, x0 eliminated."""
    n, nx = columns.shape[1], integral.shape[0]
    matrix, right = jnp.sum(equations.matrix, axis=1), jnp.sum(equations.right, axis=1)
    discrete = jnp.einsum("xi,kij->kjx", integral[:, n:], columns)
    place = jnp.pad(discrete, ((0, 0), (0, 0), (0, 1))).reshape(columns.shape[0], -1)
    known = place.shape[1]
    place = jnp.pad(place, ((0, 0), (0, matrix.shape[1] - known)))
    start = slice(known, known + nx)

    def reduce(square, value):
        along = place @ square
        coupling = along[:, start]
        sides = jnp.concatenate([coupling.T, value[start][:, None]], axis=1)
        solved = solve_positive(square[start, start], sides)
        normal = along @ place.T - coupling @ solved[:, :-1]
        return normal, place @ value - coupling @ solved[:, -1]

    normals, sides = jax.vmap(reduce)(matrix, right)
    return definite_least_squares(jnp.sum(normals, axis=0), jnp.sum(sides, axis=0), n, _LEAST_MASS)


@jax.jit
@jax.vmap
def _scores(integral, B2, equations):
    """x0 of every record for a given model, and each output's sum of squared errors."""
    n, nx = B2.shape[0], integral.shape[0]
    known = jnp.pad((integral[:, n:] @ B2).T, ((0, 0), (0, 1))).reshape(-1)
    split = known.shape[0]
    start = slice(split, split + nx)

    def initial(square, value):
        left = value[start] - square[start, :split] @ known
        return solve_positive(square[start, start], left[:, None])[:, 0]

    x0 = jax.vmap(initial)(jnp.sum(equations.matrix, axis=1), jnp.sum(equations.right, axis=1))
    common = jnp.broadcast_to(known[None], (x0.shape[0], split))
    theta = jnp.concatenate([common, x0, jnp.zeros((x0.shape[0], 1))], axis=1)
    squares = jnp.einsum("re,rkef,rf->k", theta, equations.matrix, theta)
    products = jnp.einsum("re,rke->k", theta, equations.right)
    residual = squares - 2.0 * products + jnp.sum(equations.power, axis=0)
    # Rounding may leave a little less than nothing.
    return x0, jnp.maximum(residual, 0.0)
