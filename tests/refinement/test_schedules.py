"""LPV models from records at constant and at moving κ."""

import importlib.util
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid._results import Status
from lpvid.data import IOData, join
from lpvid.models import GrayBoxLPV, StateSpace
from lpvid.refinement import refine
from lpvid.refinement._modules import ModuleParameterisation
from lpvid.refinement._parameterisation import Record
from lpvid.refinement._predictors import OutputError
from lpvid.refinement._recognise import recognise

from .plants import inputs

DT, TRUTH = 0.1, np.array([4.0, 2.0, 0.4])
FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "global_refinement.py"


def spring(parameters, kappa):
    row = jnp.stack([-parameters[0] - parameters[1] * kappa[0], -parameters[2]])
    A = jnp.array([[0.0, 1.0], [0.0, 0.0]]).at[1].set(row)
    return StateSpace(A, jnp.array([[0.0], [1.0]]), jnp.array([[1.0, 0.0]]))


def model(parameters):
    names = ("stiffness", "hardening", "damping")
    return GrayBoxLPV(spring, parameters, names, kappa_low=0.0, kappa_high=1.0)


def record(n, kappa, seed, noise=0.01):
    u = inputs(n)
    schedule = np.broadcast_to(np.asarray(kappa, float), (n,))
    y = np.asarray(model(TRUTH).simulate(u=u, kappa=schedule, dt=DT))
    y = y + noise * np.random.default_rng(seed).standard_normal(y.shape)
    return IOData(u=u, y=y, dt=DT, kappa=schedule)


STILL = [record(300, 0.0, 0), record(200, 1.0, 1)]
MOVING = record(300, np.linspace(0.0, 1.0, 300), 2)


def test_records_at_rest_are_simulated_by_frozen_models():
    data = STILL[1]
    each = Record(data.u, data.y, data.kappa, jnp.asarray(0))
    x0 = jnp.array([0.3, -0.2])
    outputs = [
        ModuleParameterisation(model(TRUTH), DT, 2, schedules).respond(jnp.asarray(TRUTH), each, x0)
        for schedules in ("still", "mixed", "moving")
    ]
    np.testing.assert_allclose(outputs[0], outputs[2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(outputs[1], outputs[2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("records", "schedules"),
    [(STILL, "still"), ([*STILL, MOVING], "mixed"), ([MOVING, MOVING], "moving")],
)
def test_schedules_are_recognised(records, schedules):
    start = recognise(model(TRUTH), join(records), OutputError())
    assert start.parameterisation.schedules == schedules
    assert start.parameterisation.names == ("stiffness", "hardening", "damping")


def test_the_schedule_is_asked_for():
    data = IOData(u=STILL[0].u, y=STILL[0].y, dt=DT)
    with pytest.raises(ValueError, match="needs the scheduling"):
        refine(model(TRUTH), data)


def test_another_sample_time_is_refused():
    discrete = model(TRUTH).lpv.discretise(DT)
    for data in (STILL[0], MOVING):
        slower = IOData(u=data.u, y=data.y, dt=2 * DT, kappa=data.kappa)
        with pytest.raises(ValueError, match="sample time"):
            refine(discrete, slower)


@pytest.mark.slow
def test_shooting_never_leaves_the_schedule():
    def lag(parameters, kappa):
        return StateSpace(-parameters[:1, None] / kappa[0], parameters[1:, None], jnp.eye(1))

    plant = GrayBoxLPV(lag, [2.0, 1.0], ("rate", "gain"), kappa_low=1.0, kappa_high=2.0)
    u, schedule = inputs(210), np.linspace(1.0, 2.0, 210)
    y = np.asarray(plant.simulate(u=u, kappa=schedule, dt=DT))
    y = y + 0.01 * np.random.default_rng(3).standard_normal(y.shape)
    data = IOData(u=u, y=y, dt=DT, kappa=schedule)
    start = GrayBoxLPV(lag, [1.5, 0.7], ("rate", "gain"), kappa_low=1.0, kappa_high=2.0)
    whole, pieces = (refine(start, data, predictor=OutputError(k)) for k in (None, 25))
    assert pieces.status == Status.successful
    np.testing.assert_allclose(pieces.parameters, whole.parameters, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("records", [STILL, [*STILL, MOVING]], ids=["still", "mixed"])
def test_parameters_from_records_of_different_lengths(records):
    found = refine(model(1.3 * TRUTH), join(records))
    assert found.status == Status.successful
    assert np.max(np.abs(found.parameters - TRUTH) / found.standard_errors) < 4.0
    assert np.all(found.standard_errors < 0.02 * TRUTH)


@pytest.mark.slow
def test_the_arms_physical_parameters_reach_the_bound():
    spec = importlib.util.spec_from_file_location("benchmark_global_refinement", FILE)
    assert spec is not None and spec.loader is not None
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    row = benchmark.physical(12)
    assert row["successful"] == 12
    # Nine parameters, twelve realisations: 1.2 is three standard deviations above one.
    assert np.sqrt(np.mean(row["ratio"] ** 2)) < 1.2
