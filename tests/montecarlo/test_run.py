"""Pipelines over keys and points: what each run gives, and what becomes of failed ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid import montecarlo
from lpvid._results import Status

KEYS = jax.random.split(jax.random.key(3), 12)
POINTS = {"mean": jnp.array([0.0, 10.0, 20.0]), "shift": np.zeros((3, 2))}


class Outcome(eqx.Module):
    """Two draws, a count and a status."""

    draws: jax.Array
    count: jax.Array
    status: Status


def draw(key, point):
    """Fails by a NaN where the first draw is positive, by a status where the second one is."""
    draws = point["mean"] + point["shift"] + jax.random.normal(key, (2,))
    noise = draws - point["mean"]
    return Outcome(
        draws=jnp.where(noise[0] > 0.5, jnp.nan, draws),
        count=jnp.asarray(7),
        status=Status.where(noise[1] > 0.5, Status.unstable, Status.successful),
    )


def expected(run, point):
    key = jax.random.fold_in(KEYS[run], point)
    return np.asarray(POINTS["mean"][point] + jax.random.normal(key, (2,)))


@pytest.fixture(scope="module")
def study():
    return montecarlo.run(draw, KEYS, points=POINTS, progress=False)


def test_runs_are_those_of_their_keys_and_points(study):
    assert study.values.draws.shape == (3, 12, 2) and study.kept.shape == (3, 12)
    for point in range(3):
        for run in range(12):
            wanted = expected(run, point)
            noise = wanted - 10.0 * point
            status = jax.tree.map(lambda code, p=point, r=run: code[p, r], study.status)
            if np.all(noise <= 0.5):
                np.testing.assert_allclose(study.values.draws[point, run], wanted, rtol=1e-12)
                assert status == Status.successful
            else:
                assert np.all(np.isnan(study.values.draws[point, run]))
                # The pipeline's own status says more than that there is a NaN.
                assert status == (Status.unstable if noise[1] > 0.5 else Status.nonfinite)
    np.testing.assert_array_equal(study.values.count, 7)


def test_failures_are_counted_and_told(study):
    assert 0 < study.failed < 36 and study.failed == np.sum(~study.kept)
    outcomes = study.outcomes()
    assert sum(outcomes.values()) == 36
    assert outcomes[Status[Status.successful]] == 36 - study.failed
    assert list(outcomes.values()) == sorted(outcomes.values(), reverse=True)


def test_statuses_can_be_accepted(study):
    lenient = montecarlo.run(
        draw, KEYS, points=POINTS, accept=(Status.unstable,), progress=False, chunk=5
    )
    unstable = np.asarray(study.status == Status.unstable)
    finite = np.all(np.isfinite(lenient.values.draws), axis=-1)
    np.testing.assert_array_equal(lenient.kept, finite)
    assert np.any(lenient.kept & unstable) and np.all(lenient.kept[study.kept])


def test_the_summary_knows_failed_runs(study):
    summary = study.summary(
        lambda v: v.draws, truth=POINTS["mean"][:, None], names=["first", "second"]
    )
    np.testing.assert_allclose(summary.success, study.kept.mean(axis=1))
    for point in range(3):
        chosen = study.values.draws[point][study.kept[point]]
        np.testing.assert_allclose(summary.mean[point], chosen.mean(axis=0))
        np.testing.assert_allclose(summary.median[point], np.median(chosen, axis=0))
        error = chosen - 10.0 * point
        np.testing.assert_allclose(summary.rms[point], np.sqrt((error**2).mean(axis=0)))


def test_without_points_the_keys_are_the_runs():
    study = montecarlo.run(jax.random.normal, KEYS, progress=False)
    np.testing.assert_allclose(study.values, [float(jax.random.normal(key)) for key in KEYS])
    assert study.kept.shape == (12,) and study.failed == 0


class Pole(eqx.Module):
    """A pipeline with arrays of its own: the pole of a lag from noisy records."""

    u: jax.Array
    y: jax.Array
    noise: jax.Array

    def __call__(self, key, scale):
        y = self.y + scale * self.noise * jax.random.normal(key, self.y.shape)
        return {"pole": jnp.sum(y[:-1] * (y[1:] - self.u[:-1])) / jnp.sum(y[:-1] ** 2)}


def test_a_pipeline_may_have_arrays_and_a_study_is_taken_up(tmp_path):
    u = np.sign(np.random.default_rng(0).standard_normal(300))
    y = np.zeros(300)
    for t in range(299):
        y[t + 1] = 0.8 * y[t] + u[t]
    pipeline = Pole(jnp.asarray(u), jnp.asarray(y), jnp.asarray(0.01))
    arguments = {"points": jnp.array([1.0, 4.0]), "checkpoint": tmp_path / "c.npz"}
    study = montecarlo.run(pipeline, KEYS, progress=False, **arguments)
    summary = study.summary(lambda v: v["pole"], truth=0.8)
    # Twelve runs: the ratio of two standard deviations is known to some 40 % only.
    np.testing.assert_allclose(summary.std[1] / summary.std[0], 4.0, rtol=0.5)
    again = montecarlo.run(pipeline, KEYS, progress=False, **arguments)
    np.testing.assert_array_equal(again.values["pole"], study.values["pole"])
    other = eqx.tree_at(lambda p: p.noise, pipeline, jnp.asarray(0.2))
    with pytest.raises(ValueError, match="begun with other keys, points or data"):
        montecarlo.run(other, KEYS, progress=False, **arguments)


@pytest.mark.parametrize(
    "keys", [jax.random.key(0), jnp.arange(3), KEYS[:0], KEYS.reshape(3, 4)], ids=range(4)
)
def test_keys_must_be_keys(keys):
    with pytest.raises((ValueError, TypeError), match=r"keys|Type-check"):
        montecarlo.run(draw, keys, points=POINTS)


@pytest.mark.parametrize("points", [{}, 1.0, {"a": jnp.zeros(2), "b": jnp.zeros(3)}, jnp.zeros(0)])
def test_points_need_one_leading_axis(points):
    with pytest.raises(ValueError, match="points: every leaf needs"):
        montecarlo.run(draw, KEYS, points=points)


def test_a_summary_needs_one_array(study):
    with pytest.raises(ValueError, match="select: one array is needed, got Outcome"):
        study.summary()
