r"""Starts from windows: what a linear model cannot tell is left open in each of them.

In a window of few samples Y = O x₀ + T U + T 1 b with the window's own first state x₀ and its own
constant b on every input. Both are projected out, so friction, gravity and offsets, which hardly
change within a window, hardly move the estimate. What remains is a small least-squares problem
whose size does not depend on the record's, solved from many guesses (Levenberg–Marquardt).
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop.structures._windows import Windows

_STEP = 1e-6
# A start is good enough where a step gains less than this share.
_ENOUGH = 1e-4
_TRIALS = np.array([0.01, 0.3, 10.0, 1e3])
# Points whose matrices are evaluated at once: one compiled size serves everything.
_LEAST_BATCH = 8
# So small a share of the window's free columns is not projected out.
_RIDGE = 1e-12


Matrices = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]


class WindowError:
    """Prediction errors of a structure over windows, for batches of parameters.

    Args:
        windows: of several lengths.
        ny: number of outputs.
        bounds: least and greatest parameters; where the least is positive, steps are logarithmic.
        matrices: A, B, C, D for batches (point, parameter) and (bin, nk), each (point, bin, …).
    """

    def __init__(
        self,
        windows: Sequence[Windows],
        *,
        ny: int,
        bounds: tuple[np.ndarray, np.ndarray],
        matrices: Matrices,
    ):
        self.windows = tuple(windows)
        self.ny = ny
        self.lower, self.upper = bounds
        self.logarithmic = self.lower > 0.0
        self.batch = max(len(self.lower) + 1, _LEAST_BATCH)
        self.matrices = matrices
        self.weights = [_first_weights(entry, ny) for entry in self.windows]

    def errors(
        self, thetas: Float[np.ndarray, "point parameter"], scale: int
    ) -> Float[np.ndarray, "point error"]:
        """Weighted errors over the windows of one length, in units of one sample's."""
        windows = self.windows[scale]
        A, B, C, D = self.matrices(thetas, windows.kappas)
        observed, response, constant = window_maps(A, B, C, D, windows.step, windows.samples)
        weights = np.tile(self.weights[scale], windows.samples)
        error = weights[:, None] * (windows.outputs[None] - response @ windows.inputs[None])
        free = np.concatenate([observed, constant], axis=-1)
        free = weights[:, None] * free
        free = free / np.maximum(np.linalg.norm(free, axis=-2, keepdims=True), 1e-300)
        square = np.swapaxes(free, -1, -2)
        gram = square @ free + _RIDGE * np.eye(free.shape[-1])
        error = error - free @ np.linalg.solve(gram, square @ error)
        left = max(error.shape[-2] - free.shape[-1], 1) * windows.number
        return error.reshape(len(thetas), -1) / np.sqrt(left)

    def losses(
        self, thetas: Float[np.ndarray, "point parameter"], scale: int
    ) -> Float[np.ndarray, "point ny"]:
        """Mean squared errors of each output in its own unit; infinite where the model diverges."""
        windows = self.windows[scale]
        parts = []
        for first in range(0, len(thetas), self.batch):
            error = self.errors(thetas[first : first + self.batch], scale)
            shape = (len(error), len(windows.outputs), windows.samples, self.ny, -1)
            parts.append(np.sum(error.reshape(shape) ** 2, axis=(1, 2, 4)))
        losses = np.concatenate(parts) / self.weights[scale] ** 2
        return np.where(np.isfinite(losses), losses, np.inf)

    def scores(
        self, thetas: Float[np.ndarray, "point parameter"], scales: Sequence[int]
    ) -> Float[np.ndarray, " point"]:
        """Mean over lengths and outputs of the log mean squared error."""
        logs = [np.log(np.maximum(self.losses(thetas, scale), 1e-300)) for scale in scales]
        return np.mean(np.concatenate(logs, axis=1), axis=1)

    def reweigh(self, theta: Float[np.ndarray, " parameter"]) -> None:
        """Weigh the outputs, at each length, by what this point leaves of them."""
        for scale in range(len(self.windows)):
            size = np.sqrt(self.losses(theta[None], scale)[0])
            if np.all(np.isfinite(size)) and size.max() > 0:
                # An output that is predicted without error must not count for all.
                least = 1e-3 * np.max(size * self.weights[scale]) / self.weights[scale]
                self.weights[scale] = 1.0 / np.maximum(size, least)

    def descend(
        self,
        theta: Float[np.ndarray, " parameter"],
        scales: Sequence[int],
        *,
        iterations: int,
    ) -> Float[np.ndarray, " parameter"]:
        """Levenberg–Marquardt from one point, over windows of some lengths."""
        theta = self.inside(theta)
        unit = np.where(self.logarithmic, 1.0, np.where(theta == 0.0, 1.0, np.abs(theta)))
        damping = 1e-2
        best = np.inf
        for _ in range(iterations):
            near = self._moved(
                theta, _STEP * np.concatenate([np.zeros((1, len(unit))), np.diag(unit)])
            )
            errors = self._stacked(near, scales)
            if not np.all(np.isfinite(errors)):
                return theta
            loss = float(np.sum(errors[0] ** 2))
            sensitivity = (errors[1:] - errors[0]).T / _STEP
            size = np.maximum(np.linalg.norm(sensitivity, axis=0), 1e-300)
            scaled = sensitivity / size
            gram, slope = scaled.T @ scaled, scaled.T @ errors[0]
            best = min(best, loss)
            levels = np.maximum(damping * _TRIALS, 1e-12)
            steps = np.array(
                [
                    -np.linalg.solve(gram + level * np.eye(len(unit)), slope) / size
                    for level in levels
                ]
            )
            steps = np.clip(steps, -1.5, 1.5)
            trials = self._moved(theta, steps * unit)
            values = np.sum(self._stacked(trials, scales) ** 2, axis=1)
            values = np.where(np.isfinite(values), values, np.inf)
            chosen = int(np.argmin(values))
            if not values[chosen] < loss:
                if damping > 1e6:
                    return theta
                damping *= 1e3
                continue
            theta = trials[chosen]
            damping = levels[chosen]
            if loss - values[chosen] < _ENOUGH * loss:
                return theta
        return theta

    def _moved(self, theta, steps):
        """Points that lie `steps` away, logarithmic where a parameter has to stay positive."""
        with np.errstate(over="ignore"):
            moved = np.where(self.logarithmic, theta * np.exp(steps), theta + steps)
        return self.inside(moved)

    def inside(self, theta: np.ndarray) -> np.ndarray:
        """The nearest point within the bounds."""
        return np.clip(theta, self.lower, self.upper)

    def _stacked(self, thetas, scales):
        return np.concatenate([self.errors(thetas, scale) for scale in scales], axis=1)


