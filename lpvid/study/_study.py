"""The study with the average model of each operating point, as 001 tells it."""

import time
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lpvid import montecarlo
from lpvid.analysis import bft, hinf_norm, vaf
from lpvid.data import IOData
from lpvid.interpolate import balance_along, interpolate, interpolation_fit
from lpvid.mechanics import (
    OPERATING_POINTS,
    StudyRecords,
    TwoLinkFlexibleArm,
    reference_two_link_arm,
    study_records,
    two_link_arm_structure,
)
from lpvid.models import LPVStateSpace, Polynomial, StateSpace
from lpvid.restructure import Restructured, restructure_along
from lpvid.study._identification import averages, identify_runs

MODEL_NAMES = ("restructured", "analytic", "balanced")


class StudyResult(eqx.Module):
    """Everything that the study made.

    Attributes:
        arm: the plant.
        records: its noise-free records.
        noisy: the first noise realisation of the local records.
        theta2: operating points, rad.
        black_boxes: average continuous-time black box of each point.
        restructured: structured model of each point.
        analytic: exact linearisation at each point.
        lpv: the three interpolated models by name, see `MODEL_NAMES`.
        sweep_outputs: their simulated outputs on the sweep record.
        local_bft: BFT of the average black boxes on unseen noise-free records (point, output).
        local_vaf: VAF of the same.
        sweep_bft: BFT on the sweep by model name, one value for each output.
        sweep_vaf: VAF of the same.
        relative_cost: F(ϑ)/‖G_anal‖∞ of each point (001, table 2).
        interpolation_fit: FIT by model name and degree, percent (001, table 3), for the degrees 1
            and 2 where there are points enough.
        failed_runs: identifications that did not succeed, of all.
        seconds: wall time by stage.
    """

    arm: TwoLinkFlexibleArm
    records: StudyRecords
    noisy: IOData
    theta2: tuple[float, ...]
    black_boxes: list[StateSpace]
    restructured: list[Restructured]
    analytic: list[StateSpace]
    lpv: dict[str, LPVStateSpace]
    sweep_outputs: dict[str, Float[Array, "time 2"]]
    local_bft: Float[Array, "point 2"]
    local_vaf: Float[Array, "point 2"]
    sweep_bft: dict[str, Float[Array, "2"]]
    sweep_vaf: dict[str, Float[Array, "2"]]
    relative_cost: Float[Array, " point"]
    interpolation_fit: dict[str, dict[int, float]]
    failed_runs: int
    seconds: dict[str, float]


def run_study(
    key: PRNGKeyArray,
    *,
    runs: int = 10,
    degree: int = 2,
    arm: TwoLinkFlexibleArm | None = None,
    theta2: Sequence[float] = OPERATING_POINTS,
    n_samples: int = 30_000,
    report: Callable[[str], None] | None = None,
) -> StudyResult:
    """Run the study: simulate, identify every noisy record, average, restructure, interpolate.

    At each θ2 one noise-free record is simulated and `runs` realisations of white noise at 30 dB
    are added; each gives a PI-MOESP model of order 6. The models of a point are averaged in
    one basis, restructured to (32) by the H∞ norm, and interpolated in κ = cos θ2. The
    analytic linearisations and the balanced black boxes (signs matched) are interpolated the
    same way, and all three are compared on a record that crosses the whole range of θ2.

    Args:
        key: random key of excitation, noise and starts.
        runs: noise realisations for each operating point.
        degree: polynomial degree in κ.
        arm: the plant; the reference arm by default.
        theta2: operating points, rad.
        n_samples: simulated samples of each local record (0.1 ms; every tenth is kept).
        report: called with a sentence before each stage.

    Raises:
        ValueError: if `runs` is below 1, or all identifications of a point failed.

    Source: 001, section 3.3.

    Example:
        >>> result = run_study(jax.random.key(0), runs=10)  # doctest: +SKIP
        >>> result.sweep_bft["restructured"]  # doctest: +SKIP
    """
    say = report if report is not None else silent
    return run_stages(key, runs, degree, arm, theta2, n_samples, say)[0]


