"""Plants and records with known answers."""

import jax.numpy as jnp
import numpy as np
from scipy.signal import dlsim

from lpvid.data import IOData
from lpvid.models import FunctionStructure, StateSpace

DT = 0.1
TRUTH = np.array([4.0, 0.4, 2.0, 0.3])
NAMES = ("stiffness", "damping", "gain", "feedthrough")


def oscillator(p):
    """ÿ + damping ẏ + stiffness y = gain u, with a feedthrough."""
    A = jnp.array([[0.0, 1.0], [-p[0], -p[1]]])
    return A, jnp.array([[0.0], [p[2]]]), jnp.array([[1.0, 0.0]]), p[3:4][None]


STRUCTURE = FunctionStructure(
    oscillator, nominal=TRUTH, names=NAMES, lower=[0.0, 0.0, -np.inf, -np.inf]
)


def inputs(n, nu=1, seed=0):
    return np.random.default_rng(seed).standard_normal((n, nu))


def structured_record(n=300, seed=0, noise=0.1, x0=(0.5, -0.5), colour=0.0, u_seed=0):
    """A record of the oscillator with noise e(t) = colour e(t−1) + white."""
    u = inputs(n, seed=u_seed)
    model = STRUCTURE.matrices(jnp.asarray(TRUTH))
    clean = np.asarray(model.simulate(u=u, dt=DT, x0=jnp.asarray(x0)))
    white = np.random.default_rng(1000 + seed).standard_normal((n + 200, 1))
    e = dlsim(([1.0, 0.0], [1.0, -colour], 1.0), white)[1][200:]
    return IOData(u=u, y=clean + noise * e, dt=DT), clean


def black_box():
    """Third order, two inputs and two outputs of very different sizes and noise."""
    A = np.array([[0.7, 0.5, 0.0], [-0.5, 0.7, 0.0], [0.0, 0.2, 0.6]])
    B = np.array([[1.0, 0.3], [0.0, -1.0], [0.5, 0.5]])
    C = np.array([[1.0, 0.0, 1.0], [0.0, 100.0, -50.0]])
    D = np.array([[0.2, 0.0], [0.0, 10.0]])
    return StateSpace(A, B, C, D, dt=DT)


def black_box_record(lengths=(200, 120), seed=0, noise=(0.2, 2.0)):
    """Records of different lengths, each from a state of its own."""
    rng = np.random.default_rng(seed)
    model, u, y = black_box(), [], []
    for index, n in enumerate(lengths):
        each = inputs(n, 2, seed=50 + index)
        x0 = np.array([2.0, -1.0, 1.0]) * (1 + index)
        clean = np.asarray(model.simulate(u=each, x0=x0))
        u.append(each)
        y.append(clean + np.asarray(noise) * rng.standard_normal(clean.shape))
    return IOData(u=u, y=y, dt=DT)
