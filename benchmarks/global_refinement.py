"""Global refinement of the two-link arm on all raw records at once, against the Cramér–Rao bound.

The seven local records of Vizer et al. (2015), and one sweep of its own for the second half, with
30 dB of white noise. Two kinds of model: the physical parameters (densities, stiffnesses, inertias,
masses and gains, one gain known), and the polynomial coefficients of structure (32). The
polynomials are scored on another, noise-free sweep, beside the analytic model interpolated the same
way.

    python -m benchmarks.global_refinement [--realisations N] [--seeds N]
"""

import os

# One BLAS thread, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import lpvid as lv
from lpvid.data import IOData, join
from lpvid.mechanics import (
    OPERATING_POINTS,
    add_noise,
    local_records,
    reference_two_link_arm,
    sweep_record,
    two_link_arm_gray_box,
    two_link_arm_structure,
)
from lpvid.models import GrayBoxLPV, LPVStateSpace

DECIBEL = 30.0
KNOWN = "velocity gain 1"
METHOD = lv.PastInputMOESP(order=6, block_rows=60)


def noisy(records: IOData, key) -> IOData:
    """The records with white noise, each by its own level."""
    keys = jax.random.split(key, len(records.lengths))
    return join(
        [
            record.replace(y=add_noise(each, record.y, DECIBEL))
            for record, each in zip(records.records, keys, strict=True)
        ]
    )


@eqx.filter_jit
def bound_of(model: GrayBoxLPV, data: IOData, free: np.ndarray, noise) -> jax.Array:
    """Standard deviations of the free parameters at the bound, initial states unknown."""
    size = free.size
    total = jnp.zeros((size, size))
    for record, level in zip(data.records, noise, strict=True):

        def response(unknowns, record=record, level=level):
            parameters = model.parameters.at[free].set(unknowns[:size])
            arm = model.function(parameters, record.kappa[0]).discretise(data.dt)
            return arm.simulate(u=record.u, x0=unknowns[size:]) / level[None]

        start = jnp.concatenate([model.parameters[free], jnp.zeros(6)])
        slope = jax.jacfwd(response)(start).reshape(-1, size + 6)
        own, shared = slope[:, size:], slope[:, :size]
        total += shared.T @ shared - shared.T @ own @ jnp.linalg.solve(own.T @ own, own.T @ shared)
    return jnp.sqrt(jnp.diagonal(jnp.linalg.inv(total)))


def physical(realisations: int) -> dict:
    """Relative RMS error of each physical parameter, over the bound; coverage, seconds."""
    arm = reference_two_link_arm()
    truth = two_link_arm_gray_box(arm)
    clean = local_records(arm, jax.random.key(11))
    free = np.array([i for i, name in enumerate(truth.parameter_names) if name != KNOWN])
    noise = [jnp.std(record.y, axis=0) * 10 ** (-DECIBEL / 20) for record in clean.records]
    bound = np.asarray(bound_of(truth, clean, free, noise))
    missed, inside, seconds, fitted = [], [], [], 0
    for index in range(realisations):
        scatter = 0.2 * jax.random.normal(jax.random.key(2000 + index), truth.parameters.shape)
        held = jnp.zeros(scatter.shape).at[free].set(1.0)
        start = eqx.tree_at(
            lambda m: m.parameters, truth, truth.parameters * jnp.exp(held * scatter)
        )
        data = noisy(clean, jax.random.key(3000 + index))
        began = time.perf_counter()
        found = lv.refine(start, data, fixed=(KNOWN,), throw=False)
        seconds.append(time.perf_counter() - began)
        fitted += bool(found.status == lv.Status.successful)
        error = np.asarray(found.parameters - truth.parameters)[free]
        missed.append(error)
        inside.append(np.abs(error) <= 1.959964 * np.asarray(found.standard_errors)[free])
    rms = np.sqrt(np.mean(np.square(missed), axis=0))
    sizes = np.asarray(truth.parameters)[free]
    return dict(
        names=[truth.parameter_names[i] for i in free],
        bound=bound / sizes,
        rms=rms / sizes,
        ratio=rms / bound,
        coverage=100 * np.mean(inside),
        successful=fitted,
        first_seconds=seconds[0],
        seconds=min(seconds),
    )


def polynomial(seed: int, degree: int = 2) -> dict:
    """BFT on an unseen sweep: analytic, restructured, refined on local records, and on a sweep too.

    Every local record is identified by PI-MOESP, the seven models are restructured and
    interpolated: that is where refinement starts.
    """
    arm = reference_two_link_arm()
    keys = jax.random.split(jax.random.key(seed), 6)
    local = noisy(local_records(arm, keys[0]), keys[1])
    extra = noisy(sweep_record(arm, keys[2]), keys[3])
    test = sweep_record(arm, keys[4])
    kappas = np.cos(OPERATING_POINTS)
    method = lv.Polynomial(degree)
    analytic = [arm.linearised(angle) for angle in OPERATING_POINTS]
    black_boxes = [lv.identify(record, METHOD).model for record in local.records]
    structure = two_link_arm_structure(lengths=(0.35, 0.30))
    found = lv.restructure_along(black_boxes, structure, key=keys[5])
    models: dict[str, LPVStateSpace] = {
        "analytic": lv.interpolate(analytic, kappas, method),
        "restructured": lv.interpolate(found, kappas, method),
    }
    start, seconds = models["restructured"], {}
    for name, data in (("refined", local), ("refined, sweep too", join([local, extra]))):
        began = time.perf_counter()
        fit = lv.refine(start, data, throw=False)
        seconds[name] = time.perf_counter() - began
        models[name] = fit.model
    return dict(
        bft={
            name: np.asarray(lv.bft(test.y, model.simulate(u=test.u, kappa=test.kappa, dt=test.dt)))
            for name, model in models.items()
        },
        seconds=seconds,
    )


def main(arguments=None):
    """Print all figures."""
    parser = argparse.ArgumentParser(description="Global refinement of the two-link arm.")
    parser.add_argument("--realisations", type=int, default=60, help="of the noise")
    parser.add_argument("--seeds", type=int, default=5, help="of the sweeps")
    given = parser.parse_args(arguments)
    row = physical(given.realisations)
    for name, bound, rms, ratio in zip(
        row["names"], row["bound"], row["rms"], row["ratio"], strict=True
    ):
        print(f"{name:26s} bound {bound:.2e}  RMS {rms:.2e}  ratio {ratio:.3f}")
    print(
        f"physical parameters: RMS over the bound {np.sqrt(np.mean(row['ratio'] ** 2)):.3f}, "
        f"coverage {row['coverage']:.1f} %, {row['successful']} of {given.realisations} "
        f"successful, first {row['first_seconds']:.1f} s, later {row['seconds']:.2f} s",
        flush=True,
    )
    for seed in range(given.seeds):
        row = polynomial(seed)
        scores = "  ".join(
            f"{name} {bft[0]:.3f} / {bft[1]:.3f}" for name, bft in row["bft"].items()
        )
        seconds = ", ".join(f"{name} {value:.1f} s" for name, value in row["seconds"].items())
        print(f"degree 2, seed {seed}, BFT on the sweep: {scores}; {seconds}", flush=True)


if __name__ == "__main__":
    main()
