"""Plants of the blind suite: matrices of their motion, drawn for every record, in NumPy.

M(κ) q̈ + D q̇ + K q = G u + Σ e f, y = C [q; q̇]. All numbers of a record are its own: every
physical parameter is drawn within 20 % of the plant's nominal one, payloads by more.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

SPREAD = 0.2


@dataclasses.dataclass
class Motion:
    """One record's numbers. `mass` holds M at the nodes of κ, (node, dof, dof)."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    physical: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Plant:
    """A kind of plant: how its records are drawn, excited and controlled.

    Attributes:
        structure: the library's name for what the model may look like.
        dt: s.
        coordinates: name → direction e over the degrees of freedom.
        elastic: names of coordinates that are springs' lengths, in which stiffness effects live.
        sliding: names of coordinates where friction may be.
        turning: names of coordinates that are angles of a turning part (gravity, ripple).
        level: of the input, per channel.
        band: highest frequency of the excitation, Hz.
        corner: below which the excitation falls, Hz; none if 0.
        proportional, derivative: (nu, ny) of the feedback, derivative time included.
        reference: size of the closed loop's reference, per output.
        rate_outputs: the outputs are velocities, the feedback is on their integrals.
        level_outputs: outputs at which a constant offset can be seen.
    """

    name: str
    structure: str
    dt: float
    inputs: tuple[tuple[str, str], ...]
    outputs: tuple[tuple[str, str], ...]
    coordinates: dict[str, tuple[float, ...]]
    elastic: tuple[str, ...]
    sliding: tuple[str, ...]
    turning: tuple[str, ...]
    level: tuple[float, ...]
    band: float
    corner: float
    proportional: np.ndarray
    derivative: np.ndarray
    reference: tuple[float, ...]
    level_outputs: tuple[int, ...]
    draw: Callable[[np.random.Generator, bool], Motion]
    scheduled: bool = False
    rate_outputs: bool = False


def _near(rng, value, spread=SPREAD):
    return value * rng.uniform(1.0 - spread, 1.0 + spread, np.shape(value))


def _payload(rng, decoy):
    return rng.uniform(1.5, 2.5) if decoy else 1.0


def _flexible_joint(rng: np.random.Generator, decoy: bool) -> Motion:
    motor, load = _near(rng, 0.02), _near(rng, 0.05) * _payload(rng, decoy)
    stiffness, damping = _near(rng, 15.0), _near(rng, 0.05)
    friction = (_near(rng, 0.12), _near(rng, 0.06))
    spring = np.array([[1.0, -1.0], [-1.0, 1.0]])
    physical = {
        "motor inertia": motor,
        "load inertia": load,
        "joint stiffness": stiffness,
        "joint damping": damping,
        "motor friction": friction[0],
        "load friction": friction[1],
    }
    return Motion(
        np.diag([motor, load])[None],
        damping * spring + np.diag(friction),
        stiffness * spring,
        np.array([[1.0], [0.0]]),
        np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]),
        {name: float(value) for name, value in physical.items()},
    )


def _mass_spring_damper(rng: np.random.Generator, decoy: bool) -> Motion:
    M = np.array([[_near(rng, 5.0), -_near(rng, 1.0)], [0.0, _near(rng, 1.0)]])
    M[1, 1] += 0.25 * _payload(rng, decoy) - 0.25
    M[1, 0] = M[0, 1]
    # Keeps the mass matrix well away from singular: det M > 0 by a margin.
    M[0, 1] = M[1, 0] = np.sign(M[0, 1]) * min(abs(M[0, 1]), 0.6 * np.sqrt(M[0, 0] * M[1, 1]))
    D = np.array([[_near(rng, 5.0), -0.01], [-0.01, _near(rng, 1.0)]])
    K = np.array([[_near(rng, 100.0), -_near(rng, 5.0)], [0.0, _near(rng, 100.0)]])
    K[1, 0] = K[0, 1]
    physical = {
        f"{letter}{i + 1}{j + 1}": float(matrix[i, j])
        for letter, matrix in (("M", M), ("D", D), ("K", K))
        for i, j in ((0, 0), (0, 1), (1, 1))
    }
    return Motion(M[None], D, K, np.eye(2), np.eye(2, 4), physical)


# cos β cosh β = −1: the first two clamped–free modes.
_WAVE_NUMBERS = np.array([1.8751040687119611, 4.694091132974175])
_HUB_INERTIA, _BEAM, _RIGIDITY, _VISCOUS = 0.0035, 0.4131, 7.906275, 0.12
_TORQUE_PER_VOLT, _HALF_THICKNESS, _GAUGE, _GAUGE_PLACE = 0.15, 0.0015, 2e4, 0.02


