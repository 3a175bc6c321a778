"""Refinement against the Cramér–Rao bound: accuracy, coverage of the intervals, and time.

Three plants: the common problem (black box from a subspace start), the reference two-link arm
(structured, sixteen parameters at seven operating points) and the reference mass–spring–damper.
Ratios are RMS errors over many noise realisations by the bound, computed from the linear model at
the true parameters without noise. `python -m benchmarks.refinement` prints all.
"""

import argparse
import time
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import dlsim

from benchmarks.subspace import BLOCK_ROWS, DECIBEL, DT, ORDER, fit_to_clean, plant, records
from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import PastInputMOESP, PastOutputMOESP, identify
from lpvid.mechanics import (
    OPERATING_POINTS,
    MassSpringDamper,
    add_noise,
    local_records,
    reference_two_link_arm,
    two_link_arm_structure,
)
from lpvid.models import AbstractStructure, MechanicalStructure, StateSpace, StructuredModel
from lpvid.refinement import refine
from lpvid.restructure import restructure_along


def _seconds(call, repeats=5):
    """First and least later wall seconds."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - start
    later = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        later.append(time.perf_counter() - start)
    return first, min(later)


def white_records(n, seed, *, feedthrough=True):
    """Input, clean and noisy output of the common problem, from rest; D as it is, or zero."""
    if feedthrough:
        u, clean, noisy = records(n, seed=seed)
        return u, clean, noisy[0]
    A, B, C, D = plant()
    rng = np.random.default_rng(seed)
    u = np.where(rng.standard_normal((n, 2)) > 0, 1.0, -1.0)
    clean = dlsim((A, B, C, 0.0 * D, 1.0), u)[1]
    noise = rng.standard_normal(clean.shape) * clean.std(axis=0) * 10 ** (-DECIBEL / 20)
    return u, clean, clean + noise


@partial(jax.jit, static_argnames=("feedthrough", "free_start"))
def _spread(u, noise, *, feedthrough, free_start):
    """Mean square error of each clean output at the Cramér–Rao bound."""
    parts = tuple(jnp.asarray(part) for part in plant())
    sizes = [part.size for part in parts[: 4 if feedthrough else 3]]

    def response(unknowns, x0):
        split = jnp.split(unknowns, np.cumsum(sizes)[:-1])
        entries = [part.reshape(like.shape) for part, like in zip(split, parts, strict=False)]
        A, B, C = entries[:3]
        D = entries[3] if feedthrough else None
        return StateSpace(A, B, C, D, dt=DT).simulate(u=u, x0=x0) / noise[None]

    truth = jnp.concatenate([part.reshape(-1) for part in parts])[: sum(sizes)]
    by_model, by_start = jax.jacfwd(response, argnums=(0, 1))(truth, jnp.zeros(ORDER))
    by_model = by_model.reshape(2 * u.shape[0], -1)
    by_start = by_start.reshape(2 * u.shape[0], -1)
    slope = jnp.concatenate([by_model, by_start], axis=1) if free_start else by_model
    # The basis of the state is left out by the pseudo-inverse.
    covariance = jnp.linalg.pinv(slope.T @ slope, rtol=1e-12, hermitian=True)
    covariance = covariance[: by_model.shape[1], : by_model.shape[1]]
    shares = jnp.einsum("ip,pq,iq->i", by_model, covariance, by_model).reshape(-1, 2)
    return jnp.mean(shares, axis=0) * noise**2


def fit_at_bound(u, clean, *, feedthrough, free_start):
    """Fit to the clean output that an efficient estimate has, in percent.

    Without a free start this is 1 − 10^(−30/20) √(p / (N ny)) for p unknowns: the fit is to the
    response from rest, so that a free start's own error does not count.
    """
    noise = jnp.asarray(clean.std(axis=0) * 10 ** (-DECIBEL / 20))
    spread = _spread(jnp.asarray(u), noise, feedthrough=feedthrough, free_start=free_start)
    return float(100 * (1 - np.mean(np.sqrt(spread) / clean.std(axis=0))))


def common_problem(*, n=3_000, seeds=range(100, 130), feedthrough=True, free_start=True):
    """Fit to the clean output of the subspace start and of its refinement, over seeds.

    Args:
        n: samples.
        seeds: of input and noise.
        feedthrough: the plant's D as it is, and estimated; otherwise zero, and known to be.
        free_start: whether the initial state is estimated; it is zero.
    """
    method = PastOutputMOESP(order=ORDER, block_rows=BLOCK_ROWS, feedthrough=feedthrough)
    initial_state = "free" if free_start else "zero"
    started, refined, bounds, statuses = [], [], [], []
    for seed in seeds:
        u, clean, noisy = white_records(n, seed, feedthrough=feedthrough)
        data = IOData(u=u, y=noisy, dt=DT)
        fit = identify(data, method)
        better = refine(fit, data, initial_state=initial_state, throw=False)
        started.append(fit_to_clean(_matrices(fit.model), u, clean))
        refined.append(fit_to_clean(_matrices(better.model), u, clean))
        bounds.append(fit_at_bound(u, clean, feedthrough=feedthrough, free_start=free_start))
        statuses.append(bool(better.status == Status.successful))
    u, _, noisy = white_records(n, seeds[0], feedthrough=feedthrough)
    data = IOData(u=u, y=noisy, dt=DT)
    fit = identify(data, method)
    first, later = _seconds(lambda: refine(fit, data, initial_state=initial_state, throw=False))
    return dict(
        start=float(np.median(started)),
        refined=float(np.median(refined)),
        least=float(np.min(refined)),
        expected_at_bound=float(np.median(bounds)),
        unknowns=ORDER * 4 + 4 * feedthrough + ORDER * free_start,
        first_seconds=first,
        seconds=later,
        successful=sum(statuses),
        fits=len(statuses),
    )


def _matrices(model: StateSpace):
    return model.A, model.B, model.C, model.D


@eqx.filter_jit
def cramer_rao(structure: AbstractStructure, parameters, u, dt, noise):
    """Covariance bound of the parameters, the initial state unknown too (it is zero)."""
    size = parameters.shape[0]
    nx = structure.matrices(parameters).nx

    def response(unknowns):
        model = structure.matrices(unknowns[:size])
        return model.simulate(u=u, dt=dt, x0=unknowns[size:]) / noise[None]

    start = jnp.concatenate([parameters, jnp.zeros(nx)])
    slope = jax.jacfwd(response)(start).reshape(-1, size + nx)
    scale = 1.0 / jnp.linalg.norm(slope, axis=0)
    slope = slope * scale[None]
    return (jnp.linalg.inv(slope.T @ slope) * scale[:, None] * scale[None])[:size, :size]


@eqx.filter_jit
def _many(start, data, clean, noise, keys):
    def one(key):
        y = clean + noise[None] * jax.random.normal(key, clean.shape, float)
        fit = refine(start, data.replace(y=y))
        return fit.parameters, fit.standard_errors, fit.status

    return jax.lax.map(one, keys)


def many_refinements(start: StructuredModel, data: IOData, clean, noise, key, count):
    """Parameters, standard errors and statuses of `count` noise realisations, in one loop."""
    return _many(start, data, jnp.asarray(clean), noise, jax.random.split(key, count))


def restructured_starts(every, points, decibel):
    """Models to start from: a record of their own noise identified, then restructured."""
    structure = two_link_arm_structure(lengths=(0.35, 0.30))
    method = PastInputMOESP(order=6, block_rows=60)
    black_boxes = []
    for point in points:
        data = every[point]
        noisy = data.replace(y=add_noise(jax.random.key(500 + point), data.y, decibel))
        black_boxes.append(identify(noisy, method).model)
    found = restructure_along(black_boxes, structure, key=jax.random.key(12))
    return [StructuredModel(structure, each.parameters) for each in found]


def arm(*, realisations=200, points=range(7), decibel=30.0):
    """Each operating point: RMS error over the bound and coverage, about both truths.

    Every realisation starts from the point's restructured model, found on other noise.
    """
    plant = reference_two_link_arm()
    structure = two_link_arm_structure(lengths=(0.35, 0.30))
    every = local_records(plant, jax.random.key(11)).records
    rows = []
    starts = restructured_starts(every, points, decibel)
    for point, start in zip(points, starts, strict=True):
        data = every[point]
        truth = plant.structured_parameters(OPERATING_POINTS[point])
        linear = jnp.asarray(StructuredModel(structure, truth).simulate(u=data.u, dt=data.dt))
        noise = jnp.std(data.y, axis=0) * 10 ** (-decibel / 20)
        bound = jnp.sqrt(jnp.diagonal(cramer_rao(structure, truth, data.u, data.dt, noise)))
        off = jnp.abs(start.parameters - truth) / bound
        row = dict(point=point, start=float(jnp.sqrt(jnp.mean(off**2))))
        for name, clean in (("linear", linear), ("nonlinear", data.y)):
            found, errors, status = many_refinements(
                start, data, clean, noise, jax.random.key(1000 + point), realisations
            )
            missed = np.asarray(found - truth[None])
            # Each parameter's RMS by its own bound, then all together.
            ratio = np.sqrt(np.mean(missed**2, axis=0)) / np.asarray(bound)
            inside = np.abs(missed) <= 1.959964 * np.asarray(errors)
            row |= {
                f"{name} ratio": float(np.sqrt(np.mean(ratio**2))),
                f"{name} worst": float(np.max(ratio)),
                f"{name} coverage": float(100 * np.mean(inside)),
                f"{name} successful": int(np.sum(status == Status.successful)),
            }
        rows.append(row)
    return rows


def random_steps(rng, n, dt):
    """Steps of 0.5 to 1 N that last 1 to 4 s, either sign, two inputs."""
    u = np.zeros((n, 2))
    for channel in range(2):
        at = 0
        while at < n:
            length = int(rng.uniform(1.0, 4.0) / dt)
            u[at : at + length, channel] = rng.uniform(0.5, 1.0) * rng.choice([-1.0, 1.0])
            at += length
    return u


def mass_spring_damper(*, realisations=100, n=20_000, dt=5e-3, sigma=3e-4, seed=21):
    """RMS relative Frobenius errors of M, D and K beside the bound's."""
    plant, structure = MassSpringDamper.reference(), MechanicalStructure(n_degrees=2)
    true = (plant.mass, plant.damping, plant.stiffness)
    truth = structure.parameters_of(*true)
    u = random_steps(np.random.default_rng(seed), n, dt)
    clean = jnp.asarray(plant.state_space().simulate(u=u, dt=dt))
    data = IOData(u=u, y=clean, dt=dt)
    noise = jnp.full(2, sigma)
    covariance = cramer_rao(structure, truth, data.u, dt, noise)

    def entries(parameters):
        return jnp.stack([m.reshape(-1) for m in structure.mechanical_matrices(parameters)])

    sizes = jnp.array([jnp.linalg.norm(m) for m in true])
    slope = jax.jacfwd(entries)(truth)
    bound = jnp.sqrt(jnp.einsum("kep,pq,keq->k", slope, covariance, slope)) / sizes
    start = StructuredModel(structure, truth + 0.05)
    found, _, _ = many_refinements(start, data, clean, noise, jax.random.key(seed), realisations)
    missed = jax.vmap(entries)(found) - entries(truth)[None]
    rms = jnp.sqrt(jnp.mean(jnp.sum(missed**2, axis=2), axis=0)) / sizes
    noisy = clean + sigma * jax.random.normal(jax.random.key(0), clean.shape, float)
    noisy = data.replace(y=noisy)
    first, later = _seconds(lambda: refine(start, noisy))
    return dict(
        bound=np.asarray(bound),
        rms=np.asarray(rms),
        ratio=np.asarray(rms / bound),
        first_seconds=first,
        seconds=later,
    )


