"""The blind suite's own effects: set-valued friction, true dead zones and stops, hard limits.

Each is vectorised over the records that have it. Sign and size follow the library's conventions
(a force is added to M q̈ = …, so friction opposes the velocity), the laws themselves do not: nothing
here is smoothed, and nothing is taken from `lpvid.effects`.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

FAMILIES = {
    "coulomb": "friction",
    "stribeck": "friction",
    "asymmetric-viscous": "friction",
    "load-dependent": "friction",
    "dahl": "friction",
    "quadratic-drag": "drag",
    "bouc-wen": "hysteresis",
    "play": "hysteresis",
    "cubic-stiffness": "stiffness",
    "quadratic-stiffness": "stiffness",
    "backlash": "backlash",
    "saturation": "saturation",
    "gain-cubic": "gain",
    "gain-asymmetry": "gain",
    "gain-square": "gain",
    "input-delay": "delay",
    "actuator-lag": "lag",
    "sensor-lag": "lag",
    "missing-mode": "mode",
    "gravity": "gravity",
    "torque-ripple": "ripple",
    "periodic-disturbance": "disturbance",
    "torque-bias": "bias",
    "sensor-bias": "bias",
    "sensor-drift": "drift",
    "absolute-value-sensor": "sensor",
    "cubic-sensor": "sensor",
    "position-dependent-inertia": "inertia",
    "centrifugal": "inertia",
    "scheduling": "scheduling",
    "parameter-drift": "drift",
}
"""Names and families as the library reports them."""


@dataclasses.dataclass
class Effect:
    """One effect of one record.

    Attributes:
        name: of `FAMILIES`, or a name of its own outside of the library.
        kind: where it acts: "force", "input", "output", "linear" (parameters) or "mode".
        port: index of the input or output, or the coordinate's name.
        label: the port in the library's words.
        amplitude: one or two numbers.
        shape: none to two numbers.
        scaled: what calibration scales: "amplitude", "shape", "limit" or "nothing".
        most: by how much at most.
        outside: the library has no such effect.
        linear: a linear model of the same order could not absorb it, and yet it is linear.
    """

    name: str
    kind: str
    port: int | str
    label: str
    amplitude: tuple[float, ...]
    shape: tuple[float, ...] = ()
    scaled: str = "amplitude"
    most: float = 4.0
    outside: bool = False
    linear: bool = False

    def times(self, factor: float) -> "Effect":
        """The same effect, stronger by about `factor`."""
        if self.scaled == "nothing":
            return self
        if self.scaled == "limit":
            # A limit bites the more the lower it is, and soon takes all.
            return dataclasses.replace(self, shape=(self.shape[0] / factor**0.3,))
        numbers = tuple(factor * number for number in getattr(self, self.scaled))
        return dataclasses.replace(self, **{self.scaled: numbers})


@dataclasses.dataclass
class Seen:
    """What force laws read: (record,) each, but for the time."""

    position: np.ndarray
    velocity: np.ndarray
    load: np.ndarray
    other: np.ndarray
    schedule: np.ndarray
    input: np.ndarray
    time: float
    step: float


Law = Callable[[Seen, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def _dead_zone(q, gap):
    return q - np.clip(q, -gap, gap)


def _way(seen, memory):
    """What the position has moved by since the last kick."""
    before, memory[:, 1] = memory[:, 1].copy(), seen.position
    return seen.position - before


def _dahl(seen, a, s, memory):
    way = _way(seen, memory)
    end = np.sign(way)
    memory[:, 0] = end + (memory[:, 0] - end) * np.exp(-np.abs(way) / s[:, 0])
    return -a[:, 0] * memory[:, 0]


def _bouc_wen(seen, a, s, memory):
    # Four midpoint steps of dz = dq [1 − |z| (ρ sgn(dq z) + 1 − ρ)]/ℓ.
    z, move = memory[:, 0], 0.25 * _way(seen, memory) / s[:, 0]

    def rate(z):
        return move * (1.0 - np.abs(z) * (s[:, 1] * np.sign(move * z) + 1.0 - s[:, 1]))

    for _ in range(4):
        z = np.clip(z + rate(z + 0.5 * rate(z)), -1.0, 1.0)
    memory[:, 0] = z
    return -a[:, 0] * z


def _clock(seen, s):
    """Time scaled to ±1 over the record."""
    return 2.0 * seen.time / s[:, 1] - 1.0


def _play(seen, a, s, memory):
    # A stop: a spring that slips at the half width (an elastic slider).
    width = s[:, 0]
    memory[:, 0] = np.clip(memory[:, 0] + _way(seen, memory), -width, width)
    return -a[:, 0] * memory[:, 0]


def _thermal(seen, a, s, memory):
    memory[:, 0] += seen.step / s[:, 0] * (seen.input**2 - memory[:, 0])
    return -a[:, 0] * memory[:, 0] * seen.input


def _walk(seen, a, s, memory):
    # A force that wanders: an Ornstein–Uhlenbeck process from a stream of its own, by record.
    stream = _stream(s[:, 0], seen.time, seen.step)
    memory[:, 0] += -seen.step / s[:, 1] * memory[:, 0] + np.sqrt(2 * seen.step / s[:, 1]) * stream
    return a[:, 0] * memory[:, 0]


def _stream(seeds, time, step):
    # Counter-based normal numbers (a hash of seed and substep), so that no state is carried.
    counter = np.uint64(round(time / step))
    state = seeds.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + counter
    uniform = []
    for salt in (np.uint64(0xD1B54A32D192ED03), np.uint64(0x8CB92BA72F3D8DD7)):
        word = state ^ salt
        word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        uniform.append(((word ^ (word >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53)
    radius = np.sqrt(-2.0 * np.log(np.maximum(uniform[0], 1e-16)))
    return radius * np.cos(2 * np.pi * uniform[1])


DRY = {
    "coulomb": lambda seen, a, s: a[:, 0],
    "stribeck": lambda seen, a, s: a[:, 0] * np.exp(-((seen.velocity / s[:, 0]) ** 2)),
    "load-dependent": lambda seen, a, s: a[:, 0] * np.abs(seen.load),
    "friction by position": lambda seen, a, s: (
        a[:, 0] * (1 + np.sin(seen.position * s[:, 0])) * (np.sin(seen.position * s[:, 0]) > 0)
    ),
}
"""Levels of set-valued friction: it stops what it can hold."""

INERTIAL = {
    "position-dependent-inertia": (
        lambda seen, a: a[:, 0] * np.cos(seen.position) + a[:, 1] * np.sin(seen.position),
        lambda seen, a: a[:, 1] * np.cos(seen.position) - a[:, 0] * np.sin(seen.position),
    ),
}
"""Added inertia as a function of position, and its slope: −m(q) q̈ − ½ m′(q) q̇²."""

FORCES: dict[str, Law] = {
    "asymmetric-viscous": lambda seen, a, s, m: -a[:, 0] * np.abs(seen.velocity),
    "dahl": _dahl,
    "quadratic-drag": lambda seen, a, s, m: -a[:, 0] * seen.velocity * np.abs(seen.velocity),
    "bouc-wen": _bouc_wen,
    "play": _play,
    "cubic-stiffness": lambda seen, a, s, m: -a[:, 0] * seen.position**3,
    "quadratic-stiffness": lambda seen, a, s, m: -a[:, 0] * seen.position**2,
    "backlash": lambda seen, a, s, m: (
        a[:, 0] * (seen.position - _dead_zone(seen.position, s[:, 0]))
    ),
    "gravity": lambda seen, a, s, m: (
        -a[:, 0] * np.sin(seen.position) - a[:, 1] * np.cos(seen.position)
    ),
    "torque-ripple": lambda seen, a, s, m: (
        a[:, 0] * np.sin(s[:, 0] * seen.position) + a[:, 1] * np.cos(s[:, 0] * seen.position)
    ),
    "periodic-disturbance": lambda seen, a, s, m: (
        a[:, 0] * np.sin(s[:, 0] * seen.time) + a[:, 1] * np.cos(s[:, 0] * seen.time)
    ),
    "torque-bias": lambda seen, a, s, m: a[:, 0],
    "centrifugal": lambda seen, a, s, m: -a[:, 0] * seen.velocity**2 * np.sin(seen.position),
    # Parameters that vary: amplitude relative, shape the parameter's value.
    "damping, scheduled": lambda seen, a, s, m: -a[:, 0] * s[:, 0] * seen.schedule * seen.velocity,
    "stiffness, scheduled": lambda seen, a, s, m: (
        -a[:, 0] * s[:, 0] * seen.schedule * seen.position
    ),
    "gain, scheduled": lambda seen, a, s, m: (
        a[:, 0] * s[:, 0] * seen.schedule * (seen.input - seen.velocity)
    ),
    "damping, drifting": lambda seen, a, s, m: -a[:, 0] * s[:, 0] * _clock(seen, s) * seen.velocity,
    "stiffness, drifting": lambda seen, a, s, m: (
        -a[:, 0] * s[:, 0] * _clock(seen, s) * seen.position
    ),
    "gain, drifting": lambda seen, a, s, m: (
        a[:, 0] * s[:, 0] * _clock(seen, s) * (seen.input - seen.velocity)
    ),
    # Outside of the library.
    "preload": lambda seen, a, s, m: -a[:, 0] * np.clip(seen.position / s[:, 0], -1.0, 1.0),
    "van der Pol damping": lambda seen, a, s, m: -a[:, 0] * seen.velocity * seen.position**2,
    "parametric stiffness": lambda seen, a, s, m: (
        -a[:, 0] * np.cos(s[:, 0] * seen.time) * seen.position
    ),
    "cross damping": lambda seen, a, s, m: -a[:, 0] * seen.velocity * seen.other**2,
    "wandering force": _walk,
    "gain that heats up": _thermal,
    "chirp disturbance": lambda seen, a, s, m: (
        a[:, 0] * np.sin((s[:, 0] + 0.5 * s[:, 1] * seen.time) * seen.time)
    ),
    "one-sided stop": lambda seen, a, s, m: -a[:, 0] * np.maximum(seen.position - s[:, 0], 0.0),
    "input times position": lambda seen, a, s, m: a[:, 0] * seen.input * seen.position,
}
"""Forces at a coordinate: (what is seen, amplitude, shape, memory) → force; memory is updated."""

DAMPED = (
    "asymmetric-viscous",
    "quadratic-drag",
    "centrifugal",
    "gain, scheduled",
    "gain, drifting",
    "damping, scheduled",
    "damping, drifting",
    "van der Pol damping",
    "cross damping",
)
"""Forces of the velocity, which a kick changes: taken at its middle."""

INPUTS = {
    "saturation": lambda u, a, s: u + a[:, 0] * (np.clip(u, -s[:, 0], s[:, 0]) - u),
    "gain-cubic": lambda u, a, s: u + a[:, 0] * u**3,
    "gain-asymmetry": lambda u, a, s: u + a[:, 0] * np.abs(u),
    "gain-square": lambda u, a, s: u + a[:, 0] * u * np.abs(u),
}
"""Static in the input."""

OUTPUTS = {
    "sensor-bias": lambda y, a, s, time: y + a[:, 0],
    "sensor-drift": lambda y, a, s, time: y + a[:, 0] * time,
    "absolute-value-sensor": lambda y, a, s, time: y + a[:, 0] * (np.abs(y) - y),
    "cubic-sensor": lambda y, a, s, time: y + a[:, 0] * y**3,
}
"""Static in the output."""

REPORTED = {
    "gain, scheduled": "scheduling",
    "gain, drifting": "parameter-drift",
    "damping, scheduled": "scheduling",
    "stiffness, scheduled": "scheduling",
    "damping, drifting": "parameter-drift",
    "stiffness, drifting": "parameter-drift",
}
"""Names under which the library reports the effects that are kinds of one."""

AMPLITUDES = {
    "gravity": 2,
    "torque-ripple": 2,
    "periodic-disturbance": 2,
    "position-dependent-inertia": 2,
}
"""Of laws that have more than one."""

WHOLE = ("input-delay", "actuator-lag", "sensor-lag", "saturation", "absolute-value-sensor")
"""Laws that replace a signal, whose only number is their shape, if any."""
