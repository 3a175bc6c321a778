"""Refinement against the Cramér–Rao bound: accuracy, coverage of the intervals, and time.

Three plants: the common problem (black box from a subspace start), the reference two-link arm
(structured, sixteen parameters at seven operating points) and the reference mass–spring–damper.
Ratios are RMS errors over many noise realisations by the bound, computed from the linear model at
the true parameters without noise. `python -m benchmarks.refinement` prints all.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.subspace import BLOCK_ROWS, DT, ORDER, fit_to_clean, records
from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import PastOutputMOESP, identify
from lpvid.mechanics import (
    OPERATING_POINTS,
    MassSpringDamper,
    local_records,
    reference_two_link_arm,
    two_link_arm_structure,
)
from lpvid.models import AbstractStructure, MechanicalStructure, StateSpace, StructuredModel
from lpvid.refinement import refine


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


def common_problem(*, n=3_000, seeds=range(100, 140)):
    """Fit to the clean output of the subspace start and of its refinement, over seeds."""
    method = PastOutputMOESP(order=ORDER, block_rows=BLOCK_ROWS)
    started, refined, statuses = [], [], []
    for seed in seeds:
        u, clean, noisy = records(n, seed=seed)
        data = IOData(u=u, y=noisy[0], dt=DT)
        fit = identify(data, method)
        better = refine(fit, data, throw=False)
        started.append(fit_to_clean(_matrices(fit.model), u, clean))
        refined.append(fit_to_clean(_matrices(better.model), u, clean))
        statuses.append(bool(better.status == Status.successful))
    first, later = _seconds(lambda: refine(fit, data, throw=False))
    # White noise at 30 dB: each of the p unknowns takes its share of σ² / (N ny).
    unknowns = ORDER * (2 + 2) + 4 + ORDER
    bound = 100 * (1 - 10 ** (-30 / 20) * np.sqrt(unknowns / (2 * n)))
    return dict(
        start=float(np.median(started)),
        refined=float(np.median(refined)),
        expected_at_bound=float(bound),
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


def many_refinements(start: StructuredModel, data: IOData, clean, noise, key, count):
    """Parameters, standard errors and statuses of `count` noise realisations, in one loop."""

    @jax.jit
    def run(keys):
        def one(key):
            y = clean + noise[None] * jax.random.normal(key, clean.shape, float)
            fit = refine(start, data.replace(y=y))
            return fit.parameters, fit.standard_errors, fit.status

        return jax.lax.map(one, keys)

    return run(jax.random.split(key, count))


def arm(*, realisations=200, points=range(7), decibel=30.0, spread=0.01):
    """Each operating point: RMS error over the bound and coverage, about both truths."""
    plant = reference_two_link_arm()
    structure = two_link_arm_structure(lengths=(0.35, 0.30))
    every = local_records(plant, jax.random.key(11)).records
    rows = []
    for point in points:
        data = every[point]
        truth = plant.structured_parameters(OPERATING_POINTS[point])
        linear = jnp.asarray(StructuredModel(structure, truth).simulate(u=data.u, dt=data.dt))
        noise = jnp.std(data.y, axis=0) * 10 ** (-decibel / 20)
        bound = jnp.sqrt(jnp.diagonal(cramer_rao(structure, truth, data.u, data.dt, noise)))
        scatter = 1.0 + spread * jax.random.normal(jax.random.key(point), truth.shape, float)
        start = StructuredModel(structure, truth * scatter)
        row = dict(point=point)
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


def main():
    """Print all figures."""
    row = common_problem()
    print(
        f"common problem, N = 3000: start {row['start']:.3f} %, refined {row['refined']:.3f} % "
        f"(median of {row['fits']}; expected at the bound {row['expected_at_bound']:.3f} %), "
        f"{1e3 * row['seconds']:.1f} ms a refinement"
    )
    row = mass_spring_damper()
    for name, bound, rms, ratio in zip("MDK", row["bound"], row["rms"], row["ratio"], strict=True):
        print(f"mass-spring-damper {name}: bound {bound:.2e}, RMS {rms:.2e}, ratio {ratio:.3f}")
    print(f"mass-spring-damper: {1e3 * row['seconds']:.0f} ms a refinement, N = 20000")
    for row in arm():
        print(
            f"arm, point {row['point']}: RMS over the bound {row['linear ratio']:.3f} (worst "
            f"parameter {row['linear worst']:.3f}), coverage {row['linear coverage']:.1f} %; "
            f"nonlinear plant {row['nonlinear ratio']:.3f} ({row['nonlinear worst']:.3f}), "
            f"{row['nonlinear coverage']:.1f} %"
        )


if __name__ == "__main__":
    main()
