"""Masses with springs and dampers to the ground and to each other."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._channels import require_channels
from lpvid.loop.structures._regression import least_squares, moments
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._units import per, times
from lpvid.loop.structures._windows import Windows, windows_of


class PortedMassSpringDamper(AbstractPortedStructure):
    """M q̈ + D q̇ + K q = u: as many forces as displacements; M, D and K symmetric.

    Coordinates are the displacements, then the lengths of the springs between neighbours,
    q_i − q_{i+1}, where a force is a pair. States [q, q̇].

    Args:
        data: records, for the names and units of the channels.

    Raises:
        ValueError: inputs and outputs differ in number.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import PortedMassSpringDamper
        >>> data = IOData(u=np.zeros((9, 2)), y=np.zeros((9, 2)), dt=0.1)
        >>> PortedMassSpringDamper(data).coordinate_names
        ('y1', 'y2', 'y1 - y2')
    """

    labels: Labels = eqx.field(static=True)
    name: str = eqx.field(default="mass-spring-damper", static=True)

    def __init__(self, data: IOData):
        require_channels(data, self.name, inputs=None, outputs=(data.nu,))
        n = data.ny
        force, position = data.input_units[0], data.output_units[0]
        rows, columns = np.tril_indices(n)
        units = (times(force, "s²"), times(force, "s"), force)
        names = data.output_names
        pairs = list(zip(names[:-1], names[1:], strict=True))
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=names,
            output_units=data.output_units,
            parameters=tuple(
                f"{kind}[{i + 1},{j + 1}]" if n > 1 else kind
                for kind in ("mass", "damping", "stiffness")
                for i, j in zip(rows, columns, strict=True)
            ),
            parameter_units=tuple(per(unit, position) for unit in units for _ in rows),
            coordinates=(*names, *(f"{a} - {b}" for a, b in pairs)),
            coordinate_units=(*data.output_units, *data.output_units[:-1]),
            force_units=(*data.input_units, *data.input_units[:-1]),
        )

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ, the lower triangles of M, D and K row by row."""
        del kappa
        n = len(self.labels.outputs)
        mass, damping, stiffness = (_symmetric(part, n) for part in jnp.split(theta, 3))
        mobility = jnp.linalg.inv(mass)
        still, unit = jnp.zeros((n, n)), jnp.eye(n)
        readings = np.concatenate([np.eye(n), np.eye(n)[:-1] - np.eye(n)[1:]])
        blank = jnp.zeros((2 * n - 1, n))
        directions = jnp.concatenate([blank, readings @ mobility.T], axis=1)
        spring = [-matrix[np.arange(n - 1), np.arange(1, n)] for matrix in (stiffness, damping)]
        transmitted = jnp.concatenate([part[:, None] * readings[n:] for part in spring], axis=1)
        return Ports(
            A=jnp.block([[still, unit], [-mobility @ stiffness, -mobility @ damping]]),
            B=jnp.concatenate([still, mobility]),
            C=jnp.concatenate([unit, still], axis=1),
            D=still,
            force=directions[:, :, None],
            position=jnp.concatenate([jnp.asarray(readings), blank], axis=1),
            velocity=jnp.concatenate([blank, jnp.asarray(readings)], axis=1),
            load_state=jnp.concatenate([jnp.zeros((n, 2 * n)), transmitted]),
            load_input=jnp.concatenate([unit, jnp.zeros((n - 1, n))]),
        )

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Masses on the diagonal are positive."""
        n = len(self.labels.outputs)
        rows, columns = np.tril_indices(n)
        lower = np.full(3 * len(rows), -np.inf)
        lower[: len(rows)][rows == columns] = 1e-15
        return lower, np.full(3 * len(rows), np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ by regression over windows and a search from there."""
        n = len(self.labels.outputs)
        windows = windows_of(data, 2 * n)
        guesses = np.array([_regression(entry, n) for entry in windows])
        return best_start(window_error(self, windows), guesses)[0]


def _symmetric(entries: Array, n: int) -> Array:
    rows, columns = np.tril_indices(n)
    lower = jnp.zeros((n, n)).at[rows, columns].set(entries)
    return lower + jnp.tril(lower, -1).T


def _regression(windows: Windows, n: int) -> np.ndarray:
    known = moments(windows, n, n)
    rows, columns = np.tril_indices(n)
    blocks, targets = [], []
    for equation in range(n):
        parts = []
        for signal in (known.accelerations, known.velocities, known.positions):
            part = np.zeros((len(rows), signal.shape[1]))
            part[rows == equation] = signal[columns[rows == equation]]
            mirrored = (columns == equation) & (rows != equation)
            part[mirrored] = signal[rows[mirrored]]
            parts.append(part)
        size = max(float(np.linalg.norm(known.inputs[equation])), 1e-300)
        blocks.append(np.concatenate(parts).T / size)
        targets.append(known.inputs[equation] / size)
    theta = least_squares(np.concatenate(blocks), np.concatenate(targets))
    mass = np.zeros((n, n))
    mass[rows, columns] = theta[: len(rows)]
    mass = mass + np.tril(mass, -1).T
    # A mass matrix that noise has made indefinite is no start.
    values, vectors = np.linalg.eigh(mass)
    values = np.maximum(np.abs(values), 1e-3 * np.abs(values).max())
    theta[: len(rows)] = (vectors * values @ vectors.T)[rows, columns]
    return theta
