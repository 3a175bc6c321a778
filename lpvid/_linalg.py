"""Matrix functions and equations: Lyapunov, Riccati, square root, exponential, logarithm.

Each takes matrices with any leading batch axes and returns matrices.
"""

import math
import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

_DOUBLINGS = 60
_RICCATI_DOUBLINGS = 50
_SQUARE_ROOTS = 4
_MOST_SQUARINGS = 18
# Within this size the Taylor polynomial of degree 16 is exact to rounding.
_TAYLOR_RADIUS = 0.78
_ROOT_ITERATIONS = 18
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


def batched(function: Callable, signature: str) -> Callable:
    """`function` over any leading axes, which broadcast; like `jnp.vectorize`.

    Missing leading axes are added explicitly, so that strict rank promotion may be on.

    Args:
        function: function of arrays with the core axes only.
        signature: core axes as in NumPy's generalised functions, e.g. `"(n,n),(n)->(n)"`.
    """
    inputs = re.findall(r"\(([^)]*)\)", signature.split("->")[0])
    core = [len(axes.split(",")) if axes else 0 for axes in inputs]
    vectorised = jnp.vectorize(function, signature=signature)

    def call(*arrays):
        leading = [array.ndim - n for array, n in zip(arrays, core, strict=True)]
        if not any(leading):
            return function(*arrays)
        padded = (
            array.reshape((1,) * (max(leading) - n) + array.shape)
            for array, n in zip(arrays, leading, strict=True)
        )
        return vectorised(*padded)

    return call


def _doubling(left: Array, right: Array, constant: Array) -> Array:
    """Σ_k leftᵏ Q rightᵏ by Smith's doubling; NaN where the sum does not converge."""

    def unfinished(carry):
        left, right, _, count = carry
        size = jnp.linalg.norm(left) * jnp.linalg.norm(right)
        # The remainder relative to the sum is below this product.
        return (count < _DOUBLINGS) & (size > 1e-18) & jnp.isfinite(size)

    def double(carry):
        left, right, total, count = carry
        return left @ left, right @ right, total + left @ total @ right, count + 1

    left, right, total, _ = lax.while_loop(unfinished, double, (left, right, constant, 0))
    size = jnp.linalg.norm(left) * jnp.linalg.norm(right)
    return jnp.where(size <= 1e-18, total, jnp.nan)


def _stein(left: Array, right: Array, constant: Array) -> Array:
    return lax.custom_linear_solve(
        lambda X: X - left @ X @ right,
        constant,
        solve=lambda _, Q: _doubling(left, right, Q),
        transpose_solve=lambda _, Q: _doubling(left.T, right.T, Q),
    )


@jax.jit
def stein(
    left: Float[Array, "*#batch n n"],
    right: Float[Array, "*#batch m m"],
    constant: Float[Array, "*#batch n m"],
) -> Float[Array, "*batch n m"]:
    """Solve X = F X G + Q by doubling (Smith 1968), with implicit derivatives of any order.

    Args:
        left: F; the product of the spectral radii of F and G must be below one, else NaN.
        right: G.
        constant: Q.
    """
    return batched(_stein, "(n,n),(m,m),(n,m)->(n,m)")(left, right, constant)


def discrete_lyapunov(
    A: Float[Array, "*#batch n n"], Q: Float[Array, "*#batch n n"]
) -> Float[Array, "*batch n n"]:
    """Solve X = A X Aᵀ + Q; NaN where A is not Schur stable.

    Args:
        A: square matrix.
        Q: constant term, symmetric or not.
    """
    return stein(A, A.mT, Q)


