"""Global refinement of the two-link arm on all raw records at once, against the Cramér–Rao bound.

The seven local records of Vizer et al. (2015) with 30 dB of white noise. Two kinds of model: the
physical parameters (densities, stiffnesses, inertias, masses and gains, one gain known), and the
polynomial coefficients of structure (32), whose errors are measured where the truth is such a
polynomial. Both are scored on another, noise-free sweep of the nonlinear arm, beside the analytic
model interpolated with the same degree; so are polynomials refined on a sweep too.

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
def bound_of(frozen, truth: jax.Array, data: IOData, noise) -> jax.Array:
    """Standard deviations of the parameters at the bound, initial states unknown.

    `frozen` takes parameters and κ, and returns the model there.
    """
    size = truth.size
    total = jnp.zeros((size, size))
    for record, level in zip(data.records, noise, strict=True):

        def response(unknowns, record=record, level=level):
            arm = frozen(unknowns[:size], record.kappa[0]).discretise(data.dt)
            return arm.simulate(u=record.u, x0=unknowns[size:]) / level[None]

        start = jnp.concatenate([truth, jnp.zeros(6)])
        slope = jax.jacfwd(response)(start).reshape(-1, size + 6)
        own, shared = slope[:, size:], slope[:, :size]
        total += shared.T @ shared - shared.T @ own @ jnp.linalg.solve(own.T @ own, own.T @ shared)
    return jnp.sqrt(jnp.diagonal(jnp.linalg.inv(total)))


def levels_of(data: IOData) -> list[jax.Array]:
    """Standard deviation of the noise on each record's outputs."""
    return [jnp.std(record.y, axis=0) * 10 ** (-DECIBEL / 20) for record in data.records]


def nominal(truth: GrayBoxLPV, free: np.ndarray, key) -> GrayBoxLPV:
    """The arm with its free parameters off by 20 %."""
    scatter = 0.2 * jax.random.normal(key, truth.parameters.shape)
    held = jnp.zeros(scatter.shape).at[free].set(1.0)
    return eqx.tree_at(lambda m: m.parameters, truth, truth.parameters * jnp.exp(held * scatter))


def unknown(truth: GrayBoxLPV) -> np.ndarray:
    """Places of the parameters that are estimated."""
    return np.array([i for i, name in enumerate(truth.parameter_names) if name != KNOWN])


def physical(realisations: int) -> dict:
    """Relative RMS error of each physical parameter, over the bound; coverage, seconds."""
    arm = reference_two_link_arm()
    truth = two_link_arm_gray_box(arm)
    clean = local_records(arm, jax.random.key(11))
    free = unknown(truth)

    def frozen(values, kappa):
        return truth.function(truth.parameters.at[free].set(values), kappa)

    bound = np.asarray(bound_of(frozen, truth.parameters[free], clean, levels_of(clean)))
    missed, inside, seconds, fitted = [], [], [], 0
    for index in range(realisations):
        start = nominal(truth, free, jax.random.key(2000 + index))
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


def restructured(local: IOData, degree: int, key) -> LPVStateSpace:
    """Every local record identified by PI-MOESP, the seven models restructured, interpolated."""
    black_boxes = [lv.identify(record, METHOD).model for record in local.records]
    structure = two_link_arm_structure(lengths=(0.35, 0.30))
    found = lv.restructure_along(black_boxes, structure, key=key)
    return lv.interpolate(found, np.cos(OPERATING_POINTS), lv.Polynomial(degree))


def coefficients(realisations: int, degree: int = 2) -> dict:
    """RMS error of the polynomial coefficients over the bound, the truth being such a polynomial.

    The truth interpolates the analytic parameters; the start is restructured from noisy records of
    the arm itself. The coefficients' errors are strongly correlated.
    """
    arm = reference_two_link_arm()
    keys = jax.random.split(jax.random.key(40), 3)
    records = local_records(arm, keys[0])
    start = restructured(noisy(records, keys[1]), degree, keys[2])
    analytic = jnp.stack([arm.structured_parameters(angle) for angle in OPERATING_POINTS])
    regressors = start.basis(jnp.cos(jnp.asarray(OPERATING_POINTS))[:, None])
    exact = jnp.linalg.lstsq(regressors, analytic)[0]
    truth = eqx.tree_at(lambda m: m.coefficients, start, exact)
    clean = join(
        [
            record.replace(y=truth.simulate(u=record.u, kappa=record.kappa, dt=record.dt))
            for record in records.records
        ]
    )

    def frozen(values, kappa):
        shaped = values.reshape(truth.coefficients.shape)
        return eqx.tree_at(lambda m: m.coefficients, truth, shaped).at(kappa)

    bound = np.asarray(bound_of(frozen, truth.coefficients.ravel(), clean, levels_of(clean)))
    missed, inside, fitted = [], [], 0
    for index in range(realisations):
        found = lv.refine(start, noisy(clean, jax.random.key(5000 + index)), throw=False)
        fitted += bool(found.status == lv.Status.successful)
        missed.append(np.asarray(found.parameters - truth.coefficients.ravel()))
        inside.append(np.abs(missed[-1]) <= 1.959964 * np.asarray(found.standard_errors))
    ratio = np.sqrt(np.mean(np.square(missed), axis=0)) / bound
    return dict(ratio=ratio, coverage=100 * np.mean(inside), successful=fitted)


def sweep(seed: int, degree: int) -> dict:
    """BFT on an unseen sweep: analytic, restructured, refined on local records, and on a sweep too.

    Polynomials start from restructured models, physical parameters from nominal ones 20 % off.
    """
    arm = reference_two_link_arm()
    keys = jax.random.split(jax.random.key(seed), 6)
    local = noisy(local_records(arm, keys[0]), keys[1])
    extra = noisy(sweep_record(arm, keys[2]), keys[3])
    test = sweep_record(arm, keys[4])
    truth = two_link_arm_gray_box(arm)
    analytic = [arm.linearised(angle) for angle in OPERATING_POINTS]
    start = restructured(local, degree, keys[5])
    models: dict[str, LPVStateSpace | GrayBoxLPV] = {
        "analytic": lv.interpolate(analytic, np.cos(OPERATING_POINTS), lv.Polynomial(degree)),
        "restructured": start,
    }
    seconds = {}
    for name, data in (("refined", local), ("refined, sweep too", join([local, extra]))):
        began = time.perf_counter()
        fit = lv.refine(start, data, throw=False)
        seconds[name] = time.perf_counter() - began
        models[name] = fit.model
    rough = nominal(truth, unknown(truth), jax.random.key(7000 + seed))
    models["refined, physical"] = lv.refine(rough, local, fixed=(KNOWN,), throw=False).model
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
    row = coefficients(given.realisations)
    print(
        f"{row['ratio'].size} coefficients of degree 2: RMS over the bound "
        f"{np.sqrt(np.mean(row['ratio'] ** 2)):.3f} (each {row['ratio'].min():.2f} to "
        f"{row['ratio'].max():.2f}), coverage {row['coverage']:.1f} %, "
        f"{row['successful']} of {given.realisations} successful",
        flush=True,
    )
    for degree in (2, 3):
        for seed in range(given.seeds):
            row = sweep(seed, degree)
            scores = "  ".join(
                f"{name} {bft[0]:.3f} / {bft[1]:.3f}" for name, bft in row["bft"].items()
            )
            seconds = ", ".join(f"{name} {value:.1f} s" for name, value in row["seconds"].items())
            print(
                f"degree {degree}, seed {seed}, BFT on the sweep: {scores}; {seconds}", flush=True
            )


if __name__ == "__main__":
    main()
