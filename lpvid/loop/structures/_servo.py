"""One inertia with viscous friction behind a drive."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._channels import require_channels
from lpvid.loop.structures._regression import drive_sign, rigid_body
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._units import per, times
from lpvid.loop.structures._windows import windows_of


class Servo(AbstractPortedStructure):
    """J q̈ + c q̇ = ± u: an inertia with viscous friction, driven by torque, current or voltage.

    What the drive makes of the input cannot be told from the inertia, so J and c are those for one
    unit of the input, and so are forces. States [q, q̇], or q̇ alone where the output is it.

    Args:
        data: records, for the names and units of one input and one output, and for the sign.
        output: what the output is, position or velocity.

    Raises:
        ValueError: more than one input or output, an unknown `output`.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import Servo
        >>> u = np.repeat(np.random.default_rng(0).standard_normal(20), 10)
        >>> data = IOData(u=u, y=0.01 * np.cumsum(np.cumsum(u)), dt=0.1, names={"y": "angle"})
        >>> Servo(data).coordinate_names
        ('angle',)
    """

    labels: Labels = eqx.field(static=True)
    output: Literal["position", "velocity"] = eqx.field(static=True)
    sign: float
    name: str = eqx.field(default="servo", static=True)

    def __init__(self, data: IOData, *, output: Literal["position", "velocity"] = "position"):
        require_channels(data, "servo", inputs=1, outputs=(1,))
        if output not in ("position", "velocity"):
            raise ValueError(f"output={output!r}: give 'position' or 'velocity', what it measures.")
        self.output = output
        force = data.input_units[0]
        position = (
            data.output_units[0] if output == "position" else times(data.output_units[0], "s")
        )
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=("inertia", "viscous friction"),
            parameter_units=(per(times(force, "s²"), position), per(times(force, "s"), position)),
            coordinates=data.output_names,
            coordinate_units=(position,),
            force_units=data.input_units,
        )
        self.sign = drive_sign(data, rate=output == "velocity")

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ = (J, c)."""
        del kappa
        rate, gain = -theta[1] / theta[0], 1.0 / theta[0]
        moving = jnp.array([1.0]) if self.output == "velocity" else jnp.array([0.0, 1.0])
        resting = 1.0 - moving if self.output == "position" else 0.0 * moving
        A = rate * jnp.outer(moving, moving) + jnp.outer(resting, moving)
        return Ports(
            A=A,
            B=self.sign * gain * moving[:, None],
            C=(resting if self.output == "position" else moving)[None],
            D=jnp.zeros((1, 1)),
            force=gain * moving[None, :, None],
            position=resting[None],
            velocity=moving[None],
            load_state=0.0 * moving[None],
            load_input=self.sign * jnp.ones((1, 1)),
        )

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The inertia is positive."""
        return np.array([1e-12, -np.inf]), np.full(2, np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ by regression over windows and a search from there."""
        windows = windows_of(data, 2)
        rigid = self.sign * rigid_body(windows, ny=1, rate=self.output == "velocity")
        return best_start(window_error(self, windows), np.abs(rigid))[0]