def _cayley(left: Array, right: Array, constant: Array) -> Array:
    n, m = left.shape[-1], right.shape[-1]
    # The geometric mean of the eigenvalues' sizes centres them on the unit disc; the solution
    # does not depend on it, so no derivative passes.
    _, log_determinant = jnp.linalg.slogdet(lax.stop_gradient(left))
    shift = jnp.exp(log_determinant / n)
    inverse_left = jnp.linalg.inv(shift * jnp.eye(n) - left)
    inverse_right = jnp.linalg.inv(shift * jnp.eye(m) - right)
    discrete_left = 2.0 * shift * inverse_left - jnp.eye(n)
    discrete_right = 2.0 * shift * inverse_right - jnp.eye(m)

    def solve(constant):
        transformed = 2.0 * shift * inverse_left @ constant @ inverse_right
        return _stein(discrete_left, discrete_right, transformed)

    solution = solve(constant)
    return solution + solve(left @ solution + solution @ right + constant)


@jax.jit
def continuous_sylvester(
    left: Float[Array, "*#batch n n"],
    right: Float[Array, "*#batch m m"],
    constant: Float[Array, "*#batch n m"],
) -> Float[Array, "*batch n m"]:
    """Solve F X + X G + Q = 0 for stable F and G, by a Cayley transform and doubling.

    With F_d = (α + F)(α − F)⁻¹, G_d likewise, X = F_d X G_d + 2 α (α − F)⁻¹ Q (α − G)⁻¹. One step
    of refinement on the residual recovers what the transform of a stiff problem loses.

    Args:
        left: F; NaN where F or G is not stable.
        right: G.
        constant: Q.
    """
    return batched(_cayley, "(n,n),(m,m),(n,m)->(n,m)")(left, right, constant)


def continuous_lyapunov(
    A: Float[Array, "*#batch n n"], Q: Float[Array, "*#batch n n"]
) -> Float[Array, "*batch n n"]:
    """Solve A X + X Aᵀ + Q = 0; NaN where A is not Hurwitz stable.

    Args:
        A: square matrix.
        Q: constant term, symmetric or not.
    """
    return continuous_sylvester(A, A.mT, Q)


def _excess(rates: Array) -> Array:
    edge, size = jnp.max(rates.real, axis=-1), jnp.abs(rates)
    # A margin of a tenth of the usual rate: on the very edge a Gramian is all one mode.
    size = jnp.maximum(size, 1e-3 * jnp.max(size, axis=-1, keepdims=True) + jnp.finfo(float).tiny)
    margin = 0.1 * jnp.exp(jnp.mean(jnp.log(size), axis=-1))
    stable = edge < -1e-3 * jnp.max(size, axis=-1)
    return lax.stop_gradient(jnp.where(stable, 0.0, jnp.maximum(edge + margin, 0.0)))


def excess_growth(A: Float[Array, "*batch n n"]) -> Float[Array, "*batch"]:
    """α ≥ 0 such that A − αI is Hurwitz stable with a margin; 0 where A itself is.

    Gramians of a model shifted so exist for an unstable one too, and a change of basis found from
    them is one of the model. A constant to derivatives.

    Args:
        A: square matrix.
    """
    return _excess(jnp.linalg.eigvals(lax.stop_gradient(A)))


def excess_radius(A: Float[Array, "*batch n n"]) -> Float[Array, "*batch"]:
    """ρ ≥ 1 such that A/ρ is Schur stable, with a margin; 1 where A itself is.

    Args:
        A: square matrix.
    """
    poles = jnp.linalg.eigvals(lax.stop_gradient(A))
    # A pole at zero (a delay) is as fast as can be; its rate is not finite.
    fast = jnp.abs(poles) > 1e-6
    rates = jnp.log(jnp.where(fast, poles, 1e-6))
    return jnp.exp(_excess(rates))


def _structured_doubling(A: Array, G: Array, H: Array) -> Array:
    """X = Aᵀ X (I + G X)⁻¹ A + H for H and G positive semidefinite, by doubling; NaN in failure."""
    identity = jnp.eye(A.shape[0])

    def unfinished(carry):
        A, _, _, count = carry
        size = jnp.linalg.norm(A)
        return (count < _RICCATI_DOUBLINGS) & (size > 1e-9) & jnp.isfinite(size)

    def double(carry):
        A, G, H, count = carry
        # (I + G H)⁻¹ [A, G] by one factorisation; H (I + G H)⁻¹ A is symmetric with the second.
        solved = jnp.linalg.solve(identity + G @ H, jnp.concatenate([A, G], axis=1))
        n = A.shape[0]
        forward, gain = solved[:, :n], solved[:, n:]
        G_next = G + A @ gain @ A.T
        H_next = H + A.T @ H @ forward
        return A @ forward, 0.5 * (G_next + G_next.T), 0.5 * (H_next + H_next.T), count + 1

    A, _, H, _ = lax.while_loop(unfinished, double, (A, G, H, 0))
    return jnp.where(jnp.linalg.norm(A) <= 1e-9, H, jnp.nan)


