"""Records of the study of Vizer et al. 2015, section 3.3: local, validation and sweep."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lpvid.data import IOData
from lpvid.mechanics._excitation import prbs
from lpvid.mechanics._two_link_arm import ArmMotion, TwoLinkFlexibleArm

OPERATING_POINTS = tuple(float(i * np.pi / 8.0) for i in range(1, 8))
"""θ2 of the study's local experiments, rad."""

_NAMES = {"u": ("reference1", "reference2"), "y": ("velocity1", "velocity2"), "kappa": "cos_theta2"}
_UNITS = {"u": ("rad/s", "rad/s"), "y": ("rad/s", "rad/s"), "kappa": ""}


class StudyRecords(NamedTuple):
    """All noise-free records of the study, from one simulation.

    Attributes:
        local: one record an operating point, for estimation.
        validation: the same points, another excitation.
        sweep: θ2 across its whole range.
    """

    local: IOData
    validation: IOData
    sweep: IOData


def local_records(
    arm: TwoLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    theta2: Sequence[float] = OPERATING_POINTS,
    n_samples: int = 30_000,
    dt: float = 1e-4,
    decimate: int = 10,
    amplitude: float = 0.1,
    hold: int = 50,
) -> IOData:
    """Noise-free records at fixed operating points under two uncorrelated PRBS references.

    The nonlinear arm is simulated at `dt` and every `decimate`-th sample is kept; since each bit
    lasts a multiple of `decimate` samples, the kept references are still held exactly. The default
    bit of 5 ms excites evenly up to 560 rad/s (−3 dB); the arm's poles lie in 22…730 rad/s.

    The sequences' running sums return to zero, so θ2 wanders by about amplitude · √(T hold dt) / 4
    only (0.003 rad by default); each record starts where its mean θ2 will be the operating point.

    Args:
        arm: the arm.
        key: random key; another key gives records for validation.
        theta2: operating points, rad, in (0, π).
        n_samples: samples per record at `dt`.
        dt: sample time of the simulation, s; also the integrator's step.
        decimate: the records' sample time is `decimate · dt`.
        amplitude: PRBS level, rad/s.
        hold: simulation samples a bit lasts, a multiple of `decimate`.

    Returns:
        `IOData` with one record per operating point: u = θ̇*, y = rigid joint velocities, both in
        rad/s, kappa = cos θ2 constant.

    Raises:
        ValueError: if `decimate` does not divide `hold` and `n_samples`, or a point lies outside
            of (0, π).

    Example:
        >>> arm = reference_two_link_arm()
        >>> local_records(arm, jax.random.key(0), n_samples=2000).lengths
        (200, 200, 200, 200, 200, 200, 200)
    """
    _check_sampling(n_samples, decimate, hold)
    points = _operating_points(theta2)
    references, starts = _local_experiments(key, points, n_samples, dt, amplitude, hold)
    motion = _simulate_all(arm, references, starts, jnp.asarray(dt, float), decimate)
    return _local_data(motion, references, points, dt, decimate)


def validation_record(
    arm: TwoLinkFlexibleArm, key: PRNGKeyArray, *, theta2: float = np.pi / 2.0, **options
) -> IOData:
    """One noise-free record at one operating point: `local_records` at a single `theta2`.

    Args:
        arm: the arm.
        key: random key, another one than the estimation records'.
        theta2: operating point, rad.
        **options: of `local_records`.

    Example:
        >>> key = jax.random.key(1)
        >>> validation_record(reference_two_link_arm(), key, n_samples=2000).y.shape
        (200, 2)
    """
    return local_records(arm, key, theta2=(theta2,), **options)


def sweep_record(
    arm: TwoLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    duration: float = 3.2,
    theta2: tuple[float, float] = (OPERATING_POINTS[0], OPERATING_POINTS[-1]),
    dt: float = 1e-4,
    decimate: int = 10,
    amplitude: float = 0.1,
    hold: int = 50,
) -> IOData:
    """Noise-free record in which θ2 crosses its whole range, PRBS on both references.

    θ2's reference follows half a cosine from end to end (at rest at both, 1.16 rad/s at most by
    default); it is held over `decimate` samples, so that the record's own hold is exact.

    Args:
        arm: the arm.
        key: random key.
        duration: length of the record and of the crossing, s.
        theta2: where the crossing starts and ends, rad.
        dt: sample time of the simulation, s.
        decimate: the record's sample time is `decimate · dt`.
        amplitude: PRBS level on both references, rad/s.
        hold: simulation samples a bit lasts, a multiple of `decimate`.

    Returns:
        `IOData` with one record, kappa(t) = cos θ2(t) from the simulated joint angle.

    Raises:
        ValueError: if `decimate` does not divide `hold` and the record's length, or `theta2` lies
            outside of (0, π).

    Example:
        >>> arm = reference_two_link_arm()
        >>> sweep_record(arm, jax.random.key(2), duration=0.2).kappa.shape
        (200, 1)
    """
    n_samples = round(duration / dt)
    _check_sampling(n_samples, decimate, hold)
    ends = _operating_points(theta2)
    reference, start = _sweep_experiment(key, ends, n_samples, dt, decimate, amplitude, hold)
    motion = _simulate_all(arm, reference[None], start[None], jnp.asarray(dt, float), decimate)
    return _sweep_data(motion, reference, dt, decimate)