def window_error(structure: AbstractPortedStructure, windows: Sequence[Windows]) -> WindowError:
    """Prediction errors of a structure over windows."""
    bounds = structure.bounds()
    batch = max(len(bounds[0]) + 1, _LEAST_BATCH)

    def matrices(thetas, kappas):
        padding = np.repeat(thetas[:1], batch - len(thetas), axis=0)
        compiled = _compiled(structure, np.concatenate([thetas, padding]), kappas)
        return tuple(np.asarray(matrix)[: len(thetas)] for matrix in compiled)

    return WindowError(windows, ny=len(structure.output_names), bounds=bounds, matrices=matrices)


@eqx.filter_jit
def _compiled(structure, thetas, kappas):
    def one(theta, kappa):
        ports = structure.ports(theta, kappa)
        return ports.A, ports.B, ports.C, ports.D

    along = jax.vmap(one, in_axes=(None, 0))
    return jax.vmap(along, in_axes=(0, None))(thetas, kappas)


def best_start(
    problem: WindowError,
    guesses: Float[np.ndarray, "guess parameter"],
    *,
    tries: int = 2,
    rounds: int = 2,
    followed: int = 2,
) -> tuple[Float[np.ndarray, " parameter"], float]:
    """The guess that descends furthest, judged over windows of all lengths together.

    Args:
        problem: the errors.
        guesses: as many as there are ideas.
        tries: guesses that are followed at each length.
        rounds: how often the best are then followed over all lengths together.
        followed: how many of them.

    Returns:
        θ, and the mean over lengths and outputs of its log mean squared error.
    """
    everything = list(range(len(problem.windows)))
    with np.errstate(all="ignore"):
        guesses = problem.inside(np.asarray(guesses, float))
        found = [guesses[int(np.argmin(problem.scores(guesses, everything)))]]
        for scale in everything:
            scores = problem.scores(guesses, [scale])
            for number in np.argsort(scores)[:tries]:
                if np.isfinite(scores[number]):
                    found.append(problem.descend(guesses[number], [scale], iterations=12))
        for _ in range(rounds):
            candidates = np.array(found)
            order = np.argsort(problem.scores(candidates, everything))
            problem.reweigh(candidates[order[0]])
            for number in order[:followed]:
                found.append(problem.descend(candidates[number], everything, iterations=20))
        candidates = np.array(found)
        scores = problem.scores(candidates, everything)
    chosen = int(np.argmin(scores))
    return candidates[chosen], float(scores[chosen])


