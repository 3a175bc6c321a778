"""Prediction against a loop over time with the definition of the k-step predictor."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from lpvid.analysis import fit_by_record, horizon_errors, nrmse_fit, predict
from lpvid.models import NonlinearModel, StateSpace

RNG = np.random.default_rng(5)
A = np.array([[0.9, 0.2, 0.0], [-0.3, 0.7, 0.1], [0.0, 0.1, 0.5]])
B, C = RNG.standard_normal((3, 2)), RNG.standard_normal((2, 3))
D = RNG.standard_normal((2, 2))


def kalman(A):
    """Steady gain for unit noise on states and outputs: A − K C is stable."""
    P = solve_discrete_are(A.T, C.T, np.eye(3), np.eye(2))
    return A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(2))


K = kalman(A)
MODEL = StateSpace(A, B, C, D, dt=0.1)
U, Y = RNG.standard_normal((2, 60, 2))
X0 = RNG.standard_normal((2, 3))
LENGTHS = (25, 35)


def loop(u, y, x0, horizon, A=A, K=K):
    """ŷ(t | t − k): filter up to t − k, then k − 1 steps without the output."""
    filtered = [x0]
    for t in range(len(u)):
        x = filtered[-1]
        filtered.append(A @ x + B @ u[t] + K @ (y[t] - C @ x - D @ u[t]))
    predicted = []
    for t in range(len(u)):
        start = max(t - horizon + 1, 0)
        x = filtered[start]
        for s in range(start, t):
            x = A @ x + B @ u[s]
        predicted.append(C @ x + D @ u[t])
    return np.array(predicted)


@pytest.mark.parametrize("horizon", [1, 2, 7, 100])
def test_prediction_is_that_of_the_definition(horizon):
    found = predict(MODEL, u=U, y=Y, gain=K, x0=X0, horizon=horizon, lengths=LENGTHS)
    expected = np.concatenate(
        [loop(U[:25], Y[:25], X0[0], horizon), loop(U[25:], Y[25:], X0[1], horizon)]
    )
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def test_without_gain_or_horizon_it_is_simulation():
    expected = MODEL.simulate(u=U, x0=X0[0])
    np.testing.assert_allclose(predict(MODEL, u=U, x0=X0[0], horizon=3), expected)
    np.testing.assert_allclose(predict(MODEL, u=U, y=Y, gain=K, x0=X0[0], horizon=None), expected)
    far = predict(MODEL, u=U, y=Y, gain=K, x0=X0[0], horizon=60)
    np.testing.assert_allclose(far, expected, atol=1e-9)


def test_an_unstable_model_predicts_without_cancellation():
    """The predictor is stable, the model is not: 1.3^60 is 7e6, and no digits are lost."""
    unstable = np.diag([1.3, 0.5, 0.2])
    gain = kalman(unstable)
    model = StateSpace(unstable, B, C, D, dt=0.1)
    found = predict(model, u=U, y=Y, gain=gain, x0=X0[0], horizon=7)
    expected = loop(U, Y, X0[0], 7, A=unstable, K=gain)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-11 * scale)


def test_innovations_of_the_true_model_are_the_noise():
    u, e = np.random.default_rng(6).standard_normal((2, 60, 2))
    x, y = np.zeros(3), []
    for t in range(60):
        y.append(C @ x + D @ u[t] + e[t])
        x = A @ x + B @ u[t] + K @ e[t]
    y = np.array(y)
    np.testing.assert_allclose(y - predict(MODEL, u=u, y=y, gain=K), e, atol=1e-9)


def test_errors_over_horizons_are_those_of_predict():
    errors = horizon_errors(MODEL, u=U, y=Y, gain=K, x0=X0, lengths=LENGTHS)
    assert errors.rmse.shape == errors.fit.shape == (5, 2)
    assert errors.horizons.tolist() == [1.0, 2.0, 3.0, 5.0, np.inf]
    off_mean = np.concatenate([part - part.mean(axis=0) for part in (Y[:25], Y[25:])])
    for horizon, rmse, fit in zip((1, 2, 3, 5, None), errors.rmse, errors.fit, strict=True):
        found = predict(MODEL, u=U, y=Y, gain=K, x0=X0, horizon=horizon, lengths=LENGTHS)
        np.testing.assert_allclose(rmse, np.sqrt(np.mean((Y - found) ** 2, axis=0)), rtol=1e-12)
        expected = 1.0 - np.linalg.norm(Y - found, axis=0) / np.linalg.norm(off_mean, axis=0)
        np.testing.assert_allclose(fit, 100.0 * expected, rtol=1e-9)
    assert horizon_errors(MODEL, u=U, y=Y).rmse.shape == (1, 2)


class Fitted(NamedTuple):
    """What a fit has that prediction asks for."""

    model: object
    innovation_gain: np.ndarray | None
    output_offset: np.ndarray | None


@pytest.mark.parametrize("offset", [np.array([2.0, -3.0]), np.array([[2.0, -3.0], [0.5, 7.0]])])
def test_a_fit_predicts_with_its_gain_and_offset(offset):
    level = np.repeat(np.broadcast_to(offset, (2, 2)), LENGTHS, axis=0)
    along = {"u": U, "x0": X0, "lengths": LENGTHS}
    fit = Fitted(MODEL, K, offset)
    expected = predict(MODEL, y=Y, gain=K, horizon=2, **along) + level
    np.testing.assert_allclose(predict(fit, y=Y + level, horizon=2, **along), expected, atol=1e-12)
    simulated = predict(fit, **along)
    np.testing.assert_allclose(simulated, predict(MODEL, **along) + level, atol=1e-12)
    errors = horizon_errors(fit, y=Y + level, **along)
    np.testing.assert_allclose(
        errors.rmse, horizon_errors(MODEL, y=Y, gain=K, **along).rmse, atol=1e-12
    )
    # What is given goes before what was fitted.
    other = predict(fit, y=Y, gain=0.0 * K, output_offset=[0.0, 0.0], **along)
    np.testing.assert_allclose(other, predict(MODEL, **along), atol=1e-12)
    with pytest.raises(ValueError, match=r"\(2,\), or \(3, 2\) for an offset of each record"):
        predict(fit, u=U, output_offset=np.ones((2, 2)), lengths=(20, 20, 20))


def test_a_model_in_continuous_time_is_given_the_sample_time():
    continuous = MODEL.to_continuous()
    along = {"u": U, "y": Y, "gain": K, "horizon": 3}
    found = predict(continuous, dt=0.1, **along)
    np.testing.assert_allclose(found, predict(MODEL, **along), atol=1e-9)
    lag = NonlinearModel(
        {"rate": 2.0}, lambda p, x, u: u - p["rate"] * x, lambda p, x, u: x, rest=[0.0]
    )
    with pytest.raises(ValueError, match="dt: the model is in continuous time"):
        predict(lag, u=U[:, :1])


def test_gradients_in_the_gain_and_jit():
    @jax.jit
    def cost(gain):
        return jnp.mean((Y - predict(MODEL, u=U, y=Y, gain=gain, horizon=3)) ** 2)

    gradient = jax.grad(cost)(jnp.asarray(K))
    step = np.zeros_like(K)
    step[1, 0] = 1e-6
    slope = (cost(K + step) - cost(K - step)) / 2e-6
    np.testing.assert_allclose(gradient[1, 0], slope, rtol=1e-6)


def test_fit_by_record():
    y_hat = Y + 0.1 * RNG.standard_normal(Y.shape)
    found = fit_by_record(Y, y_hat, LENGTHS, metric=nrmse_fit)
    np.testing.assert_allclose(found[1], nrmse_fit(Y[25:], y_hat[25:]))
    assert found.shape == (2, 2)


def test_faults_are_named():
    for arguments, message in (
        ({"horizon": 0, "gain": K, "y": Y}, "horizon is 0"),
        ({"gain": K}, "y: prediction with a gain"),
        ({"gain": K.T, "y": Y}, "gain has shape"),
        ({"gain": K, "y": Y[1:]}, "y has shape"),
        ({"lengths": (10, 10)}, "lengths"),
        ({"x0": np.zeros((3, 3)), "lengths": LENGTHS}, "x0 has shape"),
    ):
        with pytest.raises(ValueError, match=message):
            predict(MODEL, u=U, **arguments)
    continuous = StateSpace(A - np.eye(3), B, C, D)
    with pytest.raises(ValueError, match="discrete-time"):
        predict(continuous, u=U, y=Y, gain=K)
    with pytest.raises(ValueError, match="at least 1 sample"):
        horizon_errors(MODEL, u=U, y=Y, gain=K, horizons=[0, 1])
