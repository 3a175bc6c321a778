"""The blind suite's integrator: many records of one plant at once, in NumPy.

Strang splitting at a fraction of the sample time: the linear part moves exactly (input held), the
effects kick the velocities in between, and set-valued friction is a projection that truly sticks.
"""

import dataclasses

import numpy as np

from benchmarks.blind_suite._laws import (
    DAMPED,
    DRY,
    FORCES,
    INERTIAL,
    INPUTS,
    OUTPUTS,
    Effect,
    Seen,
)
from benchmarks.blind_suite._plants import KAPPA_NODES, Motion, Plant

SUBSTEPS = 8
LONGEST_DELAY = 12


@dataclasses.dataclass
class Runs:
    """What drives a batch of records, (record, …) each.

    Attributes:
        motions: numbers of each record's plant.
        effects: of each record, two at most.
        excitation: added to the controller's output (record, time, nu).
        reference: (record, time, ny).
        closed: whether the loop is closed (record,).
        noise: (record, time, ny), which the controller sees too.
        angle: θ2 at the start for a scheduled plant (record,).
        moving: whether κ follows the motion (record,).
        kappa: measured schedule of the other plants (record, time); zeros without one.
    """

    motions: list[Motion]
    effects: list[list[Effect]]
    excitation: np.ndarray
    reference: np.ndarray
    closed: np.ndarray
    noise: np.ndarray
    angle: np.ndarray
    moving: np.ndarray
    kappa: np.ndarray


@dataclasses.dataclass
class Signals:
    """u and y as recorded, κ, and every coordinate's position and velocity (record, time, …)."""

    u: np.ndarray
    y: np.ndarray
    kappa: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


def _matrices(motion: Motion, absorber: Effect | None, plant: Plant):
    """M (node, n, n), D, K and G with one more degree of freedom, idle but for a missing mode."""
    dof = motion.damping.shape[0]
    mass = np.zeros((motion.mass.shape[0], dof + 1, dof + 1))
    mass[:, :dof, :dof] = motion.mass
    damping, stiffness = np.zeros((2, dof + 1, dof + 1))
    damping[:dof, :dof], stiffness[:dof, :dof] = motion.damping, motion.stiffness
    added, omega, ratio = 1.0, 1.0, 0.0
    direction = np.zeros(dof + 1)
    if absorber is not None:
        added, (omega, ratio) = absorber.amplitude[0], absorber.shape
        direction[:dof] = plant.coordinates[str(absorber.port)]
    direction[dof] = -1.0
    mass[:, dof, dof] = added
    stiffness += added * omega**2 * np.outer(direction, direction)
    damping += 2.0 * ratio * omega * added * np.outer(direction, direction)
    inputs = np.vstack([motion.inputs, np.zeros((1, motion.inputs.shape[1]))])
    return mass, damping, stiffness, inputs


