"""Frequency responses of one system at many frequencies, with their first two derivatives.

The state matrix is factorised once; each frequency then costs O(n) (modal form) or, with LAPACK's
Schur form, O(n^2) instead of one LU factorisation.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float

from lpvid._types import Scalar
from lpvid.analysis._eigensolvers import AbstractEigensolver


class Modal(NamedTuple):
    """Partial fractions G(s) = D + sum_k R_k / (s - lambda_k), with R_k = output_k input_k^T."""

    poles: Complex[Array, " nx"]
    inputs: Complex[Array, "nx nu"]
    outputs: Complex[Array, "nx ny"]
    residues: Complex[Array, "nx ports"]
    D: Float[Array, "ny nu"]
    conditioning: Scalar


class Reduced(NamedTuple):
    """G(s) = D + C (s - T)^-1 B in unitary coordinates: exists for defective matrices too."""

    T: Complex[Array, "nx nx"]
    B: Complex[Array, "nx nu"]
    C: Complex[Array, "ny nx"]
    D: Float[Array, "ny nu"]
    eigensolver: AbstractEigensolver


def reciprocal(value: Complex[Array, "..."]) -> Complex[Array, "..."]:
    """1 / value in real arithmetic; XLA's own complex division does not vectorise on a CPU."""
    real, imag = value.real, value.imag
    scale = 1.0 / (real * real + imag * imag)
    return lax.complex(real * scale, -imag * scale)


def modal_form(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    D: Float[Array, "ny nu"],
    eigensolver: AbstractEigensolver,
) -> Modal:
    """Diagonalise A. Where it is defective the result is garbage and `conditioning` is huge."""
    nx = A.shape[0]
    poles, vectors = eigensolver.eigenvectors(A)
    # An exactly singular eigenvector matrix gives infinities, which `trustworthy` refuses.
    inputs = jnp.linalg.solve(vectors, B.astype(vectors.dtype))
    outputs = (C.astype(vectors.dtype) @ vectors).T
    residues = (outputs[:, :, None] * inputs[:, None, :]).reshape(nx, -1)
    # What diagonalising loses: ||V|| ||V^-1 B|| against ||B|| (V's columns have unit length).
    growth = jnp.sqrt(nx * jnp.sum(jnp.abs(inputs) ** 2))
    size = jnp.sqrt(jnp.sum(B * B))
    conditioning = jnp.where(size > 0.0, growth / jnp.where(size > 0.0, size, 1.0), 1.0)
    return Modal(poles, inputs, outputs, residues, D, conditioning)


def reduced_form(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    D: Float[Array, "ny nu"],
    eigensolver: AbstractEigensolver,
) -> Reduced:
    """Reduce A once to what the eigensolver solves with."""
    T, Q = eigensolver.reduce(A)
    return Reduced(T, Q.conj().T @ B.astype(T.dtype), C.astype(T.dtype) @ Q, D, eigensolver)


def jets(
    form: Modal, omega: Float[Array, " frequency"]
) -> tuple[Complex[Array, "frequency ny nu"], ...]:
    """G(j omega) and its first and second derivatives with respect to omega."""
    shape = (3, omega.shape[0], *form.D.shape)
    first = reciprocal(lax.complex(-form.poles.real[None], omega[:, None] - form.poles.imag[None]))
    second = first * first
    powers = jnp.concatenate([first, -1j * second, -2.0 * (second * first)])
    terms = (powers @ form.residues).reshape(shape)
    return terms[0] + form.D[None].astype(terms.dtype), terms[1], terms[2]


def response(
    form: Modal | Reduced, omega: Float[Array, " frequency"]
) -> Complex[Array, "frequency ny nu"]:
    """G(j omega)."""
    ny, nu = form.D.shape
    count = omega.shape[0]
    if isinstance(form, Modal):
        terms = reciprocal(
            lax.complex(-form.poles.real[None], omega[:, None] - form.poles.imag[None])
        )
        varying = (terms @ form.residues).reshape(count, ny, nu)
    else:
        nx = form.T.shape[0]
        shift = omega[:, None, None] * jnp.eye(nx)[None]
        pencils = lax.complex(jnp.zeros_like(shift), shift) - form.T[None]
        inputs = jnp.broadcast_to(form.B, (count, nx, nu))
        varying = form.C[None] @ form.eigensolver.solve(pencils, inputs)
    return varying + form.D[None].astype(varying.dtype)


def squared_gain(G: Complex[Array, "frequency ny nu"]) -> Float[Array, " frequency"]:
    """Largest eigenvalue of G^H G, closed form for one or two inputs (give the short side last)."""
    nu = G.shape[-1]
    columns = jnp.sum(G.real**2 + G.imag**2, axis=-2)
    if nu == 1:
        return columns[:, 0]
    if nu == 2:
        a, c = columns[:, 0], columns[:, 1]
        b = jnp.sum(G[:, :, 0].conj() * G[:, :, 1], axis=1)
        return 0.5 * (a + c + jnp.sqrt((a - c) ** 2 + 4.0 * (b.real**2 + b.imag**2)))
    return jnp.linalg.svd(G, compute_uv=False)[:, 0] ** 2


