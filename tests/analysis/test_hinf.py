import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from analysis_systems import modal_system, sampled, slicot_norm, stack
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid._results import Status
from lpvid.analysis import Lapack, SimultaneousIteration, hinf_norm
from lpvid.models import StateSpace

# Compiling is what these tests cost: most of them share the shapes (6, 2, 2) and (2, 1, 1).
norms = eqx.filter_jit(hinf_norm)


def dense_gain(A, B, C, D, omega):
    states = np.linalg.solve(1j * omega[:, None, None] * np.eye(A.shape[0]) - A, B[None])
    return np.linalg.svd(C @ states + D, compute_uv=False)[:, 0]


@pytest.mark.parametrize(
    ("nx", "nu", "ny", "dt"), [(3, 1, 1, 0.0), (12, 2, 2, 0.0), (12, 3, 2, 0.02), (20, 3, 4, 0.0)]
)
def test_agrees_with_slicot(nx, nu, ny, dt):
    rng = np.random.default_rng(nx)
    systems = [
        modal_system(rng, nx, nu, ny, damping=1e-3, feedthrough=index % 2) for index in range(25)
    ]
    if dt:
        systems = [sampled(*system, dt) for system in systems]
    found = norms(StateSpace(*stack(systems), dt=dt))
    expected = np.array([slicot_norm(*system, dt) for system in systems])
    assert np.all(found.status == Status.successful)
    np.testing.assert_allclose(found.value, expected[:, 0], rtol=1e-9)
    finite = np.isfinite(expected[:, 1]) & (expected[:, 1] < 1e6)
    np.testing.assert_allclose(
        np.asarray(found.frequency)[finite], expected[finite, 1], rtol=1e-3, atol=1e-3
    )


def extended_gain(A, B, C, D, point):
    """The largest singular value at one point by elimination in extended precision."""
    nx = A.shape[0]
    pencil = (point * np.eye(nx) - A).astype(np.clongdouble)
    table = np.concatenate([pencil, B.astype(np.clongdouble)], axis=1)
    for k in range(nx):
        pivot = k + np.argmax(np.abs(table[k:, k]))
        table[[k, pivot]] = table[[pivot, k]]
        factors = table[:, k] / table[k, k]
        factors[k] = 0.0
        table -= factors[:, None] * table[k]
    states = table[:, nx:] / np.diagonal(table)[:, None]
    return np.linalg.norm((C @ states + D).astype(complex), 2)


@pytest.mark.slow
# Sampled faster, the slowest modes lie so close to the unit circle that one rounding of A changes
# the norm by 1e-9.
@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize(("nx", "nu", "ny"), [(2, 1, 1), (7, 3, 2), (25, 2, 3)])
def test_random_systems(nx, nu, ny, dt):
    # `python -m benchmarks.hinf --systems 1000` takes more of them, with up to 50 states.
    rng = np.random.default_rng(8)
    unstable = [index % 5 == 4 for index in range(20)]
    systems = [
        modal_system(rng, nx, nu, ny, feedthrough=index % 2, unstable=int(unstable[index]))
        for index in range(20)
    ]
    if dt:
        systems = [sampled(*system, dt) for system in systems]
    found = norms(StateSpace(*stack(systems), dt=dt))
    expected = np.array([slicot_norm(*system, dt)[0] for system in systems])
    assert np.array_equal(found.status == Status.l_infinity, unstable)
    assert np.array_equal(found.status == Status.successful, np.logical_not(unstable))
    assert np.all(found.value >= expected * (1 - 1e-9))
    # AB13DD now and then misses a peak: what lies above it has to be attained.
    for index in np.flatnonzero(found.value > expected * (1 + 1e-9)):
        omega = float(found.frequency[index])
        point = np.exp(1j * omega * dt) if dt else 1j * omega
        attained = extended_gain(*systems[index], point)
        np.testing.assert_allclose(found.value[index], attained, rtol=1e-9)


def first_order(pole, gain, D, dt=0.0):
    """gain / (s - pole) + D beside a state that nothing reaches."""
    still = -0.3
    A = np.diag([pole, still])
    return StateSpace(A, [[gain], [0.0]], [[1.0, 0.0]], [[D]], dt=dt)