def _riccati(A: Array, C: Array, Q: Array, R: Array, S: Array) -> Array:
    gain = jnp.linalg.solve(R, S.T).T
    fixed = lax.stop_gradient((A - gain @ C, C.T @ jnp.linalg.solve(R, C), Q - gain @ S.T))
    closed, information, noise = fixed
    P = lax.stop_gradient(_structured_doubling(closed.T, information, 0.5 * (noise + noise.T)))
    # One Newton step, which has the derivatives: of the equation at its solution only the explicit
    # dependence counts, carried through the closed loop.
    cross = A @ P @ C.T + S
    K = jnp.linalg.solve(C @ P @ C.T + R, cross.T).T
    residual = A @ P @ A.T - P + Q - K @ cross.T
    stable = lax.stop_gradient(A - K @ C)
    P = P + _stein(stable, stable.T, 0.5 * (residual + residual.T))
    return 0.5 * (P + P.T)


@jax.jit
def discrete_riccati(
    A: Float[Array, "*#batch n n"],
    C: Float[Array, "*#batch m n"],
    Q: Float[Array, "*#batch n n"],
    R: Float[Array, "*#batch m m"],
    S: Float[Array, "*#batch n m"],
) -> Float[Array, "*batch n n"]:
    """Solve the filter's Riccati equation by structure-preserving doubling, any device.

    P = A P Aᵀ + Q − (A P Cᵀ + S)(C P Cᵀ + R)⁻¹(A P Cᵀ + S)ᵀ, the stabilising solution, for which
    A − K C is Schur stable with K = (A P Cᵀ + S)(C P Cᵀ + R)⁻¹ (Chu, Fan, Lin, Wang 2004,
    "Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations").
    NaN where there is none, or where it is nearer to the stability boundary than doubling reaches.
    First derivatives are those of the solution, by one Newton step on it.

    Args:
        A: state matrix.
        C: output matrix.
        Q: covariance of the state noise.
        R: covariance of the output noise, positive definite.
        S: covariance between them, with [[Q, S], [Sᵀ, R]] positive semidefinite.
    """
    return batched(_riccati, "(n,n),(m,n),(n,n),(m,m),(n,m)->(n,n)")(A, C, Q, R, S)


def _size(matrix: Array) -> Array:
    return jnp.max(jnp.sum(jnp.abs(matrix), axis=-2), axis=-1)


