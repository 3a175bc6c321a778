"""Level sets of the largest singular value: which frequencies reach a given gain.

Two routes to the same frequencies. `secular_frequencies` works on the partial fractions and needs
one eigenproblem of size n; `certify_by_hamiltonian` is the general one of size 2n (Boyd and
Balakrishnan 1990, Bruinsma and Steinbuch 1990).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lpvid._types import Scalar
from lpvid.analysis._eigensolvers import AbstractEigensolver
from lpvid.analysis._modal import Modal, reciprocal, reduced_form, response, squared_gain


def secular_frequencies(
    form: Modal, level: Scalar, eigensolver: AbstractEigensolver
) -> tuple[Float[Array, " nx"], Bool[Array, ""]]:
    """Frequencies around which the gain can reach `level`, and whether they can be trusted.

    f(x) = det(level^2 I - G(-s)^T G(s)) is even in s and rational in x = s^2 with simple poles at
    lambda_k^2:  f = f_inf + sum_k rho_k / (x - lambda_k^2). Its zeros are the eigenvalues of a
    diagonal plus rank-one matrix of size n, half that of the Hamiltonian; those at x = -omega^2 are
    the frequencies where a singular value equals the level. By the rank-one residues of G,

        rho_k = 2 lambda_k det [[level^2 I - G(-lambda_k)^T G_k(lambda_k), h_k], [b_k^T, 0]],

    where G_k is G without its k-th fraction and h_k = G(-lambda_k)^T c_k.
    """
    poles = form.poles
    nx, nu = form.inputs.shape
    ny = form.D.shape[0]
    eye = jnp.eye(nx, dtype=bool)
    minus = reciprocal(-poles[:, None] - poles[None, :])
    gap = jnp.where(eye, 1.0, poles[:, None] - poles[None, :])
    plus = jnp.where(eye, 0.0, reciprocal(gap))
    both = jnp.concatenate([minus, plus]) @ form.residues
    both = both.reshape(2, nx, ny, nu) + form.D[None, None].astype(both.dtype)
    mirrored = both[0]
    heads = jnp.sum(mirrored * form.outputs[:, :, None], axis=1)
    # Bordered determinant without LU for the usual one and two inputs.
    core = -jnp.sum(mirrored[:, :, :, None] * both[1][:, :, None, :], axis=1)
    core = core + (level * level * jnp.eye(nu))[None].astype(core.dtype)
    b = form.inputs
    if nu == 1:
        bordered = -heads[:, 0] * b[:, 0]
    elif nu == 2:
        h0, h1, b0, b1 = heads[:, 0], heads[:, 1], b[:, 0], b[:, 1]
        bordered = -(
            core[:, 1, 1] * h0 * b0
            - core[:, 0, 1] * h1 * b0
            - core[:, 1, 0] * h0 * b1
            + core[:, 0, 0] * h1 * b1
        )
    else:
        right = jnp.concatenate([core, b[:, None, :]], axis=1)
        corner = jnp.concatenate([heads, jnp.zeros_like(heads[:, :1])], axis=1)
        bordered = jnp.linalg.det(jnp.concatenate([right, corner[:, :, None]], axis=2))
    rho = 2.0 * poles * bordered
    squares = poles * poles
    direct = level * level * jnp.eye(nu) - form.D.T @ form.D
    if nu == 1:
        limit = direct[0, 0]
    elif nu == 2:
        limit = direct[0, 0] * direct[1, 1] - direct[0, 1] * direct[1, 0]
    else:
        limit = jnp.linalg.det(direct)

    roots, complete = eigensolver.zeros(limit, rho, poles)

    # Check what was computed: every root has to be one.
    inverse = reciprocal(roots[:, None] - squares[None, :])
    terms = inverse * rho[None, :]
    value = limit.astype(terms.dtype) + jnp.sum(terms, axis=1)
    slope = jnp.sum(terms * inverse, axis=1)
    error = jnp.abs(value) <= 1e-6 * jnp.maximum(
        jnp.abs(slope) * jnp.abs(roots), 1e-6 * (jnp.abs(limit) + jnp.sum(jnp.abs(terms), axis=1))
    )
    sound = jnp.all(error) & complete & (limit > 0.0)
    return jnp.sqrt(jnp.maximum(-roots.real, 0.0)), sound


def between(omega: Float[Array, " frequency"]) -> Float[Array, " frequency"]:
    """Midpoints of the sorted frequencies, the first counted from zero."""
    ordered = jnp.sort(omega)
    previous = jnp.concatenate([jnp.zeros(1), ordered[:-1]])
    return 0.5 * (ordered + previous)


def sweep_modal(
    form: Modal, gain: Scalar, tolerance: float, noise: Scalar, eigensolver: AbstractEigensolver
) -> tuple[Scalar, Scalar, Bool[Array, ""]]:
    """The highest gain, and its frequency, between the frequencies that reach `gain`.

    The last value says whether the frequencies could be trusted.
    """
    crossings, sound = secular_frequencies(form, gain * (1.0 + tolerance) + noise, eigensolver)
    trial = between(crossings)
    gains = squared_gain(response(form, trial))
    best = jnp.argmax(gains)
    return jnp.sqrt(gains[best]), trial[best], sound


def hamiltonian(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    D: Float[Array, "ny nu"],
    level: Scalar,
) -> Float[Array, "twice twice"]:
    """The matrix with an eigenvalue j omega exactly where a singular value of G equals `level`."""
    C, D = C / level, D / level
    cross = jnp.linalg.solve(jnp.eye(D.shape[1]) - D.T @ D, jnp.concatenate([B.T, D.T @ C], axis=1))
    inputs, coupling = cross[:, : B.shape[0]], cross[:, B.shape[0] :]
    shifted = A + B @ coupling
    outputs = C.T @ (C + D @ coupling)
    return jnp.block([[shifted, B @ inputs], [-outputs, -shifted.T]])


def certify_by_hamiltonian(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    D: Float[Array, "ny nu"],
    gain: Scalar,
    omega: Scalar,
    tolerance: float,
    noise: Scalar,
    eigensolver: AbstractEigensolver,
    max_steps: int = 40,
) -> tuple[Scalar, Bool[Array, ""]]:
    """Raise `gain`, attained at `omega`, until no frequency exceeds it by `tolerance` and `noise`.

    Returns the frequency of the highest gain, and whether the search came to its end.

    No eigenvalue is ever judged to lie "on" the imaginary axis: the gain is evaluated between the
    imaginary parts of all of them, so a crossing that rounding pushed off the axis still counts.
    """
    scale_b, scale_c = jnp.sqrt(jnp.sum(B * B)), jnp.sqrt(jnp.sum(C * C))
    scale_b = jnp.where(scale_b > 0.0, scale_b, 1.0)
    scale_c = jnp.where(scale_c > 0.0, scale_c, 1.0)
    size = scale_b * scale_c
    B, C, D = B / scale_b, C / scale_c, D / size
    # Where the peak is at infinity I - D^T D / gain^2 is singular at the level. s -> 1/s maps the
    # axis onto itself and brings G(0) to infinity, which is better if the gain there is smaller.
    inverse = jnp.linalg.inv(A)
    static = -inverse @ B
    at_zero = D + C @ static
    ends = jnp.sqrt(squared_gain(jnp.stack([D, at_zero]).astype(complex)))
    flip = (ends[0] > 0.9 * gain / size) & (ends[1] < ends[0])
    A, B, C, D = (
        jnp.where(flip, new, old)
        for new, old in ((inverse, A), (-static, B), (C @ (-inverse), C), (at_zero, D))
    )
    omega = jnp.where(flip, 1.0 / omega, omega)
    form = reduced_form(A, B, C, D, eigensolver)

    def sweep(carry):
        gain, omega, _, steps, _ = carry
        level = gain * (1.0 + tolerance) + noise / size + 1e-30
        roots, complete = eigensolver.eigenvalues(hamiltonian(A, B, C, D, level))
        crossings = jnp.abs(roots.imag)
        trial = between(jnp.where(jnp.isfinite(crossings), crossings, 0.0))
        gains = squared_gain(response(form, trial))
        best = jnp.argmax(gains)
        reached = jnp.sqrt(gains[best])
        higher = reached > level
        return (
            jnp.where(higher, reached, gain),
            jnp.where(higher, trial[best], omega),
            ~higher,
            steps + 1,
            complete,
        )

    start = (gain / size, omega, jnp.array(False), jnp.array(0), jnp.array(True))
    _, omega, ended, _, complete = lax.while_loop(
        lambda carry: ~carry[2] & (carry[3] < max_steps), sweep, start
    )
    return jnp.where(flip, 1.0 / omega, omega), ended & complete
