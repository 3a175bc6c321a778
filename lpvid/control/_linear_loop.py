"""Loops as linear models: a controller's linear part, the closed loop, the loop opened."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from lpvid.control._closed_loop import check_no_feedthrough, sample_time
from lpvid.mechanics import SampledController
from lpvid.models import StateSpace

Place = Literal["input", "error"]


def controller_model(
    controller: SampledController, *, ny: int, dt: float, nr: int = 1
) -> StateSpace:
    """Linear part of a controller at rest, by autodiff of its step.

    Exact for PI, PD, PDP and ILQR; of PDPC and of a compensated PD the part without compensation.
    Composes with jit, vmap and grad.

    Args:
        controller: any whose state is a pytree of real arrays and whose step has a derivative.
        ny: number of outputs that it reads.
        dt: sample time, s.
        nr: number of set-points.

    Returns:
        Discrete-time `StateSpace` from [R, y] (nr + ny inputs) to the commands.

    Example:
        >>> from lpvid.control import PDP, controller_model
        >>> controller_model(PDP(0.5, 3.0, 0.1), ny=4, dt=0.01).D
        Array([[ 0.5, -0.5,  0. , -0.1, -3. ]], dtype=float64)
    """
    memory, restore = ravel_pytree(controller.initial())
    memory = memory.astype(float)

    def step(flat, reference, y):
        following, command = controller.step(restore(flat), reference, y)
        return ravel_pytree(following)[0].astype(float), command

    at = (memory, jnp.zeros(nr), jnp.zeros(ny))
    (A, *B), (C, *D) = jax.jacfwd(step, (0, 1, 2))(*at)
    return StateSpace(A, jnp.concatenate(B, axis=1), C, jnp.concatenate(D, axis=1), dt=dt)


def closed_loop(
    plant: StateSpace, controller: SampledController, *, dt: float | None = None, nr: int = 1
) -> StateSpace:
    """Closed loop from the set-points to outputs and commands, exact at the samples.

    A continuous-time model is held. Its simulation is that of `simulate_closed_loop` for a linear
    controller, by a faster route. Composes with jit, vmap and grad.

    Args:
        plant: without feedthrough; leading batch axes give a batch of loops.
        controller: its linear part closes the loop, see `controller_model`.
        dt: sample time, s; that of a discrete-time model when left out.
        nr: number of set-points.

    Returns:
        Discrete-time `StateSpace` from R to [y, u]; states of plant, then controller.

    Raises:
        ValueError: no sample time or another one than the model's; a feedthrough (not checked
            under `jit`).

    Example:
        >>> from lpvid.control import ProportionalIntegral, closed_loop
        >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> closed_loop(lag, ProportionalIntegral(0.5, 2.0, dt=0.1)).dc_gain()[:, 0].round(6)
        Array([1. , 0.5], dtype=float64)
    """
    plant = _sampled(plant, dt)
    control = controller_model(controller, ny=plant.ny, dt=plant.dt, nr=nr)
    return _over_batch(lambda one: _close(one, control, nr), plant)


def loop_transfer(
    plant: StateSpace,
    controller: SampledController,
    *,
    at: Place = "error",
    dt: float | None = None,
) -> StateSpace:
    """Loop opened at one place, for margins: the closed loop is 1/(1 + L) there.

    - error: from the position error R − y1 to y1, all other feedback closed: for a PDP controller
      G(s) = K_P G1 / (1 + K_sg G3 + K_d G4), equation 4-2 of 002;
    - input: from the plant's command to what the controller sends back, less its sign. A lag of the
      actuator acts here.

    Composes with jit, vmap and grad.

    Args:
        plant: with one input and without feedthrough; leading batch axes give a batch of loops.
        controller: its linear part, see `controller_model`.
        at: where it is opened.
        dt: sample time, s; that of a discrete-time model when left out.

    Returns:
        Discrete-time `StateSpace` with one input and one output.

    Raises:
        ValueError: as for `closed_loop`, a plant of several inputs, or an unknown place.

    Example:
        >>> from lpvid.control import ProportionalIntegral, loop_transfer
        >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> loop_transfer(lag, ProportionalIntegral(0.5, 0.0, dt=0.1)).poles().real.tolist()
        [0.5, 1.0]
    """
    if at not in _OPENED:
        raise ValueError(f"at={at!r} is unknown: give one of {', '.join(_OPENED)}.")
    plant = _sampled(plant, dt)
    if plant.nu != 1:
        raise ValueError(f"plant has {plant.nu} inputs: margins are those of a loop with one.")
    control = controller_model(controller, ny=plant.ny, dt=plant.dt)
    return _over_batch(lambda one: _OPENED[at](one, control), plant)


def _sampled(plant: StateSpace, dt: float | None) -> StateSpace:
    dt = sample_time(plant, dt)
    check_no_feedthrough(plant)
    return plant if plant.is_discrete else plant.discretise(dt)


def _over_batch(build: Callable[[StateSpace], StateSpace], plant: StateSpace) -> StateSpace:
    for _ in plant.batch_shape:
        build = eqx.filter_vmap(build)
    return build(plant)


def _block(rows: list[list[Array]]) -> Array:
    return jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])


def _close(plant: StateSpace, control: StateSpace, nr: int) -> StateSpace:
    Br, By = control.B[:, :nr], control.B[:, nr:]
    Dr, Dy = control.D[:, :nr], control.D[:, nr:]
    A = _block([[plant.A + plant.B @ Dy @ plant.C, plant.B @ control.C], [By @ plant.C, control.A]])
    B = jnp.concatenate([plant.B @ Dr, Br])
    C = _block([[plant.C, jnp.zeros((plant.ny, control.nx))], [Dy @ plant.C, control.C]])
    return StateSpace(A, B, C, jnp.concatenate([jnp.zeros((plant.ny, nr)), Dr]), dt=plant.dt)


def _open_at_error(plant: StateSpace, control: StateSpace) -> StateSpace:
    # The set-point of the closed loop is what stands for the error if y1 is added to it.
    closed = _close(plant, control, 1)
    first = closed.C[:1]
    return StateSpace(closed.A + closed.B @ first, closed.B, first, jnp.zeros((1, 1)), dt=plant.dt)


def _open_at_input(plant: StateSpace, control: StateSpace) -> StateSpace:
    By, Dy = control.B[:, 1:], control.D[:, 1:]
    A = _block([[plant.A, jnp.zeros((plant.nx, control.nx))], [By @ plant.C, control.A]])
    B = jnp.concatenate([plant.B, jnp.zeros((control.nx, 1))])
    C = -jnp.concatenate([Dy @ plant.C, control.C], axis=1)
    return StateSpace(A, B, C, jnp.zeros((1, 1)), dt=plant.dt)


_OPENED = {"error": _open_at_error, "input": _open_at_input}