def _beam_shape(x: np.ndarray, derivative: int) -> np.ndarray:
    """φ_i(x) or φ_i″(x) (place, mode) of a clamped–free beam of length 1, ∫φ_i² = 1."""
    b = _WAVE_NUMBERS
    sigma = (np.cosh(b) + np.cos(b)) / (np.sinh(b) + np.sin(b))
    z = b * np.asarray(x)[:, None]
    if derivative == 0:
        return np.cosh(z) - np.cos(z) - sigma * (np.sinh(z) - np.sin(z))
    return b**2 * (np.cosh(z) + np.cos(z) - sigma * (np.sinh(z) + np.sin(z)))


def _single_link_arm(rng: np.random.Generator, decoy: bool) -> Motion:
    """Hub and beam of 1 m with two modes, small motions; 002's arm."""
    payload = 0.05 * (_payload(rng, decoy) - 1.0)
    hub, density, rigidity, viscous = _near(
        rng, np.array([_HUB_INERTIA, _BEAM, _RIGIDITY, _VISCOUS])
    )
    ratio = float(_near(rng, 0.015, 0.4))
    nodes, weights = np.polynomial.legendre.leggauss(24)
    x, weights = (nodes + 1.0) / 2.0, weights / 2.0
    # What a point moves by: x for the hub, φ_i for the modes.
    along = np.column_stack([x, _beam_shape(x, 0)])
    tip = np.append(1.0, _beam_shape(np.ones(1), 0)[0])
    mass = density * along.T @ (weights[:, None] * along) + payload * np.outer(tip, tip)
    mass[0, 0] += hub
    stiffness = rigidity * np.append(0.0, _WAVE_NUMBERS**4)
    modal = 2.0 * ratio * np.sqrt(stiffness[1:] * density)
    strain = _GAUGE * _HALF_THICKNESS * _beam_shape(np.array([_GAUGE_PLACE]), 2)[0]
    outputs = np.zeros((2, 6))
    outputs[0, 0], outputs[1, 1:3] = 1.0, strain
    # Forces in volts of the command: what the drive makes of it nobody can tell from inertia.
    return Motion(
        mass[None] / _TORQUE_PER_VOLT,
        np.diag(np.append(viscous, modal)) / _TORQUE_PER_VOLT,
        np.diag(stiffness) / _TORQUE_PER_VOLT,
        np.array([[1.0], [0.0], [0.0]]),
        outputs,
        {
            "hub inertia": float(hub),
            "linear density": float(density),
            "bending stiffness": float(rigidity),
            "viscous friction": float(viscous),
            "damping ratio": ratio,
            "payload": payload,
        },
    )


KAPPA_NODES = np.cos(np.pi * (np.arange(9) + 0.5) / 9.0)
_LENGTHS = (0.35, 0.30)


def two_link_mass(density, hubs, joint_mass, payload, theta2: float) -> np.ndarray:
    """M of [θ1, θ2, v1, v2] at rest: deflections x² v, the second link on the first one's tip."""
    first, second = _LENGTHS
    nodes, weights = np.polynomial.legendre.leggauss(6)
    x, weights = (nodes + 1.0) / 2.0, weights / 2.0
    spin = np.array([1.0, 1.0, 2.0 * first, 0.0])
    tip = np.array([first, 0.0, first**2, 0.0])
    # Velocity of the second link's points along and across it, per rate of each coordinate.
    across = np.cos(theta2) * tip + np.outer(second * x, spin)
    across[:, 3] += (second * x) ** 2
    end = np.cos(theta2) * tip + second * spin + np.array([0.0, 0.0, 0.0, second**2])
    along = np.sin(theta2) * tip
    inner = np.column_stack([first * x, 0.0 * x, (first * x) ** 2, 0.0 * x])
    mass = density[0] * first * inner.T @ (weights[:, None] * inner)
    mass += joint_mass * np.outer(tip, tip)
    mass += density[1] * second * across.T @ (weights[:, None] * across)
    mass += payload * np.outer(end, end)
    mass += (density[1] * second + payload) * np.outer(along, along)
    mass += hubs[1] * np.outer(spin, spin)
    mass[0, 0] += hubs[0]
    return mass


