"""A stand-in for a refined model: two modes and a lag, with a covariance."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lpvid.models import StateSpace

# What the entries of A and C are made of is constant: few operations to compile.
PLACES = ((1, 0), (1, 1), (3, 2), (3, 3), (4, 4))


class TwoModes(eqx.Module):
    """Has what a `Refined` has: model, parameters, covariance, model_at, names."""

    parameters: jax.Array
    covariance: jax.Array
    dt: float = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, dt=0.0, spread=(0.01, 0.02, 0.002, 0.002, 0.2)):
        self.dt = dt
        self.parameters = jnp.array([2.0, 5.0, 0.03, 0.02, 3.0])
        self.covariance = jnp.asarray(np.diag(spread) ** 2)
        self.parameter_names = ("f1", "f2", "ζ1", "ζ2", "rate")

    @property
    def model(self):
        return self.model_at(self.parameters)

    @property
    def robust_covariance(self):
        return 4.0 * self.covariance

    def model_at(self, p):
        """Frequencies in Hz, damping ratios and the lag's rate; by Euler's rule with a dt."""
        w = 2.0 * np.pi * p[:2]
        decay = -2.0 * p[2:4] * w
        entries = jnp.stack([-(w[0] ** 2), decay[0], -(w[1] ** 2), decay[1], -p[4]])
        where = np.zeros((5, 5, 5))
        for index, place in enumerate(PLACES):
            where[(*place, index)] = 1.0
        constant = np.zeros((5, 5))
        constant[0, 1] = constant[2, 3] = 1.0
        A = where @ entries + constant
        C = np.array([[-1.0, 0, 0, 0, 0], [0, 0, 1.0, 0, 0], [0, 0, 0, 0, -1.0]])
        C = (entries[np.array([0, 2, 4])] @ C)[None]
        B = np.array([[0.0], [1.0], [0.0], [1.0], [1.0]])
        if self.dt:
            return StateSpace(np.eye(5) + self.dt * A, self.dt * B, C, dt=self.dt)
        return StateSpace(A, B, C)
