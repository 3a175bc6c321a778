"""The predictor with its effects: beside independent integrators, derivatives by differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from jax.flatten_util import ravel_pytree

from lpvid.data import IOData
from lpvid.effects import law
from lpvid.loop._candidates import Place, slots_of
from lpvid.loop._columns import along, trial_columns
from lpvid.loop._program import Injection, Setting, nothing_injected, trace
from lpvid.loop._records import records_of
from lpvid.loop._search import COLUMNS, injected, run, sensitivities
from lpvid.loop._tune import empty_unknowns
from lpvid.loop.structures import structure_named
from lpvid.models import StateSpace

DT = 0.05
# Lower triangles of M, D and K of two masses.
THETA = np.array([1.0, 0.1, 0.6, 0.9, -0.2, 0.5, 30.0, -12.0, 22.0])
LEVEL, WIDTH, CUBIC = 0.5, 0.05, 60.0
LAWS = (law("coulomb"), law("cubic-stiffness"))
# Dry friction on the first mass, a stiffening spring between both.
PLACES = (Place(0, "force", 0), Place(1, "force", 2))


def _symmetric(entries):
    return np.array([[entries[0], entries[1]], [entries[1], entries[2]]])


def _data(samples, dt=DT, hold=4):
    rng = np.random.default_rng(3)
    u = 3.0 * np.repeat(rng.standard_normal((samples // hold + 1, 2)), hold, axis=0)[:samples]
    return IOData(u=u, y=0.1 * rng.standard_normal((samples, 2)), dt=dt)


def _model(data, places, hold="zero"):
    structure = structure_named("mass-spring-damper", data)
    setting = Setting(structure, LAWS, data.dt)
    records = records_of(data, np.zeros((1, 0)), data.dt * data.n_samples, hold=hold)
    slots = slots_of(structure, places, 1)
    unknowns = empty_unknowns(THETA, 4, 1, 1)
    unknowns = eqx.tree_at(lambda v: v.start, unknowns, jnp.array([[0.05, -0.02, 0.1, 0.0]]))
    if places:
        amplitude, shape = np.zeros((3, 2, 1)), np.zeros((3, 2))
        amplitude[0, 0], amplitude[1, 0], shape[0, 0] = LEVEL, CUBIC, WIDTH
        unknowns = eqx.tree_at(
            lambda v: (v.amplitude, v.shape), unknowns, (jnp.asarray(amplitude), jnp.asarray(shape))
        )
    return setting, records, slots, unknowns


def _outputs(data, places, hold="zero"):
    """Simulated outputs: a gain of zero."""
    model = _model(data, places, hold)
    out = run(*model, jnp.zeros((1, 4, 2)))
    return np.asarray(data.y) - np.asarray(out.innovations)


@pytest.fixture(scope="module")
def truth():
    """SciPy's outputs of the same plant, sample by sample, at 0.05 s."""
    data = _data(160)
    mass, damping, stiffness = (_symmetric(part) for part in np.split(THETA, 3))
    x, states = np.array([0.05, -0.02, 0.1, 0.0]), []

    def rate(t, state, u):
        q, v = state[:2], state[2:]
        spring = CUBIC * (q[0] - q[1]) ** 3
        extra = np.array([-LEVEL * np.tanh(v[0] / WIDTH) - spring, spring])
        force = u - damping @ v - stiffness @ q + extra
        return np.concatenate([v, np.linalg.solve(mass, force)])

    for u in np.asarray(data.u):
        states.append(x)
        x = scipy.integrate.solve_ivp(rate, (0.0, DT), x, args=(u,), rtol=1e-9, atol=1e-11).y[:, -1]
    return np.array(states)[:, :2]


def test_a_linear_model_is_simulated_exactly():
    data = _data(160)
    setting, _, _, unknowns = _model(data, ())
    ports = setting.structure.ports(unknowns.theta, jnp.zeros(0))
    model = StateSpace(ports.A, ports.B, ports.C, ports.D)
    expected = np.asarray(model.simulate(u=data.u, dt=DT, x0=unknowns.start[0]))
    np.testing.assert_allclose(_outputs(data, ()), expected, rtol=1e-9, atol=1e-11)