def test_known_peaks():
    # A second-order resonance: 1 / (2 zeta sqrt(1 - zeta^2)) at sqrt(1 - 2 zeta^2).
    zeta = 1e-4
    found = norms(StateSpace([[0.0, 1.0], [-1.0, -2 * zeta]], [[0.0], [1.0]], [[1.0, 0.0]]))
    np.testing.assert_allclose(found.value, 1 / (2 * zeta * np.sqrt(1 - zeta**2)), rtol=1e-11)
    np.testing.assert_allclose(found.frequency, np.sqrt(1 - 2 * zeta**2), rtol=1e-9)
    # Low pass: the peak is at zero. High pass s / (s + 1): at infinity. All pass: one everywhere.
    found = norms(first_order(-3.0, 6.0, 0.0))
    np.testing.assert_allclose([found.value, found.frequency], [2.0, 0.0], atol=1e-12)
    found = norms(first_order(-1.0, -1.0, 1.0))
    np.testing.assert_allclose(found.value, 1.0, rtol=1e-10)
    assert found.frequency == np.inf
    found = norms(first_order(-1.0, -2.0, 1.0))
    np.testing.assert_allclose(found.value, 1.0, rtol=1e-10)
    # Discrete high pass: the peak is at the Nyquist frequency.
    found = norms(first_order(-0.5, 1.0, 0.0, dt=0.1))
    np.testing.assert_allclose([found.value, found.frequency], [2.0, np.pi / 0.1], rtol=1e-10)


def test_poles_on_the_boundary_and_broken_systems():
    oscillator = StateSpace([[0.0, 1.0], [-4.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]])
    for system in (
        oscillator,
        first_order(0.0, 1.0, 0.0),
        first_order(1.0, 1.0, 0.0, dt=0.1),
        first_order(-1.0, 1.0, 0.0, dt=0.1),
    ):
        found = norms(system)
        assert found.value == np.inf and found.status == Status.infinite_norm
    broken = norms(first_order(np.nan, 1.0, 0.0))
    assert np.isnan(broken.value) and broken.status == Status.nonfinite
    with pytest.raises(ValueError, match=r"system\.A holds NaN"):
        hinf_norm(first_order(np.nan, 1.0, 0.0))
    with pytest.raises(ValueError, match="tolerance"):
        hinf_norm(oscillator, tolerance=0.0)


@pytest.mark.parametrize("unstable", [1, 3])
def test_unstable_systems_have_an_l_infinity_norm(unstable):
    A, B, C, D = modal_system(np.random.default_rng(5), 6, 2, 2, damping=1e-2, unstable=unstable)
    found = norms(StateSpace(A, B, C, D))
    poles = np.linalg.eigvals(A)
    grid = np.abs(poles.imag[:, None]) + np.abs(poles.real[:, None]) * np.linspace(-4, 4, 20001)
    grid = np.append(np.abs(grid.ravel()), np.logspace(-3, 4, 20001))
    dense = max(dense_gain(A, B, C, D, grid).max(), np.linalg.norm(D, 2))
    assert found.status == Status.l_infinity
    np.testing.assert_allclose(found.value, dense, rtol=1e-6)
    assert found.value >= dense * (1 - 1e-10)


def norm_of(matrices, dt):
    return hinf_norm(StateSpace(*matrices, dt=dt)).value


