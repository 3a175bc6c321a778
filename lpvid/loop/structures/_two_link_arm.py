"""The two-link flexible arm under its velocity loops, with ports at the joints."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._channels import require_channels
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._windows import windows_of

# An arm of no particular make, with a velocity gain of one at the first joint: masses, stiffnesses
# and gains are known only up to a common factor.
_GENERIC = np.array([0.08, 0.05, 4.0, 2.0, 0.002, 0.001, 0.1, 0.05, 0.5])
_SCATTER = 0.6
_GUESSES = 96


class PortedTwoLinkArm(AbstractPortedStructure):
    """A two-link flexible arm linearised at rest, κ = cos θ2; forces act on the joints.

    M(κ) q̈ = −K q + Λ (u − θ̇) + f with q = [θ1, θ2, v1, v2]; inputs are the joints' velocity
    references, outputs the velocities y = θ̇ + (deflection rates) of the rigid arm with the same
    tip motion. Such records show masses, stiffnesses and gains only up to one common factor, so
    those here are for a given velocity gain of joint 1. States [v1, v2, θ̇1, θ̇2, v̇1, v̇2].
    Coordinates: both joints; their angles are not states, so what a law reads of them is the speed.

    Args:
        data: records of two inputs and two outputs, with the schedule: cos θ2, or θ2 itself.
        lengths: ℓ of both links, m.
        velocity_gain: λ1, N·m·s/rad.
        schedule: what κ is; by default an angle where its unit is rad or deg, or where it leaves
            [−1, 1], and the cosine otherwise.

    Raises:
        ValueError: the channels do not fit, or there is no schedule.

    Source: 001, section 3, equations 20 to 32.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import PortedTwoLinkArm
        >>> data = IOData(u=np.zeros((9, 2)), y=np.zeros((9, 2)), dt=1e-3, kappa=0.3)
        >>> PortedTwoLinkArm(data).coordinate_names
        ('joint 1', 'joint 2')
    """

    labels: Labels = eqx.field(static=True)
    lengths: tuple[float, float] = eqx.field(static=True)
    velocity_gain: float = eqx.field(static=True)
    turn: float | None = eqx.field(static=True)
    name: str = eqx.field(default="two-link-arm", static=True)

    def __init__(
        self,
        data: IOData,
        *,
        lengths: tuple[float, float] = (0.35, 0.30),
        velocity_gain: float = 1.0,
        schedule: Literal["cosine", "angle"] | None = None,
    ):
        require_channels(data, self.name, inputs=2, outputs=(2,))
        if data.kappa is None:
            raise ValueError(
                "data: structure 'two-link-arm' varies with the second joint's angle, but there is "
                "no kappa: give cos θ2 or θ2 as kappa= (on the command line --schedule COL)."
            )
        self.lengths = (float(lengths[0]), float(lengths[1]))
        self.velocity_gain = float(velocity_gain)
        unit = data.scheduling_units[0]
        if schedule is None:
            beyond = float(np.max(np.abs(np.asarray(data.kappa)[:, 0]))) > 1.0 + 1e-9
            schedule = "angle" if beyond or unit in ("rad", "deg", "°") else "cosine"
        self.turn = None
        if schedule == "angle":
            self.turn = np.pi / 180.0 if unit in ("deg", "°") else 1.0
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=(
                *(f"linear density {k}" for k in (1, 2)),
                *(f"bending stiffness {k}" for k in (1, 2)),
                *(f"hub inertia {k}" for k in (1, 2)),
                "joint mass",
                "payload mass",
                "velocity gain 2",
            ),
            parameter_units=(
                *("kg/m",) * 2,
                *("N·m²",) * 2,
                *("kg·m²",) * 2,
                *("kg",) * 2,
                "N·m·s/rad",
            ),
            coordinates=("joint 1", "joint 2"),
            coordinate_units=("rad", "rad"),
            force_units=("N·m", "N·m"),
        )

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ = (ρ, EI, J, m_j, m_p, λ2) and κ."""
        cosine = kappa[0] if self.turn is None else jnp.cos(self.turn * kappa[0])
        first, second = self.lengths
        gains = jnp.stack([jnp.asarray(self.velocity_gain, float), theta[8]])
        stiffness = 4.0 * theta[2:4] * np.array(self.lengths)
        mobility = jnp.linalg.inv(self._mass(theta, cosine))
        # Columns of M⁻¹ G for the states v (stiffness) and θ̇ (gains).
        driven = mobility[:, :2] * gains[None]
        restoring = mobility[:, 2:] * stiffness[None]
        # Rows [θ, v] are states [θ̇, v̇]: the same order.
        A = jnp.zeros((6, 6)).at[0:2, 4:6].set(jnp.eye(2))
        A = A.at[2:6, 0:2].set(-restoring).at[2:6, 2:4].set(-driven)
        rates = jnp.eye(2, 6, 2)
        loops = gains[:, None]
        return Ports(
            A=A,
            B=jnp.zeros((6, 2)).at[2:6].set(driven),
            C=jnp.array([[0.0, 0.0, 1.0, 0.0, first, 0.0], [0.0, 0.0, 0.0, 1.0, first, second]]),
            D=jnp.zeros((2, 2)),
            force=jnp.zeros((2, 6, 1)).at[:, 2:6, 0].set(mobility[:, :2].T),
            position=jnp.zeros((2, 6)),
            velocity=rates,
            load_state=-loops * rates,
            load_input=loops * jnp.eye(2),
        )

    def _mass(self, theta: Array, cosine: Array) -> Array:
        """M(κ) at v = 0 for q = [θ1, θ2, v1, v2], the integrals over the links in closed form."""
        first, second = self.lengths
        (rho1, rho2), (hub1, hub2) = theta[0:2], theta[4:6]
        # Rows of q̇ that are the spin of each link and the speed of link 1's tip.
        spin = np.array([1.0, 1.0, 2.0 * first, 0.0])
        tip = np.array([first, 0.0, first**2, 0.0])
        bend = np.array([0.0, 0.0, 0.0, 1.0])

        def both(a, b):
            return 0.5 * (np.outer(a, b) + np.outer(b, a))

        own, bend1 = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 0.0])

        def link(length):
            return length**3 / 3.0, length**4 / 2.0, length**5 / 5.0

        square, cross, quartic = link(first)
        beam1 = square * both(own, own) + cross * both(own, bend1) + quartic * both(bend1, bend1)
        square, cross, quartic = link(second)
        turned = square * both(spin, spin) + cross * both(spin, bend) + quartic * both(bend, bend)
        beam2 = turned + second * both(tip, tip)
        lever = second**2 * both(spin, tip) + 2.0 * second**3 / 3.0 * both(bend, tip)
        end = second * spin + second**2 * bend
        payload = both(end, end) + both(tip, tip)
        return (
            rho1 * beam1
            + rho2 * (beam2 + cosine * lever)
            + hub1 * both(own, own)
            + hub2 * both(spin, spin)
            + theta[6] * both(tip, tip)
            + theta[7] * (payload + 2.0 * cosine * both(end, tip))
        )

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """All are positive."""
        return np.full(9, 1e-9), np.full(9, np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ from generic arms, scattered and scaled in time, and a search from the best."""
        windows = windows_of(data, 6)
        random = np.random.default_rng(0)
        factors = np.exp(_SCATTER * random.standard_normal((_GUESSES, 9)))
        factors[0] = 1.0
        inertial = np.array([1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0])
        pace = np.resize([1.0, 0.3, 3.0], _GUESSES)[:, None] ** inertial
        guesses = self.velocity_gain * _GENERIC * factors * pace
        return best_start(window_error(self, windows), guesses)[0]