def test_inputs_that_run_straight_between_samples_beside_scipy():
    data = _data(160, hold=1)
    setting, _, _, unknowns = _model(data, ())
    ports = setting.structure.ports(unknowns.theta, jnp.zeros(0))
    system = (ports.A, ports.B, ports.C, ports.D)
    times = DT * np.arange(160)
    start = np.asarray(unknowns.start[0])
    _, expected, _ = scipy.signal.lsim(system, np.asarray(data.u), times, X0=start)
    found = _outputs(data, (), "linear")
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
    # In several steps a sample, with effects of no strength, it is the same path.
    setting, records, slots, unknowns = _model(data, PLACES, "linear")
    none = eqx.tree_at(lambda v: v.amplitude, unknowns, jnp.zeros_like(unknowns.amplitude))
    out = run(setting, records, slots, none, jnp.zeros((1, 4, 2)))
    np.testing.assert_allclose(records.y - out.innovations, expected, rtol=1e-9, atol=1e-11)
    assert np.std(found - _outputs(data, ())) > 0.1 * np.std(expected)


def test_effects_beside_scipy_and_of_second_order(truth):
    linear = _outputs(_data(160), ())
    coarse = _outputs(_data(160), PLACES)
    # The same input at half the sample time.
    half = _data(160)
    half = IOData(u=np.repeat(np.asarray(half.u), 2, axis=0), y=np.zeros((320, 2)), dt=DT / 2)
    fine = _outputs(half, PLACES)[::2]
    moved = np.sqrt(np.mean((truth - linear) ** 2))
    errors = [np.sqrt(np.mean((one - truth) ** 2)) for one in (coarse, fine)]
    assert errors[0] < 2e-3 * moved
    assert errors[1] < errors[0] / 3.0


@pytest.fixture(scope="module")
def short():
    """A predictor that corrects itself, over few samples, with both effects."""
    gain = jnp.asarray(np.random.default_rng(4).uniform(0.05, 0.2, (1, 4, 2)))
    return _model(_data(40), PLACES), gain


def test_derivatives_by_parameters_amplitudes_shapes_and_starts(short):
    (setting, records, slots, unknowns), gain = short
    flat, unravel = ravel_pytree(unknowns)
    # θ; amplitudes of the first and second slot; the width; the initial state.
    places = np.array([0, 1, 4, 8, 9, 11, 15, 21, 23])
    got = sensitivities(setting, records, slots, unknowns, gain, places)[1]
    for column, place in enumerate(places):
        step = 1e-6 * max(abs(float(flat[place])), 1.0)
        ahead, behind = (
            np.asarray(
                run(setting, records, slots, unravel(flat.at[place].add(h)), gain).innovations
            )
            for h in (step, -step)
        )
        expected = (ahead - behind) / (2.0 * step)
        assert np.abs(expected).max() > 0.0
        np.testing.assert_allclose(
            got[:, :, column], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max()
        )


def test_derivatives_by_injected_signals(short):
    (setting, records, slots, unknowns), gain = short
    rng = np.random.default_rng(6)
    signals = Injection(
        jnp.asarray(rng.standard_normal((COLUMNS, 40, 4))),
        jnp.asarray(rng.standard_normal((COLUMNS, 40, 2))),
    )
    got = injected(setting, records, slots, unknowns, gain, signals)
    one = jax.tree.map(lambda leaf: leaf[5], signals)
    simulate = eqx.filter_jit(
        lambda size: (
            trace(
                setting, records, slots, unknowns, gain, jax.tree.map(lambda leaf: size * leaf, one)
            ).innovations
        )
    )
    expected = (simulate(jnp.asarray(1e-5)) - simulate(jnp.asarray(-1e-5))) / 2e-5
    np.testing.assert_allclose(got[5], expected, rtol=1e-6, atol=1e-7)
    still = nothing_injected(records, 4)
    assert still.state.shape == (40, 4) and still.output.shape == (40, 2)


@pytest.mark.parametrize("place", [PLACES[1], PLACES[1]._replace(modulated=True)])
def test_a_candidate_is_tested_in_the_direction_it_would_take(place):
    setting, records, slots, unknowns = _model(_data(40), ())
    gain = jnp.full((1, 4, 2), 0.1)
    base = along(setting, records, slots, unknowns, gain)
    (_, columns), *_ = trial_columns(base, [place])
    # The derivative at an amplitude of zero with the law in the program itself.
    seated = slots_of(setting.structure, [place], 1)
    size = unknowns.theta.size
    expected = sensitivities(setting, records, seated, unknowns, gain, np.array([size]))[1]
    size = np.abs(expected).max()
    # One step a sample here, four there: a straight line takes 3 (ω h)²/12 of a cubed sine.
    fastest = np.abs(np.linalg.eigvals(setting.structure.ports(unknowns.theta, jnp.zeros(0)).A))
    np.testing.assert_allclose(columns, expected, atol=0.25 * (fastest.max() * DT) ** 2 * size)
