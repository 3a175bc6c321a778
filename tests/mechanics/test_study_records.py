"""The study's records: sampling, operating points, drift, and one batch for all."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.mechanics import (
    OPERATING_POINTS,
    local_records,
    prbs,
    reference_two_link_arm,
    study_records,
    sweep_record,
    validation_record,
)

ARM = reference_two_link_arm()
KEY = jax.random.key(11)
SHORT = {"n_samples": 3000}


@pytest.fixture(scope="module")
def study():
    return study_records(ARM, KEY, sweep_duration=0.4, **SHORT)


def test_records_have_the_studys_shape(study):
    assert study.local.lengths == study.validation.lengths == (300,) * 7
    assert study.local.dt == 1e-3
    assert study.sweep.u.shape == study.sweep.y.shape == (400, 2)
    kappas = [float(record.kappa[0, 0]) for record in study.local.records]
    np.testing.assert_allclose(kappas, np.cos(OPERATING_POINTS))
    np.testing.assert_allclose(np.abs(study.local.u), 0.1)
    assert not np.array_equal(study.local.u, study.validation.u)


def test_the_batch_equals_its_parts(study):
    keys = jax.random.split(KEY, 3)
    local = local_records(ARM, keys[0], **SHORT)
    np.testing.assert_array_equal(study.local.u, local.u)
    np.testing.assert_allclose(study.local.y, local.y, atol=1e-12)
    sweep = sweep_record(ARM, keys[2], duration=0.4)
    np.testing.assert_array_equal(study.sweep.u, sweep.u)
    np.testing.assert_allclose(study.sweep.y, sweep.y, atol=1e-12)
    np.testing.assert_allclose(study.sweep.kappa, sweep.kappa, atol=1e-12)


def test_local_records_follow_the_local_linear_models(study):
    records = study.validation.records
    for theta2, record in list(zip(OPERATING_POINTS, records, strict=True))[::3]:
        model = ARM.linearised(theta2)
        system = control.ss(*(np.asarray(m) for m in (model.A, model.B, model.C, model.D)))
        sampled = system.sample(record.dt)
        expected = control.forced_response(sampled, inputs=np.asarray(record.u).T).outputs.T
        error = np.linalg.norm(record.y - expected, axis=0) / np.linalg.norm(expected, axis=0)
        # What is left is nonlinearity, well below the study's noise of 3 % (30 dB).
        assert error.max() < 5e-3


def test_validation_record_is_one_point():
    record = validation_record(ARM, KEY, theta2=1.0, n_samples=4000)
    assert record.lengths == (400,)
    np.testing.assert_allclose(record.kappa, np.cos(1.0))


def test_full_length_references_keep_the_posture():
    # The joint follows its reference's running sum: a bridge, whatever the key.
    references = jax.vmap(lambda k: prbs(k, 30_000, 2, amplitude=0.1, hold=50))(
        jax.random.split(KEY, 50)
    )
    travel = np.cumsum(np.asarray(references[:, :, 1]), axis=1) * 1e-4
    drift = np.abs(travel - travel.mean(axis=1, keepdims=True))
    assert drift.max() < 0.05


def test_sweep_crosses_the_range_smoothly(study):
    theta2 = np.arccos(np.asarray(study.sweep.kappa)[:, 0])
    ends = OPERATING_POINTS[0], OPERATING_POINTS[-1]
    np.testing.assert_allclose([theta2[0], theta2[-1]], ends, atol=0.06)
    assert theta2.min() > 0.3 and theta2.max() < 2.85


@pytest.mark.slow
def test_full_study_stays_at_its_points_and_crosses_in_three_seconds():
    study = study_records(ARM, KEY)
    assert study.local.lengths == (3000,) * 7
    theta2 = np.arccos(np.asarray(study.sweep.kappa)[:, 0])
    assert theta2.shape == (3200,)
    np.testing.assert_allclose(theta2[-1], OPERATING_POINTS[-1], atol=0.02)
    motion = ARM.simulate(
        reference=jnp.repeat(study.local.records[3].u, 10, axis=0),
        dt=1e-4,
        theta2_start=float(np.pi / 2),
        every=10,
    )
    assert np.ptp(motion.positions[:, 1]) < 0.05


@pytest.mark.parametrize(
    ("options", "word"),
    [({"decimate": 7}, "decimate=7"), ({"hold": 15}, "hold=15"), ({"theta2": (0.0,)}, "theta2")],
)
def test_impossible_studies_are_refused(options, word):
    with pytest.raises(ValueError, match=word):
        local_records(ARM, KEY, **({"n_samples": 1000} | options))
