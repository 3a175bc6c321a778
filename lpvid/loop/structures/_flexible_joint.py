"""Two inertias with a spring between them: motor and load."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._channels import require_channels
from lpvid.loop.structures._regression import drive_sign, least_squares, moments, rigid_body
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._units import per, times
from lpvid.loop.structures._windows import Windows, windows_of

_SHARES = (0.2, 0.5, 0.8)
_FREQUENCIES = 10


class FlexibleJoint(AbstractPortedStructure):
    """J_m q̈_m + c_m q̇_m + τ = ± u, J_l q̈_l + c_l q̇_l = τ, τ = k (q_m − q_l) + d (q̇_m − q̇_l).

    What the drive makes of the input cannot be told from the inertias, so all parameters and forces
    are for one unit of the input. Outputs: the motor's position and, where it is measured, the
    load's, both seen from the same side of a gear. Coordinates: motor, load, and the twist
    q_m − q_l, where a force is a pair. States [q_m, q_l, q̇_m, q̇_l].

    Args:
        data: records, for the names and units of one input and one or two outputs, and for the
            sign of the input.

    Raises:
        ValueError: the numbers of inputs or outputs do not fit.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import FlexibleJoint
        >>> u = np.repeat(np.random.default_rng(0).standard_normal(20), 10)
        >>> data = IOData(u=u, y=0.01 * np.cumsum(np.cumsum(u)), dt=0.1)
        >>> FlexibleJoint(data).coordinate_names
        ('motor', 'load', 'twist')
    """

    labels: Labels = eqx.field(static=True)
    sign: float
    name: str = eqx.field(default="flexible-joint", static=True)

    def __init__(self, data: IOData):
        require_channels(data, self.name, inputs=1, outputs=(1, 2))
        force, position = data.input_units[0], data.output_units[0]
        inertia, damping, stiffness = (
            per(unit, position) for unit in (times(force, "s²"), times(force, "s"), force)
        )
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=(
                "motor inertia",
                "load inertia",
                "stiffness",
                "damping",
                "motor viscous friction",
                "load viscous friction",
            ),
            parameter_units=(inertia, inertia, stiffness, damping, damping, damping),
            coordinates=("motor", "load", "twist"),
            coordinate_units=(position,) * 3,
            force_units=(force,) * 3,
        )
        self.sign = drive_sign(data)

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ = (J_m, J_l, k, d, c_m, c_l)."""
        del kappa
        mobility = 1.0 / theta[:2]
        readings = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
        pair = jnp.asarray(np.outer(readings[2], readings[2]))
        stiffness, damping = theta[2] * pair, theta[3] * pair + jnp.diag(theta[4:6])
        still, unit, blank = jnp.zeros((2, 2)), jnp.eye(2), jnp.zeros((3, 2))
        twist = jnp.asarray(readings[2])
        spring = jnp.concatenate([theta[2] * twist, theta[3] * twist])[None]
        ny = len(self.labels.outputs)
        directions = jnp.concatenate([blank, readings * mobility[None]], axis=1)
        return Ports(
            A=jnp.block(
                [[still, unit], [-mobility[:, None] * stiffness, -mobility[:, None] * damping]]
            ),
            B=jnp.zeros((4, 1)).at[2, 0].set(self.sign * mobility[0]),
            C=jnp.eye(ny, 4),
            D=jnp.zeros((ny, 1)),
            force=directions[:, :, None],
            position=jnp.concatenate([jnp.asarray(readings), blank], axis=1),
            velocity=jnp.concatenate([blank, jnp.asarray(readings)], axis=1),
            load_state=jnp.concatenate([jnp.zeros((1, 4)), spring, spring]),
            load_input=jnp.zeros((3, 1)).at[0, 0].set(self.sign),
        )

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Inertias and stiffness are positive."""
        lower = np.array([1e-15, 1e-15, 1e-15, -np.inf, -np.inf, -np.inf])
        return lower, np.full(6, np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ from resonances tried over the band and, with both angles, from regression."""
        windows = windows_of(data, 4)
        rigid = self.sign * rigid_body(windows, ny=data.ny)
        guesses = resonances(windows, np.abs(rigid))
        if data.ny == 2:
            guesses = [*guesses, *(_regression(entry, self.sign) for entry in windows)]
        return best_start(window_error(self, windows), np.array(guesses))[0]


def resonances(windows: list[Windows], rigid: Float[np.ndarray, "scale 2"]) -> list[np.ndarray]:
    """Guesses (J_m, J_l, k, d, c_m, c_l) around rigid ones, the load alone at ω over the band."""
    longest = windows[-1].step * windows[-1].samples
    band = np.geomspace(2.0 / longest, 2.0 / windows[0].step, _FREQUENCIES)
    guesses = []
    for inertia, friction in rigid[np.unique(np.linspace(0, len(rigid) - 1, 3).astype(int))]:
        for share in _SHARES:
            for omega in band:
                load = share * inertia
                half = max(0.5 * friction, 1e-4 * inertia * omega)
                damping = 0.04 * load * omega
                guesses.append([inertia - load, load, load * omega**2, damping, half, half])
    return [np.array(guess) for guess in guesses]


def _regression(windows: Windows, sign: float) -> np.ndarray:
    known = moments(windows, 1, 2)
    twist = known.positions[0] - known.positions[1]
    rate = known.velocities[0] - known.velocities[1]
    none = np.zeros_like(twist)
    motor = [known.accelerations[0], none, twist, rate, known.velocities[0], none]
    load = [none, known.accelerations[1], -twist, -rate, none, known.velocities[1]]
    both = [first + second for first, second in zip(motor, load, strict=True)]
    regressors = np.concatenate([np.stack(rows, axis=1) for rows in (motor, load, both)])
    force = sign * known.inputs[0]
    theta = least_squares(regressors, np.concatenate([force, none, force]))
    theta[:3] = np.maximum(np.abs(theta[:3]), 1e-12)
    return theta
