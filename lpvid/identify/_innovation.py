"""Innovation gain and covariance from the projected data of a fit."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid._linalg import discrete_riccati
from lpvid._results import Status
from lpvid.identify._realise import spectral_radius
from lpvid.models import StateSpace

# Added to the output noise's covariance, in units of the outputs' power: records without noise.
_LEAST_NOISE = 1e-14


class InnovationModel(eqx.Module):
    r"""Noise model in innovation form, $x_+ = A x + B u + K e$, $y = C x + D u + e$.

    Attributes:
        gain: K; A − K C is stable unless `status` is `no_stable_gain`. Zero there, where the
            Riccati equation has no stabilising solution, and where no gain is better than none.
        covariance: of the innovations e, one step ahead.
        status: `successful`, or `no_stable_gain`.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastOutputMOESP, identify
        >>> u, e = np.random.default_rng(0).standard_normal((2, 5000))
        >>> x = np.zeros(5001)
        >>> for k in range(5000):
        ...     x[k + 1] = 0.8 * x[k] + u[k] + 0.5 * e[k]
        >>> fit = identify(IOData(u=u, y=x[:-1] + e, dt=0.1), PastOutputMOESP(1, 10))
        >>> gain = fit.model.C @ fit.innovation.gain
        >>> bool(abs(gain - 0.5) < 0.05), bool(abs(fit.innovation.covariance - 1.0) < 0.05)
        (True, True)
    """

    gain: Float[Array, "nx ny"]
    covariance: Float[Array, "ny ny"]
    status: Status


class Projections(eqx.Module):
    """Future inputs and outputs in the orthonormal coordinates of the data factor.

    Attributes:
        inputs: future inputs on themselves.
        outputs_inputs: future outputs on the future inputs.
        outputs_instruments: future outputs on the past.
        outputs_now: future outputs on the first future output's own part.
    """

    inputs: Float[Array, "future_inputs future_inputs"]
    outputs_inputs: Float[Array, "future_outputs future_inputs"]
    outputs_instruments: Float[Array, "future_outputs instruments"]
    outputs_now: Float[Array, "future_outputs ny"]


def innovation(
    model: StateSpace, data: Projections, columns: int, simulated: Float[Array, " ny"]
) -> InnovationModel:
    """K from the state sequences of two successive projections (Van Overschee and De Moor 1996).

    Projected on past and future inputs, past outputs (and, one sample later, the present ones),
    the future outputs are Γ X + H U with X a Kalman filter's states. With B and D known from the
    simulation error H is known, X follows by least squares, and the residuals of the state
    equations have the covariances Q, R, S, from which the Riccati equation gives the steady gain.
    The filter has seen `block_rows` samples: K is biased by about the powers of A − K C after so
    many. Where that leaves it worse than no gain at all (lightly damped systems with white output
    noise), the gain is zero and the covariance that of the simulation error.

    Args:
        model: of the scaled channels.
        data: of the same channels.
        columns: of the data matrix; corrects the covariance for the regression on the past.
        simulated: variance of each output's simulation error.
    """
    A, B, C, D = model.A, model.B, model.C, model.D
    ny, nu = D.shape
    block_rows = data.outputs_inputs.shape[0] // ny
    rows = [C]
    for _ in range(block_rows - 1):
        rows.append(rows[-1] @ A)
    observability = jnp.concatenate(rows)
    markov = jnp.concatenate([D[None], jnp.stack(rows)[:-1] @ B[None], jnp.zeros((1, ny, nu))])
    i, j = np.arange(block_rows)[:, None], np.arange(block_rows)[None, :]
    toeplitz = markov[np.where(i >= j, i - j, block_rows)].transpose(0, 2, 1, 3)
    toeplitz = toeplitz.reshape(block_rows * ny, block_rows * nu)

    free = data.outputs_inputs - toeplitz @ data.inputs
    known = data.inputs.shape[0] + data.outputs_instruments.shape[1]
    now = data.outputs_now * np.sqrt(columns / max(columns - known, 1))
    nothing = jnp.zeros_like(now)
    state = jnp.linalg.lstsq(
        observability, jnp.concatenate([free, data.outputs_instruments, nothing], axis=1)
    )[0]
    # One sample later the present input and output are past; H only loses its first block column.
    later = data.outputs_inputs[ny:] - toeplitz[:-ny, :-nu] @ data.inputs[nu:]
    following = jnp.linalg.lstsq(
        observability[:-ny], jnp.concatenate([later, data.outputs_instruments[ny:], now[ny:]], 1)
    )[0]
    present = jnp.pad(data.inputs[:nu], ((0, 0), (0, state.shape[1] - data.inputs.shape[1])))
    output = jnp.concatenate(
        [data.outputs_inputs[:ny], data.outputs_instruments[:ny], now[:ny]], axis=1
    )
    state_noise = following - A @ state - B @ present
    output_noise = output - C @ state - D @ present
    R = output_noise @ output_noise.T + _LEAST_NOISE * jnp.eye(ny)
    Q, S = state_noise @ state_noise.T, state_noise @ output_noise.T
    P = discrete_riccati(A, C, Q, R, S)
    covariance = C @ P @ C.T + R
    gain = jnp.linalg.solve(covariance, (A @ P @ C.T + S).T).T
    # NaN where the Riccati equation has no stabilising solution.
    sound = spectral_radius(A - gain @ C) < 1.0
    useless = (spectral_radius(A) < 1.0) & (jnp.sum(simulated) <= jnp.trace(covariance))
    ratio = jnp.sqrt(simulated / jnp.diagonal(R))
    covariance = jnp.where(sound, covariance, R)
    return InnovationModel(
        gain=jnp.where(sound & ~useless, gain, 0.0),
        covariance=jnp.where(useless, R * ratio[:, None] * ratio[None], covariance),
        status=Status.where(sound | useless, Status.successful, Status.no_stable_gain),
    )
