"""Records of one mass on a spring with something more, by an integrator of their own."""

import numpy as np
import scipy.linalg

from lpvid.data import IOData
from lpvid.effects import law
from lpvid.loop import close_the_loop, structure_named

DT = 0.02
MASS, DAMPING, STIFFNESS = 1.0, 0.8, 20.0
NOISE = 2e-4
FINE = 40
"""Steps a sample is taken in, each exact but for the force, which is held."""

FEW = tuple(
    law(name)
    for name in (
        "coulomb",
        "asymmetric-viscous",
        "quadratic-drag",
        "cubic-stiffness",
        "saturation",
        "torque-bias",
    )
)
"""Laws enough for a choice, few enough to compile in a test."""


def coulomb(level):
    """Dry friction, ten times sharper than the library's grid goes."""
    return lambda q, v, t: -level * np.tanh(v / 2e-4)


def record(force=None, *, samples=900, noise=NOISE, seed=0, factor=None, command=None):
    """A held force on the mass, random or a controller's, its position measured.

    Args:
        force: f(q, v, t) that the linear model does not have.
        samples: of the record.
        noise: standard deviation of the output's noise.
        seed: of input and noise.
        factor: of the stiffness over the record (samples,), 1 by default.
        command: held force from the sample's number and the position there, without noise.
    """
    rng = np.random.default_rng(seed)
    u = 2.0 * np.repeat(rng.standard_normal(samples // 6 + 1), 6)[:samples]
    factor = np.ones(samples) if factor is None else factor
    steps = {}
    for size in np.unique(factor):
        generator = np.zeros((3, 3))
        generator[0, 1], generator[1, 2] = 1.0, 1.0 / MASS
        generator[1, :2] = -STIFFNESS * size / MASS, -DAMPING / MASS
        steps[size] = scipy.linalg.expm(generator * DT / FINE)[:2]
    x, positions = np.zeros(2), np.zeros(samples)
    for k in range(samples):
        positions[k] = x[0]
        u[k] = u[k] if command is None else command(k, x[0])
        step = steps[factor[k]]
        for i in range(FINE):
            push = u[k] if force is None else u[k] + force(x[0], x[1], DT * (k + i / FINE))
            x = step[:, :2] @ x + step[:, 2] * push
    y = positions + noise * rng.standard_normal(samples)
    units = {"u": "N", "y": "m"}
    return IOData(u=u, y=y, dt=DT, names={"u": "force", "y": "place"}, units=units)


def closed(data, structure="mass-spring-damper", **options):
    """The loop closed over a record, its structure started from what estimates."""
    train = data.split(options.get("split", 2.0 / 3.0))[0]
    return close_the_loop(structure_named(structure, train), data, **options)