reverse = jax.jit(jax.value_and_grad(norm_of), static_argnums=1)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_gradient_against_differences(dt):
    rng = np.random.default_rng(6)
    dampings = [0.3, 1e-1, 1e-2, 1e-3, 1e-4] * 3
    systems = [
        modal_system(rng, 6, 2, 2, damping=damping, feedthrough=index % 2)
        for index, damping in enumerate(dampings)
    ]
    if dt:
        systems = [sampled(*system, dt) for system in systems]
    # A step moves the pole nearest to the boundary by a small part of its distance from there.
    poles = np.linalg.eigvals(np.stack([system[0] for system in systems]))
    margin = np.min(1.0 - np.abs(poles) if dt else -poles.real, axis=1)
    matrices = tuple(jnp.asarray(m) for m in stack(systems))
    directions = [rng.standard_normal(m.shape) for m in matrices]
    directions[0] *= (
        margin[:, None, None] / np.linalg.norm(directions[0], 2, axis=(1, 2))[:, None, None]
    )

    @jax.jit
    def values(step):
        moved = (m + step * d for m, d in zip(matrices, directions, strict=True))
        found = hinf_norm(StateSpace(*moved, dt=dt))
        return found.value, found.frequency

    # Of fourth order: a step large enough that the rounding errors of a norm next to the boundary,
    # about 1e-10, do not count.
    step = 2e-3
    up, down, far_up, far_down = (values(k * step) for k in (1, -1, 2, -2))
    difference = (8 * (up[0] - down[0]) - (far_up[0] - far_down[0])) / (12 * step)
    derivative, _ = jax.jit(jax.jacrev(values, has_aux=True))(0.0)
    # Where another peak takes over between the points there is a kink, not a derivative.
    smooth = np.abs(far_up[1] - far_down[1]) <= 0.05 * far_up[1]
    assert np.sum(smooth) >= 14
    np.testing.assert_allclose(derivative[smooth], difference[smooth], rtol=1e-5)


@pytest.mark.slow
def test_forward_derivative_equals_reverse():
    rng = np.random.default_rng(11)
    matrices = tuple(jnp.asarray(m) for m in modal_system(rng, 6, 2, 2, feedthrough=0.3))
    tangents = tuple(jnp.asarray(rng.standard_normal(m.shape)) for m in matrices)
    forward = jax.jit(lambda m, t: jax.jvp(lambda x: norm_of(x, 0.0), (m,), (t,))[1])
    _, gradient = reverse(matrices, 0.0)
    total = sum(jnp.sum(g * t) for g, t in zip(gradient, tangents, strict=True))
    np.testing.assert_allclose(forward(matrices, tangents), total, rtol=1e-9)


@pytest.mark.slow
def test_batches_equal_single_systems():
    rng = np.random.default_rng(9)
    # Unlike cases in one batch: the general route of one must not disturb the others.
    systems = [modal_system(rng, 6, 2, 2, feedthrough=0.0) for _ in range(4)]
    systems.insert(1, (-np.eye(6) + np.diag(np.ones(5), 1), *systems[0][1:]))
    systems.insert(3, (systems[0][0], 0.0 * systems[0][1], *systems[0][2:]))
    batch = stack(systems)
    single = [norms(StateSpace(*system)).value for system in systems]
    nested = tuple(m.reshape(2, 3, *m.shape[1:]) for m in batch)
    mapped = jax.jit(jax.vmap(lambda *m: hinf_norm(StateSpace(*m)).value))(*nested)
    looped = jax.jit(lambda m: jax.lax.map(lambda s: norm_of(s, 0.0), m))(batch)
    for values in (mapped.ravel(), looped):
        np.testing.assert_allclose(values, single, rtol=1e-10, atol=1e-14)


SHAPES = {
    "repeated": np.eye(6),
    "defective": np.eye(6) - np.diag(np.ones(5), 1),
    "triangular": np.eye(6) + np.triu(np.full((6, 6), -0.5), 1),
    "pairs": np.diag([1.0, 1.0, 2.0, 2.0, 3.0, 3.0]),
    # Two equal oscillators in a chain: a defective pair off the real axis.
    "chain": np.kron(np.eye(3), [[0.2, -1.0], [1.0, 0.2]]) + np.diag([0.0, 1, 0, 1, 0], 1),
}