def study_records(
    arm: TwoLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    theta2: Sequence[float] = OPERATING_POINTS,
    n_samples: int = 30_000,
    sweep_duration: float = 3.2,
    dt: float = 1e-4,
    decimate: int = 10,
    amplitude: float = 0.1,
    hold: int = 50,
) -> StudyRecords:
    """Local, validation and sweep records in one batched simulation, compiled once.

    Equal to `local_records`, `local_records` with another key and `sweep_record` for the three keys
    of `jax.random.split(key, 3)`; see there for the arguments.

    Example:
        >>> arm = reference_two_link_arm()
        >>> records = study_records(arm, jax.random.key(0), n_samples=2000, sweep_duration=0.2)
        >>> records.validation.lengths == records.local.lengths
        True
    """
    sweep_samples = round(sweep_duration / dt)
    _check_sampling(n_samples, decimate, hold)
    _check_sampling(sweep_samples, decimate, hold)
    points = _operating_points(theta2)
    local_key, validation_key, sweep_key = jax.random.split(key, 3)
    local, local_starts = _local_experiments(local_key, points, n_samples, dt, amplitude, hold)
    other, other_starts = _local_experiments(validation_key, points, n_samples, dt, amplitude, hold)
    sweep, sweep_start = _sweep_experiment(
        sweep_key, points[jnp.array([0, -1])], sweep_samples, dt, decimate, amplitude, hold
    )
    # One length for the batch: the shorter records are simulated on, at rest references, and cut.
    longest = max(n_samples, sweep_samples)
    batch = jnp.concatenate(
        [
            jnp.pad(references, ((0, 0), (0, longest - references.shape[1]), (0, 0)))
            for references in (local, other, sweep[None])
        ]
    )
    starts = jnp.concatenate([local_starts, other_starts, sweep_start[None]])
    motion = _simulate_all(arm, batch, starts, jnp.asarray(dt, float), decimate)
    count = points.shape[0]

    def part(lanes: slice, samples: int) -> ArmMotion:
        return eqx.tree_at(
            lambda m: (m.y, m.positions),
            motion,
            tuple(signal[lanes, : samples // decimate] for signal in (motion.y, motion.positions)),
        )

    return StudyRecords(
        _local_data(part(slice(0, count), n_samples), local, points, dt, decimate),
        _local_data(part(slice(count, 2 * count), n_samples), other, points, dt, decimate),
        _sweep_data(part(slice(2 * count, None), sweep_samples), sweep, dt, decimate),
    )


def _local_experiments(
    key: PRNGKeyArray, points: Array, n_samples: int, dt: float, amplitude: float, hold: int
) -> tuple[Float[Array, "record time 2"], Float[Array, " record"]]:
    references = jax.vmap(lambda each: prbs(each, n_samples, 2, amplitude=amplitude, hold=hold))(
        jax.random.split(key, points.shape[0])
    )
    # The joint follows its reference's running sum within the loop's few milliseconds.
    mean_travel = jnp.mean(jnp.cumsum(references[:, :, 1], axis=1), axis=1) * dt
    return references, points - mean_travel


def _sweep_experiment(
    key: PRNGKeyArray,
    ends: Array,
    n_samples: int,
    dt: float,
    decimate: int,
    amplitude: float,
    hold: int,
) -> tuple[Float[Array, "time 2"], Float[Array, ""]]:
    steps = n_samples // decimate
    # Mean velocity of the half cosine over each held sample: the held reference lands exactly.
    progress = 0.5 * (1.0 - jnp.cos(jnp.linspace(0.0, jnp.pi, steps + 1)))
    velocity = (ends[1] - ends[0]) * jnp.diff(progress) / (decimate * dt)
    crossing = jnp.repeat(velocity, decimate)
    reference = prbs(key, n_samples, 2, amplitude=amplitude, hold=hold)
    return reference.at[:, 1].add(crossing), ends[0]


@eqx.filter_jit
def _simulate_all(arm, references, starts, dt, decimate):
    return jax.vmap(
        lambda reference, start: arm.simulate(
            reference=reference, dt=dt, theta2_start=start, every=decimate
        )
    )(references, starts)


def _local_data(motion, references, points, dt, decimate) -> IOData:
    u = references[:, ::decimate]
    kappa = jnp.broadcast_to(jnp.cos(points)[:, None, None], (*u.shape[:2], 1))
    return IOData(u=u, y=motion.y, dt=decimate * dt, kappa=kappa, names=_NAMES, units=_UNITS)


def _sweep_data(motion, reference, dt, decimate) -> IOData:
    kappa = jnp.cos(motion.positions[0, :, 1:2])
    return IOData(
        u=reference[::decimate],
        y=motion.y[0],
        dt=decimate * dt,
        kappa=kappa,
        names=_NAMES,
        units=_UNITS,
    )


def _operating_points(theta2: Sequence[float]) -> Float[Array, " record"]:
    points = np.asarray(theta2, float)
    if points.ndim != 1 or not (np.all(points > 0.0) and np.all(points < np.pi)):
        raise ValueError(f"theta2={theta2} must be a sequence of angles in (0, π), in radians.")
    return jnp.asarray(points)


def _check_sampling(n_samples: int, decimate: int, hold: int) -> None:
    if decimate < 1 or n_samples < 1 or n_samples % decimate or hold % decimate:
        raise ValueError(
            f"decimate={decimate} must divide hold={hold} and the {n_samples} samples, so that a "
            "kept reference holds until the next: round them to multiples of it."
        )