def _two_link_arm(rng: np.random.Generator, decoy: bool) -> Motion:
    """The reference arm of 001 with its velocity loops, small motions about any θ2."""
    first, second = _LENGTHS
    density, rigidity = _near(rng, np.array([0.6, 0.4])), _near(rng, np.array([40.0, 18.0]))
    hubs, gains = _near(rng, np.array([0.02, 0.008])), _near(rng, np.array([8.0, 3.0]))
    joint_mass = float(_near(rng, 1.0))
    payload = float(_near(rng, 0.3)) * _payload(rng, decoy)
    mass = [
        two_link_mass(density, hubs, joint_mass, payload, np.arccos(kappa)) for kappa in KAPPA_NODES
    ]
    outputs = np.zeros((2, 8))
    outputs[0, [4, 6]] = 1.0, first
    outputs[1, [5, 6, 7]] = 1.0, first, second
    groups = {
        "linear density": density,
        "bending stiffness": rigidity,
        "hub inertia": hubs,
        "velocity gain": gains,
    }
    physical = {
        f"{name} {i + 1}": float(value)
        for name, values in groups.items()
        for i, value in enumerate(values)
    }
    # Records show forces up to one factor: they count in units of the first gain, as the library's.
    unit = gains[0]
    return Motion(
        np.stack(mass) / unit,
        np.diag(np.append(gains, [0.0, 0.0])) / unit,
        np.diag(np.append([0.0, 0.0], 4.0 * rigidity * np.array(_LENGTHS))) / unit,
        np.vstack([np.diag(gains), np.zeros((2, 2))]) / unit,
        outputs,
        physical | {"joint mass": joint_mass, "payload mass": payload},
    )


PLANTS = {
    "flexible-joint": Plant(
        name="flexible-joint",
        structure="flexible-joint",
        dt=0.004,
        inputs=(("torque", "N·m"),),
        outputs=(("motor angle", "rad"), ("load angle", "rad")),
        coordinates={"motor": (1.0, 0.0), "load": (0.0, 1.0), "twist": (1.0, -1.0)},
        elastic=("twist",),
        sliding=("motor", "load"),
        turning=("motor", "load"),
        level=(2.0,),
        band=12.0,
        corner=1.0,
        proportional=np.array([[2.5, 0.0]]),
        derivative=np.array([[0.25, 0.0]]),
        reference=(0.3, 0.3),
        level_outputs=(),
        draw=_flexible_joint,
    ),
    "single-link-arm": Plant(
        name="single-link-arm",
        structure="single-link-arm",
        dt=0.005,
        inputs=(("command", "V"),),
        outputs=(("hub angle", "rad"), ("base strain", "V")),
        coordinates={"hub": (1.0, 0.0, 0.0)},
        elastic=(),
        sliding=("hub",),
        turning=("hub",),
        level=(6.0,),
        band=28.0,
        corner=0.25,
        proportional=np.array([[5.0, 0.0]]),
        derivative=np.array([[2.5, 0.0]]),
        reference=(0.4, 0.0),
        level_outputs=(1,),
        draw=_single_link_arm,
    ),
    "two-link-arm": Plant(
        name="two-link-arm",
        structure="two-link-arm",
        dt=0.002,
        inputs=(("joint velocity reference 1", "rad/s"), ("joint velocity reference 2", "rad/s")),
        outputs=(("joint velocity 1", "rad/s"), ("joint velocity 2", "rad/s")),
        coordinates={
            "joint 1": (1.0, 0.0, 0.0, 0.0),
            "joint 2": (0.0, 1.0, 0.0, 0.0),
            "segment 1": (0.0, 0.0, 1.0, 0.0),
            "segment 2": (0.0, 0.0, 0.0, 1.0),
        },
        elastic=("segment 1", "segment 2"),
        sliding=("joint 1", "joint 2"),
        turning=(),
        level=(0.6, 0.6),
        band=40.0,
        corner=0.0,
        proportional=np.diag([2.0, 2.0]),
        derivative=np.zeros((2, 2)),
        reference=(0.4, 0.4),
        level_outputs=(0, 1),
        draw=_two_link_arm,
        scheduled=True,
        rate_outputs=True,
    ),
    "mass-spring-damper": Plant(
        name="mass-spring-damper",
        structure="mass-spring-damper",
        dt=0.02,
        inputs=(("force 1", "N"), ("force 2", "N")),
        outputs=(("displacement 1", "m"), ("displacement 2", "m")),
        coordinates={
            "displacement 1": (1.0, 0.0),
            "displacement 2": (0.0, 1.0),
            "displacement 1 - displacement 2": (1.0, -1.0),
        },
        elastic=("displacement 1", "displacement 2"),
        sliding=("displacement 1", "displacement 2"),
        turning=(),
        level=(8.0, 8.0),
        band=4.0,
        corner=0.0,
        proportional=np.diag([30.0, 30.0]),
        derivative=np.diag([4.0, 1.0]),
        reference=(0.1, 0.1),
        level_outputs=(0, 1),
        draw=_mass_spring_damper,
    ),
}
"""By name."""