def _first_weights(windows: Windows, ny: int) -> np.ndarray:
    """One over what a straight line leaves of each output in a window."""
    rows = windows.outputs.reshape(len(windows.outputs), windows.samples, ny, -1)
    time = np.linspace(-1.0, 1.0, windows.samples)
    line = np.linalg.qr(np.stack([np.ones_like(time), time], axis=1))[0]
    rows = rows - np.einsum("at,bt,gbjc->gajc", line, line, rows)
    size = np.sqrt(np.sum(rows**2, axis=(0, 1, 3)) / (windows.number * windows.samples))
    return 1.0 / np.where(size > 0, size, 1.0)


def window_maps(A, B, C, D, step, samples):
    """How a window's first state, its inputs and a constant on each input show in its outputs."""
    n, nu, ny = A.shape[-1], B.shape[-1], C.shape[-2]
    batch = A.shape[:-2]
    joint = np.zeros((*batch, n + 2 * nu, n + 2 * nu))
    joint[..., :n, :n] = A * step
    joint[..., :n, n : n + nu] = B * step
    joint[..., n : n + nu, n + nu :] = np.eye(nu)
    power = exponential(joint)
    transition, held, rising = np.split(power[..., :n, :], [n, n + nu], axis=-1)
    # A slope s means the line from −s to s about the mean over the step.
    drive = np.concatenate([held, 2.0 * rising - held], axis=-1)
    through = np.concatenate([D, -D], axis=-1)
    rows = [C]
    for _ in range(samples - 1):
        rows.append(rows[-1] @ transition)
    observed = np.stack(rows, axis=-3)
    markov = observed[..., :-1, :, :] @ drive[..., None, :, :]
    markov = np.concatenate([through[..., None, :, :], markov], axis=-3)
    markov = np.concatenate([markov, np.zeros_like(markov[..., :1, :, :])], axis=-3)
    later = np.subtract.outer(np.arange(samples), np.arange(samples))
    toeplitz = markov[..., np.where(later >= 0, later, samples), :, :]
    response = np.moveaxis(toeplitz, -2, -3).reshape(*batch, samples * ny, samples * 2 * nu)
    constant = response.reshape(*batch, samples * ny, samples, 2 * nu)[..., :nu].sum(axis=-2)
    return observed.reshape(*batch, samples * ny, n), response, constant


def exponential(matrix: Float[np.ndarray, "*batch n n"]) -> Float[np.ndarray, "*batch n n"]:
    """Matrix exponentials by scaling, a Taylor sum and squaring; fast for many small ones."""
    rows = np.sum(np.abs(matrix), axis=-1)
    size = np.max(rows, initial=0.0, where=np.isfinite(rows))
    halvings = min(max(int(np.ceil(np.log2(max(size, 1e-300)))) + 1, 0), 60)
    small = matrix / 2.0**halvings
    term = total = np.broadcast_to(np.eye(matrix.shape[-1]), matrix.shape)
    for order in range(1, 15):
        term = term @ small / order
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total