def squared_gain_jet(
    form: Modal, omega: Float[Array, " frequency"]
) -> tuple[Float[Array, " frequency"], ...]:
    """Largest eigenvalue of G^H G with its first and second derivative along omega."""
    G, dG, ddG = jets(form, omega)
    nu = G.shape[-1]
    if nu <= 2:
        return _closed_form_jet(G, dG, ddG)

    def gram(left, right):
        return jnp.einsum("kij,kil->kjl", left.conj(), right)

    cross, twice = gram(dG, G), gram(ddG, G)
    first = cross + jnp.swapaxes(cross.conj(), 1, 2)
    second = twice + jnp.swapaxes(twice.conj(), 1, 2) + 2.0 * gram(dG, dG)
    values, vectors = jnp.linalg.eigh(gram(G, G))
    top = vectors[:, :, -1]
    coupling = jnp.einsum("kij,kil,kl->kj", vectors.conj(), first, top)
    gaps = values[:, -1:] - values[:, :-1]
    push = jnp.abs(coupling[:, :-1]) ** 2 / jnp.where(gaps > 0.0, gaps, 1.0)
    push = jnp.sum(jnp.where(gaps > 0.0, push, 0.0), axis=1)
    curvature = jnp.einsum("ki,kij,kj->k", top.conj(), second, top).real + 2.0 * push
    return values[:, -1], coupling[:, -1].real, curvature


def _closed_form_jet(G, dG, ddG):
    """The jet of the larger root of the 2 x 2 characteristic polynomial (or of |G|^2)."""
    column = jnp.sum(G.real**2 + G.imag**2, axis=1)
    slope = 2.0 * jnp.sum(G.real * dG.real + G.imag * dG.imag, axis=1)
    bend = 2.0 * jnp.sum(dG.real**2 + dG.imag**2 + G.real * ddG.real + G.imag * ddG.imag, axis=1)
    if G.shape[-1] == 1:
        return column[:, 0], slope[:, 0], bend[:, 0]
    x, y, dx, dy, ddx, ddy = (
        G[:, :, 0],
        G[:, :, 1],
        dG[:, :, 0],
        dG[:, :, 1],
        ddG[:, :, 0],
        ddG[:, :, 1],
    )
    b = jnp.sum(x.conj() * y, axis=1)
    db = jnp.sum(dx.conj() * y + x.conj() * dy, axis=1)
    ddb = jnp.sum(ddx.conj() * y + 2.0 * (dx.conj() * dy) + x.conj() * ddy, axis=1)
    e, de, dde = (v[:, 0] - v[:, 1] for v in (column, slope, bend))
    root = jnp.sqrt(e**2 + 4.0 * (b.real**2 + b.imag**2))
    safe = jnp.where(root > 0.0, root, 1.0)
    droot = (e * de + 4.0 * (b.real * db.real + b.imag * db.imag)) / safe
    ddroot = (
        de**2
        + e * dde
        + 4.0 * (db.real**2 + db.imag**2 + b.real * ddb.real + b.imag * ddb.imag)
        - droot**2
    ) / safe
    return tuple(
        0.5 * (v[:, 0] + v[:, 1] + w) for v, w in ((column, root), (slope, droot), (bend, ddroot))
    )


def refine_peaks(
    form: Modal,
    omega: Float[Array, " peak"],
    width: Float[Array, " peak"],
    steps: int,
) -> tuple[Float[Array, " peak"], Float[Array, " peak"]]:
    """Climb from every frequency to its local maximum of the gain by safeguarded Newton steps.

    Returns the frequencies and the squared gains there; a gain never decreases. `width` is the
    longest first step, about the half-power width of the mode.
    """

    def advance(_, carry):
        omega, width, gain, slope, bend = carry
        concave = bend < 0.0
        uphill = jnp.where(slope >= 0.0, jnp.inf, -jnp.inf)
        newton = jnp.where(concave, -slope / jnp.where(concave, bend, 1.0), uphill)
        step = jnp.clip(newton, -width, width)
        # The gain is even in omega, so a step across zero is reflected.
        trial = jnp.abs(omega + step)
        jet = squared_gain_jet(form, trial)
        better = jet[0] > gain
        width = jnp.where(better, 2.0 * width, 0.25 * jnp.abs(step))
        old = (omega, gain, slope, bend)
        new = (trial, *jet)
        omega, *kept = (jnp.where(better, n, o) for n, o in zip(new, old, strict=True))
        return omega, width, *kept

    # The first pass only evaluates: a flat parabola under an empty gain makes no step.
    none = jnp.zeros_like(omega)
    start = (omega, 0.5 * width, none - jnp.inf, none, none - 1.0)
    omega, _, gain, _, _ = lax.fori_loop(0, steps + 1, advance, start)
    return omega, gain


def trustworthy(form: Modal) -> Bool[Array, ""]:
    """Whether the partial fractions keep at least about eleven digits."""
    finite = jnp.all(jnp.isfinite(form.residues.real)) & jnp.all(jnp.isfinite(form.residues.imag))
    return finite & (form.conditioning < 1e5)


def rounding(form: Modal) -> Scalar:
    """Size of the gain's rounding errors: below it nothing can be told apart from zero."""
    size = jnp.sqrt(jnp.sum(form.residues.real**2 + form.residues.imag**2, axis=1))
    rate = jnp.abs(form.poles.real)
    noise = jnp.sum(size / jnp.where(rate > 0.0, rate, 1.0))
    return 1e-15 * jnp.where(trustworthy(form), noise, 0.0)
