"""The study with every run restructured by itself: 001, section 3.3, as a Monte Carlo study."""

import os
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lpvid import montecarlo
from lpvid._results import Status
from lpvid.analysis import bft, hinf_norm, vaf
from lpvid.data import IOData
from lpvid.interpolate import interpolate
from lpvid.mechanics import OPERATING_POINTS, TwoLinkFlexibleArm
from lpvid.models import AbstractStructure, LPVStateSpace, Polynomial, StateSpace
from lpvid.restructure import HinfMatching, restructure
from lpvid.study._study import Clock, StudyResult, run_stages, silent


class RestructuredRun(eqx.Module):
    """What the restructuring of one run gives.

    Attributes:
        parameters: ϑ.
        error_norm: ‖G(ϑ) − G_i‖∞.
        status: how the restructuring ended; `uncertified` ones count as found.
    """

    parameters: Float[Array, "*batch parameter"]
    error_norm: Float[Array, "*batch"]
    status: Status


class Sweep(eqx.Module):
    """How one LPV model does on the sweep record: BFT and VAF of both outputs, percent."""

    bft: Float[Array, "*batch output"]
    vaf: Float[Array, "*batch output"]


class MonteCarloResult(eqx.Module):
    """The study of the averages, and every run on its own.

    Attributes:
        study: what `run_study` gives for the same arguments.
        black_boxes: identified models, leading axes (point, run).
        runs: their restructured models, `RestructuredRun`s with leading axes (point, run).
        reference: the same, searched from the true parameters; None where not asked for.
        sweeps: LPV models of the single runs on the sweep record, `Sweep` with axis (run,).
        mean_model: LPV model of the parameters' means over the runs.
        mean_sweep: that one on the sweep record.
        true_parameters: ϑ of the exact linearisation at each point.
        relative_cost: F/‖G_anal‖∞ of every run (001, table 2), (point, run).
        seconds: wall time by stage, of the study's too.
    """

    study: StudyResult
    black_boxes: montecarlo.Study
    runs: montecarlo.Study
    reference: montecarlo.Study | None
    sweeps: montecarlo.Study
    mean_model: LPVStateSpace
    mean_sweep: Sweep
    true_parameters: Float[Array, "point parameter"]
    relative_cost: Float[np.ndarray, "point run"]
    seconds: dict[str, float]

    def share_optimal(self, tolerance: float = 0.05) -> float:
        """Share of all runs whose cost F is within `tolerance` of that reached from the truth.

        A failed run counts against it. Without a `reference` there is nothing to compare with.

        Raises:
            ValueError: the study was run without `reference=True`.

        Example:
            >>> result.share_optimal()  # doctest: +SKIP
            0.99
        """
        if self.reference is None:
            raise ValueError("reference: none; run the study with reference=True.")
        found, best = (s.values.error_norm**2 for s in (self.runs, self.reference))
        return float(np.mean(np.nan_to_num(found, nan=np.inf) <= (1.0 + tolerance) * best))


class _Restructuring(eqx.Module):
    """A pipeline without chance: one black box into the structure, from given starts."""

    structure: AbstractStructure
    method: HinfMatching

    def __call__(self, key: PRNGKeyArray, point: dict) -> RestructuredRun:
        del key
        found = restructure(
            point["black_box"],
            self.structure,
            starts=0,
            initial=point["starts"],
            method=self.method,
        )
        # The black box of a failed identification has no match, whatever the search says.
        known = jnp.isfinite(jnp.sum(point["black_box"].A))
        status = Status.where(known, found.status, Status.nonfinite)
        return RestructuredRun(found.parameters, found.error_norm, status)


class _SweepCheck(eqx.Module):
    """A pipeline without chance: the local models of one run to an LPV model, and its check."""

    structure: AbstractStructure
    record: IOData
    kappas: tuple[float, ...] = eqx.field(static=True)
    degree: int = eqx.field(static=True)

    def __call__(self, key: PRNGKeyArray, parameters: Array) -> Sweep:
        del key
        return check_sweep(self.lpv(parameters), self.record)

    def lpv(self, parameters: Array) -> LPVStateSpace:
        """The LPV model of local parameters (point, parameter)."""
        models = [self.structure.matrices(each) for each in parameters]
        return interpolate(models, np.array(self.kappas), Polynomial(degree=self.degree))