@jax.jit
def expm(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Exponential by scaling, a Taylor polynomial of degree 16 and squaring.

    Scaled by ‖A²‖^½ and ‖A³‖^⅓ where these are smaller than ‖A‖ (Al-Mohy and Higham 2011), which
    spares mechanical models, with their large stiffness entries, needless squarings. Products
    only: on batches of small matrices (one a sample in a varying model) 2 to 3 times faster than
    the Padé approximant of `jax.scipy.linalg.expm`, and more accurate on badly scaled ones.
    Squarings that no matrix of the batch needs are skipped, unless an outer `vmap` forbids it.
    NaN beyond 18 squarings.

    Args:
        matrix: square matrix.
    """
    identity = jnp.broadcast_to(jnp.eye(matrix.shape[-1]), matrix.shape)
    fixed = lax.stop_gradient(matrix)
    square = fixed @ fixed
    roots = jnp.maximum(jnp.sqrt(_size(square)), jnp.cbrt(_size(square @ fixed)))
    size = jnp.minimum(_size(fixed), roots)
    squarings = jnp.maximum(jnp.ceil(jnp.log2(jnp.maximum(size, 1e-300) / _TAYLOR_RADIUS)), 0.0)
    first = matrix * jnp.exp2(-squarings)[..., None, None]
    second = first @ first
    third, fourth = second @ first, second @ second

    def cubic(degree):
        a, b, c, d = (1.0 / math.factorial(degree + k) for k in range(4))
        return a * identity + b * first + c * second + d * third

    highest = cubic(12) + (1.0 / math.factorial(16)) * fourth
    start = cubic(0) + fourth @ (cubic(4) + fourth @ (cubic(8) + fourth @ highest))

    def square_where_needed(power, done):
        needed = done < squarings

        def advance(power):
            return jnp.where(needed[..., None, None], power @ power, power)

        return lax.cond(jnp.any(needed), advance, lambda power: power, power), None

    # A fixed count: reverse mode does not pass through a loop whose length depends on the data.
    counts = jnp.arange(_MOST_SQUARINGS, dtype=float)
    result, _ = lax.scan(square_where_needed, start, counts)
    return jnp.where((squarings <= _MOST_SQUARINGS)[..., None, None], result, jnp.nan)


def _sqrtm(matrix: Array) -> Array:
    n = matrix.shape[0]
    identity = jnp.eye(n)

    def iterate(carry, _):
        product, root = carry
        _, log_determinant = jnp.linalg.slogdet(lax.stop_gradient(product))
        scale = jnp.exp(-log_determinant / (2.0 * n))
        inverse = jnp.linalg.inv(product) / scale**2
        root = 0.5 * scale * (root + root @ inverse)
        product = 0.5 * (identity + 0.5 * (scale**2 * product + inverse))
        return (product, root), None

    (product, root), _ = lax.scan(iterate, (matrix, matrix), None, length=_ROOT_ITERATIONS)
    return jnp.where(jnp.max(jnp.abs(product - identity)) < 1e-6, root, jnp.nan)


@jax.jit
def sqrtm(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Principal square root by the product Denman–Beavers iteration (Higham 2008, eq. 6.29).

    The number of iterations is fixed, so that it differentiates and batches. NaN where an
    eigenvalue lies on the closed negative real axis (or so near that the iteration has not met
    its end).

    Args:
        matrix: square matrix.
    """
    return batched(_sqrtm, "(n,n)->(n,n)")(matrix)


def _logm(matrix: Array) -> Array:
    identity = jnp.eye(matrix.shape[0])

    def halve(carry, _):
        chosen, factor = carry
        far = jnp.linalg.norm(chosen - identity) > 0.5
        # Where the matrix is near already, the root of the identity keeps derivatives finite.
        root = _sqrtm(jnp.where(far, chosen, identity))
        return (jnp.where(far, root, chosen), jnp.where(far, 2.0 * factor, factor)), None

    start = (matrix, jnp.asarray(1.0))
    (chosen, factor), _ = lax.scan(halve, start, None, length=_SQUARE_ROOTS)
    excess = chosen - identity
    nodes = jnp.asarray(0.5 * (_NODES + 1.0))[:, None, None]
    weights = jnp.asarray(0.5 * _WEIGHTS)[:, None, None]
    right = jnp.broadcast_to(excess[None], (_NODES.size, *excess.shape))
    terms = jnp.linalg.solve(identity[None] + nodes * excess[None], right)
    return factor * jnp.sum(weights * terms, axis=0)


@jax.jit
def logm(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Principal logarithm by inverse scaling and squaring (Higham 2008, algorithm 11.9).

    log A = 2ᵏ log A^(1/2ᵏ), and log(I + E) = ∫₀¹ E (I + t E)⁻¹ dt by 16 Gauss–Legendre nodes,
    which is the diagonal Padé approximant of degree 16. Of the roots k = 0 … 4 the first near
    enough to the identity is taken: each further root loses a bit to cancellation. Fixed counts:
    it differentiates and batches. NaN where an eigenvalue lies on the closed negative real axis.

    Args:
        matrix: square matrix.
    """
    return batched(_logm, "(n,n)->(n,n)")(matrix)