COMMON = {
    "plant with D, D and x0 estimated": dict(),
    "plant with D, D estimated, from rest": dict(free_start=False),
    "plant without D, x0 estimated": dict(feedthrough=False),
    "plant without D, from rest": dict(feedthrough=False, free_start=False),
}


def main(arguments=None):
    """Print all figures."""
    parser = argparse.ArgumentParser(description="Refinement against the bound.")
    parser.add_argument("--realisations", type=int, default=60, help="of the noise, each plant")
    parser.add_argument("--seeds", type=int, default=30, help="of the common problem")
    given = parser.parse_args(arguments)
    for name, setting in COMMON.items():
        row = common_problem(seeds=range(100, 100 + given.seeds), **setting)
        print(
            f"common problem, N = 3000, {name}: start {row['start']:.3f} %, refined "
            f"{row['refined']:.3f} % (median of {row['fits']}, least {row['least']:.3f} %; "
            f"{row['unknowns']} unknowns, expected at the bound {row['expected_at_bound']:.3f} %); "
            f"{row['successful']} of {row['fits']} successful, "
            f"{1e3 * row['seconds']:.1f} ms a refinement",
            flush=True,
        )
    row = mass_spring_damper(realisations=given.realisations)
    for index, name in enumerate("MDK"):
        bound, rms, ratio = (np.asarray(row[key])[index] for key in ("bound", "rms", "ratio"))
        print(f"mass-spring-damper {name}: bound {bound:.2e}, RMS {rms:.2e}, ratio {ratio:.3f}")
    print(f"mass-spring-damper: {1e3 * row['seconds']:.0f} ms a refinement, N = 20000", flush=True)
    for row in arm(realisations=given.realisations):
        print(
            f"arm, point {row['point']}: restructured start {row['start']:.1f} bounds off; "
            f"RMS over the bound {row['linear ratio']:.3f} (worst "
            f"parameter {row['linear worst']:.3f}), coverage {row['linear coverage']:.1f} %; "
            f"nonlinear plant {row['nonlinear ratio']:.3f} ({row['nonlinear worst']:.3f}), "
            f"{row['nonlinear coverage']:.1f} %",
            flush=True,
        )


if __name__ == "__main__":
    main()
