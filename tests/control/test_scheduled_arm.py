"""The two-link arm's own loop, and output feedback designed for several models at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.analysis import hinf_norm
from lpvid.control import (
    OutputFeedback,
    ScheduledController,
    balanced_sensitivity,
    design_output_feedback,
    simulate_closed_loop,
    simulate_two_link_loop,
    step_costs,
    two_link_positions,
)
from lpvid.mechanics import reference_two_link_arm
from lpvid.models import StateSpace

ARM = reference_two_link_arm()
DT, THETA2, SAMPLES = 5e-3, 1.2, 40
ENDS = (-0.9, 0.9)


def feedback(size):
    gain = jnp.concatenate([size * jnp.diag(jnp.array([9.0, 20.0])), jnp.zeros((2, 2))], axis=1)
    return OutputFeedback(gain, jnp.eye(2, 4, 2))


def scheduled(sizes):
    return ScheduledController.from_designs([feedback(size) for size in sizes], ENDS)


def motion(controller, step):
    start = jnp.array([0.0, THETA2, 0.0, 0.0])
    wanted = jnp.tile((start + jnp.array([1.0, -0.5, 0.0, 0.0]) * step)[None], (SAMPLES, 1))
    return simulate_two_link_loop(
        ARM, controller, reference=wanted, dt=DT, theta2_start=THETA2, substeps=3
    )


@pytest.mark.slow
def test_small_motions_are_those_of_the_linear_loop():
    control = scheduled([0.5, 1.5])
    step = 1e-5
    found = motion(control, step)
    plant = two_link_positions(ARM.linearised(THETA2))
    wanted = np.tile([step, -0.5 * step, 0.0, 0.0], (SAMPLES, 1))
    frozen = control.at(np.cos(THETA2))
    expected = simulate_closed_loop(plant, frozen, reference=wanted, dt=DT)
    moved = np.asarray(found.y)[:, :4] - np.array([0.0, THETA2, 0.0, 0.0])
    # Beyond the first order there is a step times as much, in units of the largest output.
    largest = np.abs(expected.y).max()
    np.testing.assert_allclose(moved, expected.y, rtol=0.0, atol=1e-3 * largest)
    np.testing.assert_allclose(found.y[:, 4], np.cos(found.states[:, 1]))


def test_refusals():
    drift = StateSpace([[1.0]], [[0.1]], [[1.0]], dt=0.1)
    with pytest.raises(ValueError, match="tracked"):
        design_output_feedback(drift, starts=[[[1.0]]], bounds=(0.0, 9.0), tracked=[1])
    with pytest.raises(ValueError, match="fewer than two samples"):
        design_output_feedback(drift, starts=[[[1.0]]], bounds=(0.0, 9.0), duration=0.1)
    with pytest.raises(ValueError, match="two velocity references"):
        two_link_positions(drift)
    with pytest.raises(ValueError, match="theta2_start"):
        simulate_two_link_loop(
            ARM, feedback(1.0), reference=np.zeros((3, 4)), dt=DT, theta2_start=4.0
        )


@pytest.mark.slow
def test_gradient_through_the_nonlinear_loop():
    def cost(size):
        return jnp.sum(motion(scheduled([size, 2.0 * size]), 0.3).y[:, 0] ** 2)

    cost = jax.jit(cost)
    slope = (cost(0.5 + 1e-5) - cost(0.5 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.jacfwd(cost))(0.5), slope, rtol=1e-6)


@pytest.mark.slow
def test_design_for_two_integrators_meets_the_margin_and_no_neighbour_is_better():
    speeds = np.array([0.1, 0.25])[:, None, None]
    # A sample's delay limits the gain.
    A = np.tile([[1.0, 0.0], [0.0, 0.0]], (2, 1, 1))
    A[:, :1, 1:] = speeds
    plants = StateSpace(A, [[[0.0], [1.0]]] * 2, [[[1.0, 0.0]]] * 2, dt=0.1)
    options = {"bounds": (0.1, 9.0), "slowest": 0.1, "duration": 4.0}
    starts = [[[0.5]], [[1.5]]]
    found = design_output_feedback(plants, starts=starts, disc_margin=0.9, **options)
    gain = float(found.controller.gain[0, 0])
    np.testing.assert_allclose(found.gains, gain, rtol=1e-3)

    def measures(gain):
        control = OutputFeedback([[gain]], [[0.0]])
        margin = 2.0 / hinf_norm(balanced_sensitivity(plants, control)).value.max()
        return float(step_costs(plants, control, duration=4.0).mean()), float(margin)

    # The margin of the search lies a little on the safe side.
    cost, margin = measures(gain)
    assert 0.9 - 1e-3 <= margin <= 0.95
    np.testing.assert_allclose(found.cost, cost, rtol=1e-9)
    better = [other for other in np.linspace(0.1, 9.0, 60) if measures(other)[0] < 0.97 * cost]
    assert all(measures(other)[1] < 0.9 + 0.05 for other in better)