def _exponential(A: np.ndarray) -> np.ndarray:
    """exp(A) of a stack of matrices, by scaling and a Taylor series."""
    norm = np.max(np.abs(np.linalg.eigvals(A)))
    halvings = max(0, int(np.ceil(np.log2(max(norm, 1e-12)))) + 2)
    A = A / 2**halvings
    total = term = np.broadcast_to(np.eye(A.shape[-1]), A.shape)
    for order in range(1, 13):
        term = term @ A / order
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def _lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Weights (…, node) of the polynomial through values at Chebyshev nodes."""
    if len(nodes) == 1:
        return np.ones((*np.shape(at), 1))
    k = np.arange(len(nodes))
    weights = (-1.0) ** k * np.sin(np.pi * (k + 0.5) / len(nodes))
    distance = np.asarray(at)[..., None] - nodes
    distance = np.where(np.abs(distance) < 1e-13, 1e-13, distance)
    share = weights / distance
    return share / share.sum(-1, keepdims=True)


class _Group:
    """The effects of one law: which records, where, and their numbers."""

    def __init__(self, name: str, rows: list[int], effects: list[Effect], plant: Plant, dof: int):
        self.name, self.rows = name, np.array(rows)
        self.amplitude = np.array([(*e.amplitude, 0.0)[:2] for e in effects])
        self.shape = np.array([(*e.shape, 0.0, 0.0)[:2] for e in effects])
        self.memory = np.zeros((len(rows), 2))
        self.port = np.array([e.port if isinstance(e.port, int) else 0 for e in effects])
        # The input that belongs to a coordinate: its own where there are as many.
        self.driver = np.zeros(len(rows), int)
        self.force = np.zeros((len(rows), dof + 1))
        self.direction = np.zeros((len(rows), dof + 1))
        for k, effect in enumerate(effects):
            if isinstance(effect.port, str):
                self.direction[k, :dof] = plant.coordinates[effect.port]
                place = list(plant.coordinates).index(effect.port)
                self.driver[k] = place if place < len(plant.inputs) else 0


def _groups(plant: Plant, effects: list[list[Effect]], dof: int) -> list[_Group]:
    """Effects by slot and law; a record appears once in a group, so that plain `+=` adds."""
    found: dict[tuple[int, str], tuple[list[int], list[Effect]]] = {}
    for row, those in enumerate(effects):
        for slot, effect in enumerate(those):
            rows, listed = found.setdefault((slot, effect.name), ([], []))
            rows.append(row)
            listed.append(effect)
    return [_Group(key[1], *value, plant, dof) for key, value in sorted(found.items())]


def simulate(plant: Plant, runs: Runs, substeps: int = SUBSTEPS) -> Signals:
    """The records of `runs`, each from rest."""
    records, samples, nu = runs.excitation.shape
    dof = runs.motions[0].damping.shape[0]
    n = dof + 1
    step = plant.dt / substeps
    absorbers = [next((e for e in those if e.kind == "mode"), None) for those in runs.effects]
    parts = [
        _matrices(motion, absorber, plant)
        for motion, absorber in zip(runs.motions, absorbers, strict=True)
    ]
    mass, damping, stiffness, inputs = (np.stack(part) for part in zip(*parts, strict=True))

    # Propagators over half a substep, (record, node, state, state + input), at nodes of κ.
    fine = np.cos(np.pi * (np.arange(21) + 0.5) / 21) if plant.scheduled else np.zeros(1)
    coarse = KAPPA_NODES if plant.scheduled else np.zeros(1)
    at_fine = np.einsum("fc,rcij->rfij", _lagrange(coarse, fine), mass)
    mobility = np.linalg.inv(at_fine)
    A = np.zeros((records, len(fine), 2 * n + nu, 2 * n + nu))
    A[..., :n, n : 2 * n] = np.eye(n)
    A[..., n : 2 * n, :n] = -mobility @ stiffness[:, None]
    A[..., n : 2 * n, n : 2 * n] = -mobility @ damping[:, None]
    A[..., n : 2 * n, 2 * n :] = mobility @ inputs[:, None]
    half = _exponential(0.5 * step * A)[..., : 2 * n, :]
    rates = A[..., n : 2 * n, :]

    outputs = np.zeros((records, runs.motions[0].outputs.shape[0], 2 * n))
    outputs[..., :dof] = [motion.outputs[:, :dof] for motion in runs.motions]
    outputs[..., n : n + dof] = [motion.outputs[:, dof:] for motion in runs.motions]
    ny = outputs.shape[1]

    groups = _groups(plant, runs.effects, dof)
    smooth = [g for g in groups if g.name in FORCES]
    damped = [g for g in smooth if g.name in DAMPED]
    dry = [g for g in groups if g.name in DRY]
    inertial = [g for g in groups if g.name in INERTIAL]
    static = [g for g in groups if g.name in INPUTS]
    slew = [g for g in groups if g.name == "slew limit"]
    delays = [g for g in groups if g.name == "input-delay"]
    lags = [g for g in groups if g.name == "actuator-lag"]
    sensors = [g for g in groups if g.name in OUTPUTS]
    slow = [g for g in groups if g.name == "sensor-lag"]

    state = np.zeros((records, 2 * n, 1))
    q, v = state[:, :n, 0], state[:, n:, 0]
    history = np.zeros((records, LONGEST_DELAY + 2, nu))
    filtered = np.zeros((records, ny))
    integral = np.zeros((records, ny))
    joint = list(plant.coordinates.values())
    directions = np.array([(*e, 0.0) for e in joint])
    u_log = np.zeros((records, samples, nu))
    y_log = np.zeros((records, samples, ny))
    kappa_log = np.zeros((records, samples))
    q_log = np.zeros((records, samples, len(joint)))
    v_log = np.zeros((records, samples, len(joint)))
    last = np.zeros((records, ny))
    P, W, R = half[:, 0], mobility[:, 0], rates[:, 0]
    # Which other coordinate a cross-coupling reads: the first one that is not its own.
    spread = np.roll(np.eye(n)[:dof], 1, axis=0)
    schedule = np.zeros(records)

    def seen(g: _Group, held, time) -> Seen:
        rows, e = g.rows, g.direction
        load = other = rows
        if g.name == "load-dependent":
            load = np.einsum("ri,rij,rj->r", e, stiffness[rows], q[rows])
        elif g.name == "cross damping":
            other = np.sum((e[:, :dof] @ spread) * q[rows], 1)
        return Seen(
            position=np.sum(e * q[rows], 1),
            velocity=np.sum(e * v[rows], 1),
            load=load,
            other=other,
            schedule=schedule[rows],
            input=held[rows, g.driver],
            time=time,
            step=step,
        )

    def force_of(g: _Group, time: float) -> np.ndarray:
        law = FORCES[g.name](seen(g, held, time), g.amplitude, g.shape, g.memory)
        g.force = law[:, None] * g.direction
        return g.force

    held = np.zeros((records, nu))
    for k in range(samples):
        now = k * plant.dt
        # What the sensors say.
        y = (outputs @ state)[..., 0]
        for g in slow:
            y[g.rows, g.port] = g.memory[:, 0]
        for g in sensors:
            y[g.rows, g.port] = OUTPUTS[g.name](y[g.rows, g.port], g.amplitude, g.shape, now)
        y = y + runs.noise[:, k]
        # What the computer does; the derivative is filtered over five samples.
        wanted = runs.reference[:, k] - y
        if plant.rate_outputs:
            integral += plant.dt * wanted
            feedback = (runs.reference[:, k] + integral @ plant.proportional.T)[:, :nu]
        else:
            difference = (y - last) / plant.dt if k else np.zeros_like(y)
            filtered += 0.2 * (difference - filtered)
            feedback = wanted @ plant.proportional.T - filtered @ plant.derivative.T
        last = y
        u = runs.excitation[:, k] + runs.closed[:, None] * feedback
        # κ, measured at the sample and held.
        if plant.scheduled:
            kappa = np.cos(runs.angle + runs.moving * q[:, 1])
            if k == 0 or runs.moving.any():
                share = _lagrange(fine, kappa)
                P = np.einsum("rf,rfij->rij", share, half)
                W = np.einsum("rf,rfij->rij", share, mobility)
                R = np.einsum("rf,rfij->rij", share, rates)
            schedule = kappa
        else:
            kappa = schedule = runs.kappa[:, k]
        u_log[:, k], y_log[:, k], kappa_log[:, k] = u, y, kappa
        q_log[:, k], v_log[:, k] = q @ directions.T, v @ directions.T

        held = u.copy()
        for g in static:
            value = INPUTS[g.name](held[g.rows, g.port], g.amplitude, g.shape)
            held[g.rows, g.port] = value
        for g in slew:
            reach = g.amplitude[:, 0] * plant.dt
            g.memory[:, 0] += np.clip(held[g.rows, g.port] - g.memory[:, 0], -reach, reach)
            held[g.rows, g.port] = g.memory[:, 0]
        history[:, 1:] = history[:, :-1]
        history[:, 0] = held

        for s in range(substeps):
            time = now + (s + 0.5) * step
            drive = held
            if delays or lags:
                drive = held.copy()
            for g in delays:
                late = np.ceil(g.shape[:, 0] / step - 1e-9).astype(int)
                back = -((s - late) // substeps)
                drive[g.rows, g.port] = history[g.rows, back, g.port]
            for g in lags:
                # The mean of the exact response over the substep.
                tau, entering = g.shape[:, 0], drive[g.rows, g.port]
                gap = entering - g.memory[:, 0]
                drive[g.rows, g.port] = entering - gap * tau / step * -np.expm1(-step / tau)
                g.memory[:, 0] = entering - gap * np.exp(-step / tau)
            pushed = P[..., 2 * n :] @ drive[..., None]
            state[:] = P[..., : 2 * n] @ state + pushed
            if smooth or dry or inertial:
                kick = np.zeros((records, n))
                for g in smooth:
                    kick[g.rows] += force_of(g, time)
                if damped:
                    before = v.copy()
                    v += 0.5 * step * (W @ kick[..., None])[..., 0]
                    for g, first in zip(damped, [g.force for g in damped], strict=True):
                        kick[g.rows] += force_of(g, time) - first
                    v[:] = before
                a = kick
                if inertial or dry:
                    whole = np.concatenate([state[..., 0], drive], axis=1)
                    a = (R @ whole[..., None])[..., 0]
                for g in inertial:
                    e, here = g.direction, seen(g, held, time)
                    inertia, slope = (part(here, g.amplitude) for part in INERTIAL[g.name])
                    grip = np.einsum("ri,rij,rj->r", e, W[g.rows], e)
                    smoothly = a[g.rows] + np.einsum("rij,rj->ri", W[g.rows], kick[g.rows])
                    force = -0.5 * slope * here.velocity**2
                    # The acceleration that it resists is the one it lets happen.
                    force -= inertia * (np.sum(e * smoothly, 1) + grip * force)
                    force /= 1.0 + inertia * grip
                    kick[g.rows] += force[:, None] * e
                v += step * (W @ kick[..., None])[..., 0]
                for g in dry:
                    e = g.direction
                    here = seen(g, held, time)
                    level = step * DRY[g.name](here, g.amplitude, g.shape)
                    reach = np.einsum("rij,rj->ri", W[g.rows], e)
                    grip = np.sum(e * reach, 1)
                    # Speed that the coming half step would end with: what friction has to stop.
                    coming = here.velocity + 0.5 * step * np.sum(e * a[g.rows], 1)
                    impulse = np.clip(coming / grip, -level, level)
                    v[g.rows] -= impulse[:, None] * reach
            state[:] = P[..., : 2 * n] @ state + pushed
            for g in slow:
                # Exact for an output that moves on a straight line over the substep.
                clean = np.sum(outputs[g.rows, g.port] * state[g.rows, :, 0], 1)
                slope, tau = (clean - g.memory[:, 1]) / step, g.shape[:, 0]
                behind = (g.memory[:, 0] - g.memory[:, 1] + tau * slope) * np.exp(-step / tau)
                g.memory[:, 0], g.memory[:, 1] = clean - tau * slope + behind, clean
    return Signals(u_log, y_log, kappa_log, q_log, v_log)