@settings(max_examples=30, deadline=None)
@given(
    b=st.lists(st.integers(-3, 3).map(float), min_size=12, max_size=12),
    c=st.lists(st.integers(-3, 3).map(float), min_size=12, max_size=12),
    kind=st.sampled_from(list(SHAPES)),
    nothing=st.sampled_from(["", "", "B", "C"]),
    rate=st.sampled_from([-1e6, -0.3, 1e-6, 0.01, 1.0, 10.0]),
    direct=st.sampled_from([0.0, 1e-3, 1.0, 1e4]),
)
def test_awkward_systems_are_finite(b, c, kind, nothing, rate, direct):
    A = -rate * SHAPES[kind]
    B = np.array(b).reshape(6, 2) * (nothing != "B")
    C = np.array(c).reshape(2, 6) * (nothing != "C")
    D = direct * np.array([[1.0, 0.5], [0.0, -1.0]])
    value, gradient = reverse(tuple(jnp.asarray(m) for m in (A, B, C, D)), 0.0)
    omega = np.concatenate([[0.0], np.logspace(-3, 3, 1000), np.linspace(0.2, 4.0, 2000)])
    dense = max(dense_gain(A, B, C, D, np.abs(rate) * omega).max(), np.linalg.norm(D, 2))
    assert value >= dense * (1 - 1e-9)
    np.testing.assert_allclose(value, dense, rtol=1e-3, atol=1e-12)
    assert all(np.all(np.isfinite(g)) for g in gradient)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(-6, 6), st.floats(-6, 6), st.floats(-3, 3))
def test_scaling(seed, frequency, gain, basis):
    rng = np.random.default_rng(seed)
    A, B, C, D = modal_system(rng, 6, 2, 2, damping=1e-3, feedthrough=0.0)
    base = norms(StateSpace(A, B, C, D))
    T = 10 ** np.linspace(-basis / 2, basis / 2, 6)
    speed, size = 10**frequency, 10**gain
    scaled = norms(
        StateSpace(speed * T[:, None] * A / T, speed * T[:, None] * B, size * C / T, size * D)
    )
    np.testing.assert_allclose(scaled.value, size * base.value, rtol=1e-8)


def test_equal_systems_differ_by_nothing():
    A, B, C, D = modal_system(np.random.default_rng(3), 3, 2, 2, damping=1e-2, feedthrough=0.0)
    system = StateSpace(A, B, C, D)
    found = norms(system - system)
    assert found.status == Status.successful
    assert found.value <= 1e-11 * dense_gain(A, B, C, D, np.logspace(-2, 3, 1000)).max()


def test_the_device_route_gives_the_same_norms():
    rng = np.random.default_rng(4)
    systems = [
        modal_system(rng, 6, 2, 2, feedthrough=index % 2, unstable=index // 6) for index in range(8)
    ]
    B, C, D = systems[0][1:]
    systems += [(-shape, B, C, D) for shape in SHAPES.values()]
    systems += [(systems[1][0], 0.0 * B, C, D), (systems[1][0], B, C, 1e6 * D)]
    for system in systems:
        model = StateSpace(*system)
        ours, theirs = norms(model, eigensolver=SimultaneousIteration()), norms(model)
        np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-9)
        assert ours.status == theirs.status
    oscillator = StateSpace(np.kron(np.eye(3), [[0.0, 2.0], [-2.0, 0.0]]), B, C, D)
    assert norms(oscillator, eigensolver=SimultaneousIteration()).status == Status.infinite_norm


def test_the_device_route_lowers_for_a_gpu():
    def value(A, B, C, D):
        return hinf_norm(StateSpace(A, B, C, D), eigensolver=SimultaneousIteration()).value

    matrices = stack([modal_system(np.random.default_rng(0), 6, 2, 2)] * 2)
    gradient = jax.jit(jax.grad(lambda *m: jnp.sum(value(*m))))
    text = gradient.trace(*matrices).lower(lowering_platforms=("cuda",)).as_text()
    assert "geev" not in text and "lapack" not in text


@pytest.mark.slow
@pytest.mark.parametrize(("nx", "nu", "ny", "dt"), [(12, 3, 2, 0.0), (25, 1, 2, 0.1)])
def test_the_device_route_in_a_batch(nx, nu, ny, dt):
    rng = np.random.default_rng(12)
    systems = [modal_system(rng, nx, nu, ny, feedthrough=index % 2) for index in range(10)]
    if dt:
        systems = [sampled(*system, dt) for system in systems]
    model = StateSpace(*stack(systems), dt=dt)
    found = norms(model, eigensolver=SimultaneousIteration())
    np.testing.assert_allclose(found.value, norms(model, eigensolver=Lapack()).value, rtol=1e-9)
    assert np.all(found.status == Status.successful)
