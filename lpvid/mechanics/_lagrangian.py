"""From energies to motion: equations of motion, a fixed-step integrator, a linearisation.

With kinetic energy T(q, q̇) quadratic in q̇ and potential energy V(q), Lagrange's equations read

    M(q) q̈ = Q + ∂(T − V)/∂q − (∂²T/∂q̇∂q) q̇,        M = ∂²T/∂q̇²,

and every derivative is taken by JAX from the two energies alone. Q are the generalised forces.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from lpvid.models import StateSpace, runge_kutta_step

KineticEnergy: TypeAlias = Callable[[Array, Array, Any], Array]
PotentialEnergy: TypeAlias = Callable[[Array, Any], Array]
Dynamics: TypeAlias = Callable[[Array, Array], Array]


def inertia_matrix(
    kinetic_energy: KineticEnergy, positions: Float[Array, " dof"], params: Any
) -> Float[Array, "dof dof"]:
    """Mass matrix M(q) = ∂²T/∂q̇², exact because T is quadratic in the velocities.

    Args:
        kinetic_energy: T(q, q̇, params) in J.
        positions: generalised coordinates q (dof,).
        params: whatever the energies take as their last argument; any pytree.

    Example:
        >>> inertia_matrix(lambda q, v, m: 0.5 * m * (v @ v), jnp.zeros(2), 3.0)
        Array([[3., 0.],
               [0., 3.]], dtype=float64)
    """
    return jax.hessian(kinetic_energy, 1)(positions, jnp.zeros_like(positions), params)


def accelerations(
    kinetic_energy: KineticEnergy,
    potential_energy: PotentialEnergy,
    positions: Float[Array, " dof"],
    velocities: Float[Array, " dof"],
    forces: Float[Array, " dof"],
    params: Any,
) -> Float[Array, " dof"]:
    """Accelerations q̈ from the energies; composes with jit, vmap and grad.

    Args:
        kinetic_energy: T(q, q̇, params) in J, quadratic in q̇ with a positive definite Hessian.
        potential_energy: V(q, params) in J.
        positions: generalised coordinates q (dof,).
        velocities: their rates q̇ (dof,).
        forces: generalised forces Q (dof,), whatever does not come from V.
        params: passed on to both energies; any pytree.

    Example:
        >>> def kinetic(q, qd, length):
        ...     return 0.5 * length**2 * (qd @ qd)
        >>> def potential(q, length):
        ...     return -9.81 * length * jnp.cos(q[0])
        >>> still = jnp.zeros(1)
        >>> accelerations(kinetic, potential, jnp.array([0.1]), still, still, 2.0)
        Array([-0.48968...], dtype=float64)
    """

    dof = positions.shape[0]

    def slopes(q, qd):
        return jax.grad(kinetic_energy, (0, 1))(q, qd, params)

    def directional(q_direction, qd_direction):
        return jax.jvp(slopes, (positions, velocities), (q_direction, qd_direction))

    # One pass for all of T's derivatives: along each velocity (the columns of M) and, last,
    # along the motion (the momenta's drift); ∂T/∂q comes with it.
    (push, _), (_, columns) = jax.vmap(directional, out_axes=(None, 0))(
        jnp.concatenate([jnp.zeros((dof, dof)), velocities[None]]),
        jnp.eye(dof + 1, dof),
    )
    right = forces + push - jax.grad(potential_energy)(positions, params) - columns[dof]
    return _cholesky_solve(columns[:dof], right)


def integrate(
    dynamics: Dynamics,
    start: Float[Array, " state"],
    inputs: Float[Array, "time input"],
    dt: ArrayLike,
    *,
    substeps: int = 1,
    every: int = 1,
) -> Float[Array, "outputs state"]:
    """Integrate ẋ = f(x, u) by the classical Runge–Kutta rule, u held over each sample.

    The rule is of fourth order and stable while |λ| dt / substeps < 2.61 for the fastest pole λ; a
    non-finite state means that `substeps` is too low. Differentiable in everything that is not
    static; reverse mode keeps one state per returned sample and recomputes the rest. Compiled as
    two nested `lax.scan` loops whatever the length; wrap repeated calls in `jit`.

    Args:
        dynamics: f(x, u) with x (state,) and u (input,).
        start: state at the first sample (state,).
        inputs: u (time, input), constant from one sample to the next.
        dt: sample time, s.
        substeps: integrator's steps per sample.
        every: return every `every`-th state only; must divide the number of samples.

    Returns:
        States (time / every, state) at samples 0, every, 2·every, …: each one before the input
        of its sample acts.

    Raises:
        ValueError: if `substeps` or `every` is below one or `every` does not divide the record.

    Example:
        >>> integrate(lambda x, u: u - x, jnp.zeros(1), jnp.ones((4, 1)), 0.1, every=2)
        Array([[0.       ],
               [0.1812691]], dtype=float64)
    """
    samples = inputs.shape[0]
    if substeps < 1 or every < 1:
        raise ValueError(f"substeps={substeps} and every={every} must be at least 1.")
    if samples % every:
        raise ValueError(
            f"every={every} does not divide the {samples} samples of inputs: "
            f"cut the record to {samples // every * every} samples."
        )
    step = jnp.asarray(dt, float) / substeps

    def sample(state, held):
        def substep(state, _):
            return runge_kutta_step(dynamics, state, held, step), None

        # A loop of one step would cost a loop's overhead a hundred thousand times.
        if substeps == 1:
            return substep(state, None)
        return jax.lax.scan(substep, state, length=substeps)

    @jax.checkpoint
    def block(state, held):
        return jax.lax.scan(sample, state, held)[0]

    def output(state, held):
        return block(state, held), state

    return jax.lax.scan(output, start, inputs.reshape(samples // every, every, -1))[1]


def linearise(
    dynamics: Dynamics,
    output: Dynamics,
    state: Float[Array, " state"],
    inputs: Float[Array, " input"],
) -> StateSpace:
    """Continuous-time Jacobian linearisation of ẋ = f(x, u), y = h(x, u) by `jax.jacfwd`.

    Args:
        dynamics: f(x, u).
        output: h(x, u).
        state: x (state,) where to linearise; an equilibrium for the result to be a model of small
            motions.
        inputs: u (input,) there.

    Example:
        >>> linearise(lambda x, u: -x**2 + u, lambda x, u: x, jnp.ones(1), jnp.ones(1)).A
        Array([[-2.]], dtype=float64)
    """
    a, b = jax.jacfwd(dynamics, (0, 1))(state, inputs)
    c, d = jax.jacfwd(output, (0, 1))(state, inputs)
    return StateSpace(a, b, c, d)


def _cholesky_solve(matrix: Array, right: Array) -> Array:
    # Written out entry by entry: for a few degrees of freedom XLA fuses this into one kernel over
    # the batch, where a library call per matrix and step would dominate the integration.
    size = right.shape[0]
    factor = [[matrix[0, 0]] * size for _ in range(size)]
    inverse_pivot, forward = [], []
    for i in range(size):
        for j in range(i):
            dot = sum(factor[i][k] * factor[j][k] for k in range(j))
            factor[i][j] = (matrix[i, j] - dot) * inverse_pivot[j]
        inverse_pivot.append(jax.lax.rsqrt(matrix[i, i] - sum(factor[i][k] ** 2 for k in range(i))))
        dot = sum(factor[i][k] * forward[k] for k in range(i))
        forward.append((right[i] - dot) * inverse_pivot[i])
    solution = [forward[0]] * size
    for i in reversed(range(size)):
        dot = sum(factor[k][i] * solution[k] for k in range(i + 1, size))
        solution[i] = (forward[i] - dot) * inverse_pivot[i]
    return jnp.stack(solution)
