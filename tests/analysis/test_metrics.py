import jax
import numpy as np
import pytest

from lpvid.analysis import bft, nrmse_fit, parameter_fit, relative_error, vaf


def record():
    rng = np.random.default_rng(0)
    y = rng.standard_normal((50, 2)) + 3.0
    return y, y + np.array([0.1, 5.0]) * rng.standard_normal((50, 2))


def test_definitions():
    y, y_hat = record()
    error = np.linalg.norm(y - y_hat, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0)
    np.testing.assert_allclose(nrmse_fit(y, y_hat), 100 * (1 - error))
    np.testing.assert_allclose(bft(y, y_hat), 100 * np.maximum(1 - error, 0))
    assert nrmse_fit(y, y_hat)[1] < 0.0 == bft(y, y_hat)[1]
    ratio = np.var(y - y_hat, axis=0) / np.var(y, axis=0)
    np.testing.assert_allclose(vaf(y, y_hat), 100 * np.maximum(1 - ratio, 0))
    rms = np.sqrt(np.mean((y - y_hat) ** 2, axis=0) / np.mean(y**2, axis=0))
    np.testing.assert_allclose(relative_error(y=y, y_hat=y_hat), rms)
    np.testing.assert_allclose(parameter_fit(y, y_hat), 100 * (1 - error))


def test_one_channel_is_a_scalar():
    y, y_hat = record()
    for metric in (bft, vaf, nrmse_fit, relative_error, parameter_fit):
        assert metric(y[:, 0], y_hat[:, 0]).shape == ()
        np.testing.assert_allclose(metric(y[:, 0], y_hat[:, 0]), metric(y, y_hat)[0])


def test_constant_outputs():
    y = np.full(5, 2.0)
    assert bft(y, y) == vaf(y, y) == nrmse_fit(y, y) == parameter_fit(y, y) == 100.0
    assert vaf(y, y + 1.0) == 100.0 and vaf(y, np.arange(5.0)) == 0.0
    assert bft(y, y + 1.0) == 0.0 and nrmse_fit(y, y + 1.0) == -np.inf
    assert relative_error(np.zeros(3), np.zeros(3)) == 0.0
    assert relative_error(np.zeros(3), np.ones(3)) == np.inf


@pytest.mark.parametrize("metric", [bft, vaf, nrmse_fit, relative_error, parameter_fit])
def test_shapes_are_not_guessed(metric):
    with pytest.raises(ValueError, match=r"has shape \(5,\).*\(5, 1\)"):
        metric(np.zeros(5), np.zeros((5, 1)))
    with pytest.raises(ValueError, match="jax.vmap"):
        metric(np.zeros((2, 5, 1)), np.zeros((2, 5, 1)))


@pytest.mark.parametrize("metric", [bft, vaf, nrmse_fit, relative_error])
def test_gradients(metric):
    y, y_hat = record()
    y, y_hat = y[:, 0], y_hat[:, 0]
    direction = np.random.default_rng(1).standard_normal(50)
    slope = jax.grad(lambda e: metric(y, y_hat + e * direction))(0.0)
    step = 1e-5
    difference = metric(y, y_hat + step * direction) - metric(y, y_hat - step * direction)
    np.testing.assert_allclose(slope, difference / (2 * step), rtol=1e-5)
    assert np.all(np.isfinite(jax.grad(metric, argnums=1)(y, y)))
