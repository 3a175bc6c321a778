"""How often intervals contain the truth: over offsets, and under a robust loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import PastOutputMOESP, identify
from lpvid.models import FunctionStructure, StateSpace, StructuredModel
from lpvid.refinement import HuberLoss, Innovation, OutputError, SquaredLoss, refine

# Shares of 400 runs: a 95 % interval covers 95 ± 3.3 % of them but for one time in a thousand.
RUNS, MARGIN = 400, 0.033


def shares(one_run):
    """Share of the runs in which each interval contains the truth."""
    keys = jax.random.split(jax.random.key(0), RUNS)
    return np.mean(np.asarray(jax.jit(lambda keys: jax.lax.map(one_run, keys))(keys)), axis=0)


@pytest.mark.slow
def test_a_gain_is_as_uncertain_as_the_offset_makes_it():
    truth = StateSpace([[0.9]], [[1.0]], [[1.0]], dt=0.1)
    method = PastOutputMOESP(order=1, block_rows=5, feedthrough=False, offset=True)

    def run(key):
        first, second = jax.random.split(key)
        u = 3.0 + jax.random.normal(first, (400, 1))
        y = truth.simulate(u=u) + 5.0 + 0.5 * jax.random.normal(second, (400, 1))
        data = IOData(u=u, y=y, dt=0.1)
        fit = refine(identify(data, method), data, throw=False)

        def gain(parameters):
            model = fit.model_at(parameters)
            return (model.C @ model.B / (1.0 - model.A))[0, 0]

        slope = jax.grad(gain)(fit.parameters)
        error = jnp.sqrt(slope @ fit.covariance @ slope)
        offset = jnp.abs(fit.output_offset[0] - 5.0) < 1.96 * fit.standard_errors[-1]
        return jnp.stack([jnp.abs(gain(fit.parameters) - 10.0) < 1.96 * error, offset])

    np.testing.assert_allclose(shares(run), 0.95, atol=MARGIN)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [HuberLoss(), SquaredLoss()])
def test_outputs_of_one_noise_do_not_make_an_interval_too_narrow(loss):
    def lag(parameters):
        pole, gain = parameters
        # The second output has only the noise: with it the best weights take most of it out.
        return -pole[None, None], jnp.ones((1, 1)), gain * jnp.array([[1.0], [0.0]])

    structure = FunctionStructure(lag, nominal=np.array([1.0, 2.0]))
    truth = StructuredModel(structure, [1.0, 2.0])

    def run(key):
        first, second, third = jax.random.split(key, 3)
        u = jax.random.normal(first, (300, 1))
        common = jax.random.normal(second, (300, 1))
        noise = 0.2 * common + 0.06 * jax.random.normal(third, (300, 2))
        data = IOData(u=u, y=truth.simulate(u=u, dt=0.1) + noise, dt=0.1)
        fit = refine(truth, data, loss=loss, throw=False)
        missed = jnp.abs(fit.parameters - truth.parameters)
        robust = jnp.sqrt(jnp.diagonal(fit.robust_covariance))
        return jnp.stack([missed < 1.96 * fit.standard_errors, missed < 1.96 * robust])

    white, robust = shares(run)
    np.testing.assert_allclose(white, 0.95, atol=MARGIN)
    # The long-run variance is itself an estimate, a little low on 300 samples.
    assert np.all(robust > 0.88)


@pytest.mark.slow
def test_an_offset_that_an_integrator_hides_is_not_identified():
    def integrator(parameters):
        return jnp.zeros((1, 1)), parameters[:1, None], jnp.ones((1, 1))

    rng = np.random.default_rng(0)
    u = rng.standard_normal((200, 1))
    truth = StructuredModel(FunctionStructure(integrator, nominal=np.array([2.0])), [2.0])
    y = truth.simulate(u=u, dt=0.1) + 5.0 + 0.01 * rng.standard_normal((200, 1))
    data = IOData(u=u, y=y, dt=0.1)
    with pytest.warns(UserWarning, match=r"Not identified: offset\[0\]"):
        fit = refine(truth, data, output_offset="free", throw=False)
    assert abs(fit.parameters[0] - 2.0) < 4.0 * fit.standard_errors[0] < 0.1
    assert np.isinf(fit.standard_errors[1])
    with pytest.warns(UserWarning, match=r"Not identified: offset\[0\]"):
        pieces = refine(
            truth, data, output_offset="free", predictor=OutputError(shooting=25), throw=False
        )
    np.testing.assert_allclose(pieces.standard_errors, fit.standard_errors, rtol=1e-3)
    # From rest it can be told.
    known = refine(truth, data, output_offset="free", initial_state="zero")
    assert abs(known.output_offset[0] - 5.0) < 4.0 * known.standard_errors[1]


@pytest.mark.slow
def test_a_predictor_that_never_forgets_its_start_is_said():
    truth = StructuredModel(
        FunctionStructure(
            lambda p: (
                jnp.stack([jnp.array([0.0, 1.0]), -p]),
                jnp.array([[0.0], [1.0]]),
                jnp.eye(1, 2),
            ),
            nominal=np.array([9.0, 0.5]),
        ),
        [9.0, 0.5],
    )

    def run(key):
        first, second = jax.random.split(key)
        u = jax.random.normal(first, (240, 1))
        y = truth.simulate(u=u, dt=0.1) + 0.05 * jax.random.normal(second, (240, 1))
        data = IOData(u=u, y=y, dt=0.1)
        fit = refine(truth, data, predictor=Innovation(), throw=False)
        model = fit.model.state_space.discretise(0.1)
        power = jnp.linalg.matrix_power(model.A - fit.innovation_gain @ model.C, 1024)
        growth = jnp.linalg.norm(power @ power) / jnp.linalg.norm(power)
        return growth, fit.status == Status.unstable_predictor

    growth, said = jax.lax.map(run, jax.random.split(jax.random.key(1), 20))
    # Over 1024 samples a pole of 1.0014 grows by 4: no search goes further, and it is said.
    assert np.all(growth < 4.0 * (1.0 + 1e-6))
    assert np.any(growth > 2.0) and np.all(said[growth > 2.0])