def check_sweep(model: LPVStateSpace, record: IOData) -> Sweep:
    """Simulate an LPV model from rest on a record and compare."""
    y = model.simulate(u=record.u, kappa=jnp.asarray(record.kappa), dt=record.dt)
    return Sweep(bft(record.y, y), vaf(record.y, y))


def run_monte_carlo(
    key: PRNGKeyArray,
    *,
    runs: int = 100,
    degree: int = 2,
    arm: TwoLinkFlexibleArm | None = None,
    theta2: Sequence[float] = OPERATING_POINTS,
    n_samples: int = 30_000,
    method: HinfMatching | None = None,
    reference: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    report: Callable[[str], None] | None = None,
    progress: bool = False,
) -> MonteCarloResult:
    """`run_study`, with the black box of every run restructured and validated by itself.

    The averages of the points are restructured from many starts, as in `run_study`; their
    solutions start the search of the single runs. Every run then gives an LPV model of its own, and
    the spread of the models on the sweep record is the spread due to noise.

    Args:
        key: random key of excitation, noise and starts.
        runs: noise realisations for each operating point.
        degree: polynomial degree in κ.
        arm: the plant; the reference arm by default.
        theta2: operating points, rad.
        n_samples: simulated samples of each local record (0.1 ms; every tenth is kept).
        method: options of the restructuring of single runs; by default without the smooth
            surrogates, which a start near the minimum does not need.
        reference: restructure every run from the true parameters too, to compare with.
        checkpoint: file that holds the finished restructurings; see `montecarlo.run`.
        report: called with a sentence before each stage.
        progress: whether to show bars on stderr.

    Raises:
        ValueError: if `runs` is below 1, all identifications of a point failed, or the checkpoint
            belongs to another study.

    Source: 001, section 3.3.

    Example:
        >>> result = run_monte_carlo(jax.random.key(0), reference=True)  # doctest: +SKIP
        >>> result.share_optimal()  # doctest: +SKIP
    """
    method = HinfMatching(passes=0) if method is None else method
    say = report if report is not None else silent
    study, identified = run_stages(
        key, runs, degree, arm, theta2, n_samples, say, progress=progress
    )
    clock = Clock()
    structure = study.restructured[0].structure
    count = len(theta2)
    starts = jnp.stack([found.parameters for found in study.restructured])

    def restructure_all(starts, checkpoint):
        # Every black box is a point of its own: the search has no chance in it.
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), identified.values.model)
        points = {"black_box": flat, "starts": jnp.repeat(starts, runs, axis=0)[:, None]}
        found = montecarlo.run(
            _Restructuring(structure, method),
            jax.random.split(key, 1),
            points=points,
            # A match without a certificate is still a match; its status tells it.
            accept=(Status.uncertified,),
            checkpoint=checkpoint,
            progress=progress,
        )
        return jax.tree.map(lambda leaf: leaf.reshape(count, runs, *leaf.shape[2:]), found)

    say(f"Restructuring {count * runs} black boxes")
    found = restructure_all(starts, checkpoint)
    clock.lap("restructure runs")

    say("Interpolating and validating every run")
    kappas = tuple(float(np.cos(angle)) for angle in theta2)
    check = _SweepCheck(structure, study.records.sweep, kappas, degree)
    parameters = jnp.asarray(found.values.parameters)
    sweeps = montecarlo.run(
        check,
        jax.random.split(key, 1),
        points=jnp.swapaxes(parameters, 0, 1),
        progress=progress,
    )
    sweeps = jax.tree.map(lambda leaf: leaf[:, 0], sweeps)
    mean_model = check.lpv(jnp.nanmean(parameters, axis=1))
    norms = np.stack([hinf_norm(model).value for model in study.analytic])
    clock.lap("validate runs")

    truth = jnp.stack([_parameters_of(model) for model in study.analytic])
    from_truth = None
    if reference:
        say(f"Restructuring {count * runs} black boxes from the true parameters")
        from_truth = restructure_all(truth, None)
        clock.lap("reference")
    return MonteCarloResult(
        study=study,
        black_boxes=identified,
        runs=found,
        reference=from_truth,
        sweeps=sweeps,
        mean_model=mean_model,
        mean_sweep=check_sweep(mean_model, study.records.sweep),
        true_parameters=truth,
        relative_cost=found.values.error_norm**2 / norms[:, None],
        seconds={**study.seconds, **clock.seconds},
    )


def _parameters_of(model: StateSpace) -> Float[Array, "16"]:
    """ϑ of an exact linearisation, which has structure (32)."""
    return model.A[2:6, 0:4].T.reshape(-1)