def run_stages(
    key: PRNGKeyArray,
    runs: int,
    degree: int,
    arm: TwoLinkFlexibleArm | None,
    theta2: Sequence[float],
    n_samples: int,
    say: Callable[[str], None],
    *,
    progress: bool = False,
) -> tuple[StudyResult, montecarlo.Study]:
    """`run_study`, and the black boxes that it averaged; see there."""
    if runs < 1:
        raise ValueError(f"runs: at least one noise realisation is needed, got {runs}.")
    clock = Clock()
    arm = reference_two_link_arm() if arm is None else arm
    record_key, noise_key, start_key = jax.random.split(key, 3)

    say(f"Simulating the arm at {len(theta2)} operating points and along the sweep")
    records = study_records(arm, record_key, theta2=theta2, n_samples=n_samples)
    clock.lap("simulate")

    say(f"Identifying {len(theta2) * runs} noisy records by PI-MOESP")
    identified, noisy = identify_runs(records.local, noise_key, runs, progress=progress)
    clock.lap("identify")

    say("Averaging the models of each point in one basis")
    black_boxes = averages(identified, theta2)
    clock.lap("average")

    say("Restructuring by the H-infinity norm")
    lengths = tuple(float(length) for length in arm.link_lengths)
    structure = two_link_arm_structure(lengths=(lengths[0], lengths[1]))
    restructured = restructure_along(black_boxes, structure, key=start_key)
    clock.lap("restructure")

    say("Interpolating and validating")
    analytic = [arm.linearised(angle) for angle in theta2]
    kappas = jnp.cos(jnp.asarray(theta2, float))
    balanced = balance_along(black_boxes)
    local = {"restructured": restructured, "analytic": analytic, "balanced": balanced}
    lpv = {name: _interpolate(local[name], kappas, degree) for name in MODEL_NAMES}
    sweep = records.sweep
    outputs = {
        name: model.simulate(u=sweep.u, kappa=jnp.asarray(sweep.kappa), dt=sweep.dt)
        for name, model in lpv.items()
    }
    fits = {
        name: {
            d: float(interpolation_fit(_interpolate(local[name], kappas, d), local[name], kappas))
            for d in (1, 2)
            if d < len(theta2)
        }
        for name in MODEL_NAMES
    }
    local_bft, local_vaf = _validate_local(black_boxes, records.validation)
    norms = jnp.stack([hinf_norm(model).value for model in analytic])
    costs = jnp.stack([result.cost for result in restructured])
    clock.lap("validate")
    result = StudyResult(
        arm=arm,
        records=records,
        noisy=noisy,
        theta2=tuple(theta2),
        black_boxes=black_boxes,
        restructured=restructured,
        analytic=analytic,
        lpv=lpv,
        sweep_outputs=outputs,
        local_bft=local_bft,
        local_vaf=local_vaf,
        sweep_bft={name: bft(sweep.y, y) for name, y in outputs.items()},
        sweep_vaf={name: vaf(sweep.y, y) for name, y in outputs.items()},
        relative_cost=costs / norms,
        interpolation_fit=fits,
        failed_runs=identified.failed,
        seconds=clock.seconds,
    )
    return result, identified


def summary(result: StudyResult) -> dict:
    """The study's figures as plain numbers, ready for JSON.

    Example:
        >>> summary(result)["bft"]["restructured"]  # doctest: +SKIP
    """
    return {
        "theta2": list(result.theta2),
        "bft": {name: _plain(values) for name, values in result.sweep_bft.items()},
        "vaf": {name: _plain(values) for name, values in result.sweep_vaf.items()},
        "local_bft": _plain(result.local_bft),
        "local_vaf": _plain(result.local_vaf),
        "relative_cost": _plain(result.relative_cost),
        "fit_percent": {
            str(degree): value for degree, value in result.interpolation_fit["restructured"].items()
        },
        "fit_percent_by_model": {
            name: {str(degree): value for degree, value in values.items()}
            for name, values in result.interpolation_fit.items()
        },
        "hits": [int(found.hits) for found in result.restructured],
        # JSON knows no infinity, which stands for "no second minimum".
        "margin": [
            float(found.margin) if np.isfinite(found.margin) else None
            for found in result.restructured
        ],
        "failed_runs": result.failed_runs,
        "seconds": sum(result.seconds.values()),
        "seconds_by_stage": result.seconds,
    }


def _plain(values: Array) -> list:
    return np.asarray(values).tolist()


def silent(message: str) -> None:
    """Say nothing."""
    del message


class Clock:
    """Wall time by stage."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """A stage is over."""
        now = time.perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now


def _interpolate(models, kappas, degree: int) -> LPVStateSpace:
    return interpolate(models, kappas, Polynomial(degree=degree))


def _validate_local(models: Sequence[StateSpace], validation: IOData):
    """BFT and VAF of each local model on the record of its point."""
    fits, variances = [], []
    for model, record in zip(models, validation.records, strict=True):
        y = model.simulate(u=record.u, dt=record.dt)
        fits.append(bft(record.y, y))
        variances.append(vaf(record.y, y))
    return jnp.stack(fits), jnp.stack(variances)
