"""A record of the two-link arm with an effect that its linear model does not know."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lpvid.data import IOData
from lpvid.mechanics import TwoLinkFlexibleArm, add_noise, integrate, prbs

# Step of the integrator, samples it makes one of, and how long a level lasts at least, in samples.
_STEP, _DECIMATE, _HOLD = 1e-4, 10, 60
# Speed of a sharp Coulomb friction's sign, rad/s: well below what a library's grid would find.
_SIGN_SPEED = 2e-3
# Least and greatest size of each effect, in SI units.
_SIZES = {"coulomb": (0.06, 0.15), "quadratic-drag": (0.5, 1.0), "input-delay": (4e-3, 9e-3)}
_UNITS = {"coulomb": "N·m", "quadratic-drag": "N·m·s²/rad²", "input-delay": "s"}


class Undeclared(NamedTuple):
    """A record, and what nobody tells whoever looks at it.

    Attributes:
        data: u = θ̇* and y = rigid joint velocities, rad/s; κ = cos θ2.
        name: of the effect, as in the library.
        joint: that it acts at, 1 or 2; 0 for both inputs.
        size: level of friction, coefficient of drag, or delay.
        unit: of the size.
    """

    data: IOData
    name: str
    joint: int
    size: float
    unit: str


def undeclared_record(
    arm: TwoLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    theta2: float = np.pi / 2.0,
    n_samples: int = 3000,
    amplitude: float = 0.3,
    snr_db: float = 40.0,
) -> Undeclared:
    """The arm about one posture under random references, with an effect drawn from the key.

    Dry friction or quadratic drag at either joint, or a delay of both inputs; of a size that is
    drawn too.

    Args:
        arm: the arm.
        key: random key.
        theta2: posture, rad, in (0, π).
        n_samples: samples of 1 ms.
        amplitude: standard deviation of the references' levels, rad/s.
        snr_db: signal-to-noise ratio of the measured velocities, dB.

    Raises:
        ValueError: fewer samples than one level lasts, or an angle outside of (0, π).

    Example:
        >>> from lpvid.mechanics import reference_two_link_arm
        >>> undeclared_record(reference_two_link_arm(), jax.random.key(1), n_samples=60).name
        'coulomb'
    """
    if not 0.0 < theta2 < np.pi:
        raise ValueError(f"theta2={theta2} lies outside of (0, π): give an angle inside.")
    if n_samples < _HOLD:
        raise ValueError(f"n_samples={n_samples}: give {_HOLD} at least, as long as a level lasts.")
    choice_key, size_key, long_key, short_key, noise_key = jax.random.split(key, 5)
    kinds = [(name, joint) for name in _SIZES for joint in (1, 2) if name != "input-delay"]
    kinds.append(("input-delay", 0))
    name, joint = kinds[int(jax.random.randint(choice_key, (), 0, len(kinds)))]
    least, most = _SIZES[name]
    size = float(jax.random.uniform(size_key, (), float, least, most))
    # Two binary sequences of different bits have four levels: what is static in u shows.
    levels = prbs(long_key, n_samples, 2, amplitude=0.8 * amplitude, hold=_HOLD)
    levels = levels + prbs(short_key, n_samples, 2, amplitude=0.6 * amplitude, hold=_HOLD // 3)
    reference = jnp.repeat(levels, _DECIMATE, axis=0)
    delay = round(size / _STEP) if name == "input-delay" else 0
    acting = jnp.concatenate([jnp.zeros((delay, 2)), reference])[: reference.shape[0]]
    friction, drag = (
        jnp.zeros(2).at[joint - 1].set(size if name == kind else 0.0)
        for kind in ("coulomb", "quadratic-drag")
    )
    y, kappa = _simulate(arm, acting, jnp.asarray(theta2, float), friction, drag)
    data = IOData(
        u=levels,
        y=add_noise(noise_key, y, snr_db),
        dt=_STEP * _DECIMATE,
        kappa=kappa,
        names={
            "u": ("reference1", "reference2"),
            "y": ("velocity1", "velocity2"),
            "kappa": "cos_theta2",
        },
        units={"u": ("rad/s", "rad/s"), "y": ("rad/s", "rad/s")},
    )
    return Undeclared(data, name, joint, size, _UNITS[name])


@eqx.filter_jit
def _simulate(
    arm: TwoLinkFlexibleArm,
    reference: Float[Array, "step 2"],
    theta2: Float[Array, ""],
    friction: Float[Array, "2"],
    drag: Float[Array, "2"],
) -> tuple[Float[Array, "time 2"], Float[Array, "time 1"]]:
    def dynamics(state, held):
        rates = state[4:6]
        lost = friction * jnp.tanh(rates / _SIGN_SPEED) + drag * rates * jnp.abs(rates)
        forces = jnp.concatenate([-lost, jnp.zeros(2)])
        extra = jnp.linalg.solve(arm.mass_matrix(state[:4]), forces)
        return arm.dynamics(state, held) + jnp.concatenate([jnp.zeros(4), extra])

    start = jnp.zeros(8).at[1].set(theta2)
    states = integrate(dynamics, start, reference, _STEP, every=_DECIMATE)
    y = jax.vmap(arm.joint_velocities)(states[:, :4], states[:, 4:])
    return y, jnp.cos(states[:, 1:2])
