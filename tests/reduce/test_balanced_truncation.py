import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slycot
from scipy.linalg import block_diag, solve_continuous_lyapunov, solve_discrete_lyapunov
from scipy.signal import cont2discrete

from lpvid.analysis import hinf_norm
from lpvid.models import StateSpace
from lpvid.reduce import balanced_truncation, hankel_singular_values

DT = 0.1


def system(seed, dt=0.0, unstable=False):
    """Three modes in a random basis, two inputs, two outputs, with D."""
    rng = np.random.default_rng(seed)
    omega = np.array([1.0, 3.0, 8.0])
    rate = 0.05 * omega * np.array([-1.0 if unstable else 1.0, 1.0, 1.0])
    A = block_diag(*(np.array([[-r, w], [-w, -r]]) for r, w in zip(rate, omega, strict=True)))
    T = rng.standard_normal((6, 6)) + 3 * np.eye(6)
    size = np.repeat([1.0, 0.5, 0.2], 2)
    B = size[:, None] * rng.standard_normal((6, 2))
    C = rng.standard_normal((2, 6)) * size
    matrices = T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), 0.3 * np.eye(2)
    return StateSpace(*(cont2discrete(matrices, dt)[:4] if dt else matrices), dt=dt)


def arrays(model):
    return tuple(np.array(m) for m in (model.A, model.B, model.C, model.D))


def response(model, omega):
    A, B, C, D = arrays(model)
    points = np.exp(1j * omega * model.dt) if model.dt else 1j * omega
    return C @ np.linalg.solve(points[:, None, None] * np.eye(A.shape[0]) - A, B[None]) + D


def gap(first, second):
    """Norm of the difference on a grid fine against the damping."""
    omega = np.linspace(0.0, np.pi / DT, 800)
    error = response(first, omega) - response(second, omega)
    return np.linalg.norm(error, 2, axis=(1, 2)).max()


def slicot_truncation(model, order):
    A, B, C, D = arrays(model)
    kind = "D" if model.dt else "C"
    _, *matrices, hankel = slycot.ab09ad(kind, "B", "N", 6, 2, 2, A, B, C, nr=order)
    return StateSpace(*matrices, D, dt=model.dt), hankel


def singular_perturbation(model, order):
    """The textbook formula on SLICOT's balanced realisation."""
    A, B, C, D = arrays(slicot_truncation(model, 6)[0])
    left = np.eye(6)[order:, order:] if model.dt else 0.0
    rest = np.linalg.solve(left - A[order:, order:], np.hstack([A[order:, :order], B[order:]]))
    states, inputs = rest[:, :order], rest[:, order:]
    return StateSpace(
        A[:order, :order] + A[:order, order:] @ states,
        B[:order] + A[:order, order:] @ inputs,
        C[:, :order] + C[:, order:] @ states,
        D + C[:, order:] @ inputs,
        dt=model.dt,
    )


