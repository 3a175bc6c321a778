"""Structures with ports: kinematics of their ports, starts from records beside the truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from lpvid.data import IOData, join
from lpvid.loop.structures import STRUCTURES, FunctionPorted, Ports, structure_named
from lpvid.loop.structures._regression import drive_sign
from lpvid.mechanics import MassSpringDamper

from .plants_in_loop import driven, mechanical

# J_m, J_l, k, d, c_m, c_l of the joint, and the same as matrices.
JOINT = np.array([1.0, 2.0, 300.0, 0.5, 0.8, 0.4])
PAIR = np.array([[1.0, -1.0], [-1.0, 1.0]])
JOINT_PLANT = mechanical(
    np.diag(JOINT[:2]), JOINT[3] * PAIR + np.diag(JOINT[4:]), JOINT[2] * PAIR, [1.0, 0.0]
)
LOOP = {"gains": (30.0, 8.0), "every": 30, "push": 8.0}


def _started(name, data, **options):
    structure = structure_named(name, data, **options)
    return structure, structure.start(data)


def _joint(outputs, **options):
    return driven(*JOINT_PLANT, np.eye(4)[:outputs], **LOOP, **options)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_servo_in_closed_loop(sign):
    plant = mechanical(2.0, 1.5, 0.0, [1.0])
    data = driven(*plant, [[1.0, 0.0]], offset=3.0, bias=0.2, sign=sign, **LOOP)
    more = driven(*plant, [[1.0, 0.0]], samples=600, sign=sign, seed=1, **LOOP)
    structure, theta = _started("servo", join([data, more]))
    np.testing.assert_allclose(theta, [2.0, 1.5], rtol=0.02)
    ports = structure.ports(jnp.asarray(theta), jnp.zeros(0))
    assert np.sign(ports.B[1, 0]) == sign
    assert ports.force[0, 1, 0] > 0.0


def test_dry_friction_and_bias_leave_the_inertia_alone():
    plant = mechanical(2.0, 1.5, 0.0, [1.0])
    data = driven(*plant, [[1.0, 0.0]], **LOOP)
    drive = float(np.std(np.asarray(data.u)))
    rubbed = driven(*plant, [[1.0, 0.0]], friction=0.15 * drive, bias=0.1 * drive, **LOOP)
    _, theta = _started("servo", rubbed)
    # What is left of the friction shows in c, as it does in any linear model.
    np.testing.assert_allclose(theta[0], 2.0, rtol=0.03)
    assert 1.0 < theta[1] < 6.0


def test_a_servo_whose_output_is_the_velocity():
    data = driven(*mechanical(0.5, 2.0, 0.0, [1.0]), [[0.0, 1.0]], bias=0.1)
    structure, theta = _started("servo", data, output="velocity")
    np.testing.assert_allclose(theta, [0.5, 2.0], rtol=0.02)
    ports = structure.ports(jnp.asarray(theta), jnp.zeros(0))
    assert ports.A.shape == (1, 1)
    np.testing.assert_array_equal(ports.velocity, ports.C)


def test_masses_springs_and_dampers():
    plant = MassSpringDamper.reference()
    random = np.random.default_rng(2)
    u = np.repeat(random.standard_normal((80, 2)), 20, axis=0)
    y = np.asarray(plant.state_space().simulate(u=u, dt=0.02))
    y = y + 0.05 + 1e-3 * y.std(axis=0) * random.standard_normal(y.shape)
    structure, theta = _started("mass-spring-damper", IOData(u=u, y=y, dt=0.02))
    rows = np.tril_indices(2)
    truth = [np.asarray(m)[rows] for m in (plant.mass, plant.damping, plant.stiffness)]
    for part, expected in zip(np.split(theta, 3), truth, strict=True):
        np.testing.assert_allclose(part, expected, atol=0.02 * np.abs(expected).max())
    assert structure.coordinate_names == ("y1", "y2", "y1 - y2")


@pytest.mark.parametrize("outputs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_flexible_joint_in_closed_loop(outputs):
    _, theta = _started("flexible-joint", _joint(outputs, offset=0.5, bias=0.3))
    np.testing.assert_allclose(theta[:3], JOINT[:3], rtol=0.02)
    np.testing.assert_allclose(theta[3:], JOINT[3:], atol=0.15)
    drive = float(np.std(np.asarray(_joint(1).u)))
    _, theta = _started("flexible-joint", _joint(outputs, friction=0.15 * drive))
    np.testing.assert_allclose(theta[:3], JOINT[:3], rtol=0.05)


@pytest.mark.slow
def test_a_single_link_arm_and_its_strain():
    # Hub, then two clamped modes as appendages: J, ω, ζ, and what a gauge reads of each.
    hub, friction = 0.02, 0.15
    omega, zeta, inertia = np.array([15.0, 60.0]), np.array([0.01, 0.02]), np.array([0.15, 0.01])
    bent = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    stiffness = bent.T @ np.diag(inertia * omega**2) @ bent
    damping = bent.T @ np.diag(2.0 * zeta * omega * inertia) @ bent + np.diag([friction, 0, 0])
    plant = mechanical(np.diag([hub, *inertia]), damping, stiffness, [1.0, 0.0, 0.0])
    reads = [np.eye(6)[0], np.concatenate([np.array([20.0, 8.0]) @ bent, np.zeros(3)])]
    data = driven(*plant, reads, dt=0.005, gains=(2.0, 0.5), every=20, samples=2000)
    data = data.replace(names={"y": ["hub angle", "strain"]})
    _, theta = _started("single-link-arm", data, order=6)
    modes = np.stack([omega, zeta, inertia], axis=1).ravel()
    np.testing.assert_allclose(theta, [hub, friction, *modes, 20.0, 8.0], rtol=0.05)


@pytest.mark.slow
def test_a_black_box_finds_order_and_poles():
    structure, theta = _started("black-box", _joint(2, offset=1.0))
    assert structure.order == 4
    assert len(structure.parameter_names) == len(theta) == 4 * (1 + 2)
    ports = structure.ports(jnp.asarray(theta), jnp.zeros(0))
    found = np.sort_complex(np.linalg.eigvals(np.asarray(ports.A)))
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(JOINT_PLANT[0])), atol=0.1)
    np.testing.assert_array_equal(ports.force, np.broadcast_to(np.eye(4), (2, 4, 4)))


def test_a_black_box_finds_feedthrough():
    random = np.random.default_rng(3)
    u = random.standard_normal((1500, 1))
    lag = driven(np.array([[-2.0]]), np.array([[1.0]]), [[1.0]], dt=0.05, every=1, noise=0.0)
    u = np.asarray(lag.u)
    y = np.asarray(lag.y) + 0.5 * u + 1e-2 * random.standard_normal(u.shape)
    structure, theta = _started("black-box", lag.replace(y=y), order=1)
    ports = structure.ports(jnp.asarray(theta), jnp.zeros(0))
    np.testing.assert_allclose([ports.A[0, 0], ports.D[0, 0]], [-2.0, 0.5], rtol=0.05)


@eqx.filter_jit
def _ports_and_slope(structure, theta):
    slope = jax.jacfwd(lambda t: structure.ports(t, jnp.zeros(0)).A)(theta)
    return structure.ports(theta, jnp.zeros(0)), slope


@pytest.mark.parametrize(
    ("name", "nu", "ny"),
    [
        ("servo", 1, 1),
        ("mass-spring-damper", 3, 3),
        ("flexible-joint", 1, 2),
        ("single-link-arm", 1, 2),
    ],
)
def test_forces_change_accelerations_alone(name, nu, ny):
    random = np.random.default_rng(4)
    data = IOData(u=random.standard_normal((300, nu)), y=random.standard_normal((300, ny)), dt=0.1)
    options = {"order": 6} if name == "single-link-arm" else {}
    structure = structure_named(name, data, **options)
    lower, upper = structure.bounds()
    # Diagonal masses stand out, so that M is regular.
    theta = jnp.asarray(np.where(lower > 0.0, 2.0, 0.1) + 0.01 * np.arange(len(lower)))
    assert np.all((lower < theta) & (theta < upper))
    ports, derivative = _ports_and_slope(structure, theta)
    np.testing.assert_allclose(ports.position @ ports.A, ports.velocity, atol=1e-12)
    np.testing.assert_allclose(ports.position @ ports.B, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.asarray(ports.position) @ np.asarray(ports.force)[..., 0].T, 0.0)
    # Reciprocity: mobility from any coordinate to any other is symmetric and positive.
    mobility = np.asarray(ports.velocity) @ np.asarray(ports.force)[..., 0].T
    np.testing.assert_allclose(mobility, mobility.T, atol=1e-12)
    assert np.linalg.eigvalsh(np.asarray(mobility)).min() > -1e-12
    labels = structure.labels
    count = len(structure.coordinate_names)
    assert ports.load_input.shape == (count, nu)
    assert len(labels.force_units) == len(labels.coordinate_units) == count
    assert len(labels.parameter_units) == len(labels.parameters) == len(theta)
    assert np.all(np.isfinite(derivative))


def test_a_structure_of_ones_own():
    def pendulum(theta, kappa):
        A = jnp.array([[0.0, 1.0], [-theta[0], -theta[1]]])
        row = jnp.eye(2)[:1]
        return Ports(
            A=A,
            B=jnp.eye(2)[:, 1:],
            C=row,
            D=jnp.zeros((1, 1)),
            force=jnp.eye(2)[None, :, 1:],
            position=row,
            velocity=jnp.eye(2)[1:],
            load_state=0.0 * row,
            load_input=jnp.ones((1, 1)),
        )

    data = driven(*mechanical(1.0, 0.3, 9.0, [1.0]), [[1.0, 0.0]])
    own = FunctionPorted(pendulum, {"g/l": 4.0, "damping": 1.0}, data, coordinates=["pivot"])
    np.testing.assert_allclose(own.start(data), [9.0, 0.3], rtol=0.02)
    with pytest.raises(ValueError, match="force has shape"):
        FunctionPorted(pendulum, {"g/l": 4.0, "damping": 1.0}, data, coordinates=["a", "b"])


def test_faults_are_named():
    data = IOData(u=np.zeros((60, 2)), y=np.zeros((60, 3)), dt=0.1)
    with pytest.raises(ValueError, match=STRUCTURES[1]):
        structure_named("pendulum", data)
    for name, reason in (
        ("servo", "needs 1 input, the data has 2"),
        ("mass-spring-damper", "needs 2 outputs, the data has 3"),
        ("flexible-joint", "needs 1 input"),
        ("two-link-arm", "needs 2 outputs"),
    ):
        with pytest.raises(ValueError, match=reason):
            structure_named(name, data)
    one = driven(*mechanical(1.0, 0.3, 9.0, [1.0]), [[1.0, 0.0]], samples=200)
    with pytest.raises(ValueError, match="order of its own"):
        structure_named("servo", one, order=3)
    with pytest.raises(ValueError, match="longer record"):
        _started("servo", one[:20])
    arm = IOData(u=np.zeros((9, 2)), y=np.zeros((9, 2)), dt=0.1)
    with pytest.raises(ValueError, match="--schedule"):
        structure_named("two-link-arm", arm)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("rate", [False, True])
@pytest.mark.parametrize("feedback", [0.0, 2.0])
def test_the_drive_sign_of_a_resonant_arm(sign, rate, feedback):
    # A light hub before a heavy resonance: short windows see no rigid body at all.
    J, load, omega = 0.03, 0.8, 15.0
    k, c = load * omega**2, 0.7
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2] = np.array([-k, k, -c - 0.3, 0.3]) / J
    A[3] = np.array([k, -k, 0.3, -0.3]) / load
    generator = np.zeros((5, 5))
    generator[:4, :4], generator[2, 4] = A, sign / J
    step = scipy.linalg.expm(generator * 0.005)[:4]
    rng = np.random.default_rng(5)
    x, u, y = np.zeros(4), np.zeros(3000), np.zeros(3000)
    wanted = np.repeat(rng.standard_normal(300), 10)
    for t in range(3000):
        y[t] = x[2 if rate else 0] + 1e-2 * rng.standard_normal()
        u[t] = wanted[t] - sign * feedback * y[t]
        x = step @ np.append(x, u[t])
    assert drive_sign(IOData(u=u, y=y, dt=0.005), rate=rate) == sign