@pytest.mark.parametrize("dt", [0.0, DT])
def test_agrees_with_slicot(dt):
    model = system(0, dt)
    reduced = balanced_truncation(model, 4)
    peer, hankel = slicot_truncation(model, 4)
    np.testing.assert_allclose(reduced.singular_values, hankel, rtol=1e-9)
    np.testing.assert_allclose(reduced.bound, 2 * hankel[4:].sum(), rtol=1e-9)
    assert gap(reduced.model, peer) < 1e-9 * hankel[0]
    kept = balanced_truncation(model, 4, match_dc=True).model
    np.testing.assert_allclose(response(kept, np.zeros(1)), response(model, np.zeros(1)), rtol=1e-9)
    assert gap(kept, singular_perturbation(model, 4)) < 1e-9 * hankel[0]
    if not dt:
        # python-control's balred takes a discrete model for a continuous one.
        peer = control.balred(control.ss(*arrays(model)), 4, method="matchdc")
        assert gap(kept, StateSpace(peer.A, peer.B, peer.C, peer.D)) < 1e-9 * hankel[0]


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "match_dc"), [(0.0, False), (DT, True)])
def test_error_stays_between_its_bounds(dt, match_dc):
    # The next Hankel singular value is a lower bound of any reduction's error.
    models = [system(seed, dt) for seed in range(8)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    reduced = balanced_truncation(batch, 4, match_dc=match_dc)
    error = hinf_norm(batch - reduced.model).value
    assert np.all(error <= reduced.bound * (1 + 1e-9))
    assert np.all(error >= reduced.singular_values[:, 4] * (1 - 1e-9))
    assert np.all(reduced.model.is_stable())


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, DT])
def test_unstable_part_is_kept(dt):
    model = system(0, dt, unstable=True)
    with pytest.raises(ValueError, match="keep_unstable=True"):
        balanced_truncation(model, 4)
    with pytest.raises(ValueError, match="2 poles are on or beyond"):
        balanced_truncation(model, 2, keep_unstable=True)
    reduced = balanced_truncation(model, 4, match_dc=True, keep_unstable=True)
    np.testing.assert_allclose(
        response(reduced.model, np.zeros(1)), response(model, np.zeros(1)), rtol=1e-9
    )
    left, kept = (np.linalg.eigvals(np.asarray(m.A)) for m in (model, reduced.model))
    left, kept = (p[np.abs(p) > 1.0] if dt else p[p.real > 0.0] for p in (left, kept))
    np.testing.assert_allclose(np.sort_complex(kept), np.sort_complex(left))
    assert reduced.singular_values.shape == (4,) and gap(model, reduced.model) <= reduced.bound
    whole = balanced_truncation(model, 6, keep_unstable=True)
    assert gap(model, whole.model) < 1e-9 and whole.bound == 0.0


@pytest.mark.slow
def test_a_model_with_idle_states():
    model = system(0)
    larger = model + StateSpace([[-2.0]], [[0.0, 0.0]], [[1.0], [1.0]])
    for match_dc in (False, True):
        reduced = balanced_truncation(larger, 6, match_dc=match_dc)
        assert gap(reduced.model, model) < 1e-6 and reduced.bound < 1e-6
    with pytest.raises(ValueError, match="only 6 states take part"):
        balanced_truncation(larger, 7)
    for order in (0, 8):
        with pytest.raises(ValueError, match="order is"):
            balanced_truncation(larger, order)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, DT])
def test_hankel_singular_values_and_their_gradient(dt):
    model = system(1, dt)
    A, B, C, _ = arrays(model)
    solve = solve_discrete_lyapunov if dt else solve_continuous_lyapunov
    sign = 1.0 if dt else -1.0
    product = solve(A, sign * B @ B.T) @ solve(A.T, sign * C.T @ C)
    expected = np.sqrt(np.sort(np.linalg.eigvals(product).real)[::-1])
    np.testing.assert_allclose(hankel_singular_values(model), expected, rtol=1e-8)
    direction = np.random.default_rng(2).standard_normal(A.shape)

    def along(step):
        return hankel_singular_values(StateSpace(A + step * direction, B, C, dt=dt))

    difference = (along(1e-6) - along(-1e-6)) / 2e-6
    gradient = jax.jit(jax.jacrev(along))(0.0)
    np.testing.assert_allclose(gradient, difference, rtol=1e-5, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.slow
def test_gradient_of_the_reduced_model():
    A, B, C, D = arrays(system(1))
    direction = np.random.default_rng(2).standard_normal(A.shape)
    omega = jnp.array([0.5, 3.0])

    @jax.jit
    def along(step):
        model = StateSpace(A + step * direction, B, C, D)
        reduced = balanced_truncation(model, 4, match_dc=True).model
        return jnp.abs(reduced.frequency_response(omega))

    difference = (along(1e-6) - along(-1e-6)) / 2e-6
    np.testing.assert_allclose(
        jax.jacrev(along)(0.0), difference, rtol=1e-5, atol=1e-6 * np.abs(difference).max()
    )
