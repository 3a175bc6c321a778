"""A method for noisy records: the range of the deviations from the settled response."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from lpvid.identify.step._method import AbstractStepMethod, Experiments, Realisation

# Columns of a Hankel matrix of one record: beyond this they are thinned out.
_MOST_COLUMNS = 8192
# Angle, in radians, by which the fastest pole turns over the shift that A is taken from.
_LARGEST_TURN = 1.0


class DeviationSubspace(AbstractStepMethod):
    r"""Subspace method on deviations from the settled response: for records with noise.

    The weights τ^i of the published moments multiply noise by powers of the record's length. Here
    the same quantity, $e(t) = y(t) - ρ_0 u(t)$ with ρ_0 from means over the settled windows, is
    weighted alike throughout. With $z = x + A^{-1} B u$ it obeys ż = A z + A^{-1} B u̇, e = C z:
    once the inputs have settled it is the free response $C e^{At} z$, with the poles of the plant
    and no feedthrough. So, $h$ the sample time,

    0. What the inputs still lack of their final values is projected out of the rows below, at the
       same delays (nothing for steps; exact for inputs that settle exponentially).
    1. $H_{ij} = e(t_j + i d h)$ for i = 0 … s − 1 and all samples t_j from where the inputs have
       settled to where the outputs have, the records side by side, outputs scaled to unit RMS;
       below it the same with all samples q later. Delays reach over half the settling time, d
       between them. H = [O; O A_q] Z with A_q = e^{A q h} and $O = [C; C A_d; …]$.
    2. H's n dominant left singular vectors, $[U_1; U_2] Σ$, give $A_q = (U_1 Σ)^† U_2 Σ$ and C.
       Two rounds: q = 1 in the first; in the second as many samples, up to d, as turn the fastest
       pole by one radian. A long shift is what noise disturbs least, and there is no aliasing.
    3. Settled records come from a stable plant without poles slower than the record: eigenvalues of
       A_q outside that circle are reflected into it, those on the negative real axis (which no
       continuous-time pole gives) turned to the positive one; A = log(A_q) / (q h).
    4. B and D minimise $\sum \|y - \hat y\|^2$ over all records from rest and all samples, each
       output over its RMS; for inputs held between samples this is exact.

    Memory is that of the records times order and channels.

    Args:
        block_rows: s, the number of delays; s ny is well above the order.

    Raises:
        ValueError: block_rows is not a whole number of 2 or more.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import DeviationSubspace, identify_step_response
        >>> t = 0.01 * np.arange(1000)
        >>> noise = 0.01 * np.random.default_rng(0).standard_normal(1000)
        >>> data = IOData(u=2.0 * np.ones(1000), y=2.0 - 2.0 * np.exp(-3.0 * t) + noise, dt=0.01)
        >>> fit = identify_step_response(data, order=1, method=DeviationSubspace())
        >>> round(fit.model.A.item(), 1), round(fit.model.dc_gain().item(), 2)
        (-3.0, 1.0)
    """

    block_rows: int = eqx.field(static=True)

    def __init__(self, block_rows: int = 40):
        if isinstance(block_rows, bool) or not isinstance(block_rows, int) or block_rows < 2:
            raise ValueError(f"block_rows={block_rows!r}: give a whole number of 2 or more.")
        self.block_rows = block_rows

    def largest_order(self, ny: int, nu: int, time: int) -> int:
        """Half the rows, so that noise can be told from signal."""
        del nu
        return min(self.block_rows * ny // 2, time // 4)

    def realise(self, experiments: Experiments, order: int) -> Realisation:
        """The continuous-time model of `order` states.

        Raises:
            ValueError: the inputs take as long to settle as the outputs (not checked for tracers).
        """
        free = experiments.settling - experiments.inputs_settled
        if not isinstance(free, Tracer) and int(jnp.max(free)) < 4 * order:
            raise ValueError(
                f"The inputs settle only when the outputs do: {max(int(jnp.max(free)), 0)} samples "
                f"of free response are left, and order={order} needs {4 * order} at least. Use "
                f"quicker steps, PrimalRealisation() if there is little noise, or identify()."
            )
        return _realise(experiments, order=order, block_rows=self.block_rows)


@functools.partial(jax.jit, static_argnames=("order", "block_rows"))
def _realise(experiments: Experiments, *, order: int, block_rows: int) -> Realisation:
    h = experiments.dt
    time, nu = experiments.u.shape[1:]
    ny = experiments.y.shape[2]
    rho_0 = jnp.einsum("ry,ru->yu", experiments.final_y, experiments.combination)
    e = experiments.y - jnp.einsum("yu,rtu->rty", rho_0, experiments.u)
    measured = jnp.arange(time)[None, :] < experiments.lengths[:, None]
    e = jnp.where(measured[:, :, None], e, 0.0)
    moving = jnp.arange(time)[None, :] < experiments.settling[:, None]
    power = jnp.sum(jnp.where(moving[:, :, None], e**2, 0.0), axis=(0, 1))
    scale = jnp.sqrt(power / jnp.sum(experiments.settling).astype(float))
    # An output that follows its inputs at once has no deviation but noise, if that.
    least = jnp.maximum(experiments.noise, 1e-9 * jnp.max(jnp.abs(experiments.y), axis=(0, 1)))
    scale = jnp.maximum(scale, jnp.where(least > 0.0, least, 1.0))
    scaled = e / scale[None, None, :]

    span = jnp.max(experiments.settling - experiments.inputs_settled)
    stride = jnp.maximum(span // (2 * block_rows), 1)
    lacking = experiments.u - experiments.final_u[:, None, :]
    reach = jnp.max(jnp.abs(experiments.u), axis=(0, 1))
    # Rounding of a mean is no movement.
    lacking = jnp.where(jnp.abs(lacking) > 1e-12 * reach[None, None, :], lacking, 0.0)
    signals = jnp.concatenate([lacking / reach[None, None, :], scaled], axis=2)

    def take(_, carry):
        A_q, C, values, columns = _shift(
            signals, nu, experiments, order, block_rows, stride, carry[0]
        )
        turn = jnp.max(jnp.abs(jnp.angle(jnp.linalg.eigvals(A_q))))
        turn = jnp.maximum(turn / carry[0].astype(float), _LARGEST_TURN / time)
        longer = jnp.clip(jnp.floor(_LARGEST_TURN / turn).astype(int), 1, stride)
        return longer, carry[0], A_q, C, values, columns

    # Two rounds in a loop, since compiling costs more than running.
    nothing = jnp.zeros((order, order)), jnp.zeros((ny, order)), jnp.zeros(2 * block_rows * ny)
    start = (jnp.asarray(1), jnp.asarray(1), *nothing, jnp.asarray(0))
    _, shift, A_q, C, values, columns = jax.lax.fori_loop(0, 2, take, start)
    A, A_d, poles_moved = _stable(
        A_q, shift.astype(float) * h, h, jnp.max(experiments.lengths).astype(float) * h
    )

    B_d, D = _fit_inputs(experiments, A_d, C, scale, measured)
    C = C * scale[:, None]
    # B_d = A⁻¹ (A_d − I) B
    B = jnp.linalg.solve(A_d - jnp.eye(order), A @ B_d)
    # Norm of a matrix of white noise, with a margin for its Hankel structure.
    noise = jnp.linalg.norm(experiments.noise / scale) / jnp.sqrt(float(ny))
    rows = 2.0 * block_rows * ny
    floor = 1.5 * noise * (jnp.sqrt(columns.astype(float)) + jnp.sqrt(rows))
    floor = jnp.maximum(floor, 1e-7 * values[0])
    averaged = jnp.sqrt(jnp.min(experiments.lengths - experiments.window).astype(float))
    std = experiments.noise[:, None] * jnp.linalg.norm(experiments.combination, axis=0)[None, :]
    return Realisation(
        A=A,
        B=B,
        C=C,
        D=D,
        moments=rho_0[None],
        moments_std=(std / averaged)[None],
        singular_values=values,
        floor=floor,
        resolved=values[order - 1] > floor,
        poles_moved=poles_moved,
    )


def _shift(
    signals: Float[Array, "record time channel"],
    nu: int,
    experiments: Experiments,
    order: int,
    block_rows: int,
    stride: Int[Array, ""],
    shift: Int[Array, ""],
) -> tuple[Array, Array, Array, Array]:
    """A_q and C from the range of the delayed deviations; singular values, number of columns.

    Channels are what the inputs lack of their final values, then the outputs' deviations.
    """
    time, channels = signals.shape[1:]
    ny = channels - nu
    count = min(time, _MOST_COLUMNS)
    delays = jnp.concatenate([jnp.arange(block_rows) * stride] * 2)
    delays = delays.at[block_rows:].add(shift)

    def gram(record):
        signal, first, last, length = record
        last = jnp.maximum(jnp.minimum(last, length - delays[-1]), first + 1)
        thinning = -(-(last - first) // count)
        columns = first + thinning * jnp.arange(count)
        place = jnp.minimum(columns[None, :] + delays[:, None], time - 1)
        rows = jnp.where((columns < last)[None, :, None], signal[place], 0.0)
        rows = rows.transpose(2, 0, 1)
        inputs = rows[:nu].reshape(nu * 2 * block_rows, count)
        # Block rows by delay, all outputs of one together: shifts act on whole blocks.
        outputs = rows[nu:].transpose(1, 0, 2).reshape(2 * block_rows * ny, count)
        rows = jnp.concatenate([inputs, outputs])
        return rows @ rows.T, jnp.sum(columns < last)

    grams, columns = jax.lax.map(
        gram, (signals, experiments.inputs_settled, experiments.settling, experiments.lengths)
    )
    whole = _project_out(jnp.sum(grams, axis=0), 2 * block_rows * nu)
    values, vectors = jnp.linalg.eigh(whole)
    values = jnp.sqrt(jnp.maximum(values[::-1], 0.0))
    range_ = vectors[:, ::-1][:, :order] * values[None, :order]
    upper, lower = range_[: block_rows * ny], range_[block_rows * ny :]
    A_q = jnp.linalg.lstsq(upper, lower)[0]
    return A_q, upper[:ny], values, jnp.sum(columns)


def _project_out(gram: Array, leading: int) -> Array:
    """Gram matrix of the rows after the leading ones, freed of what those explain."""
    diagonal = jnp.diagonal(gram)[:leading]
    size = jnp.where(diagonal > 0.0, jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
    square = gram[:leading, :leading] / (size[:, None] * size[None, :])
    values, vectors = jnp.linalg.eigh(square)
    kept = values > 1e-10 * leading
    turned = vectors.T @ (gram[:leading, leading:] / size[:, None])
    inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
    return gram[leading:, leading:] - turned.T @ (inverse[:, None] * turned)


def _stable(A_q: Array, step: Array, h: float, duration: Array) -> tuple[Array, Array, Array]:
    """A and e^{A h} from A_q = e^{A step}, the poles stable, and how many were moved for it."""
    poles, vectors = jnp.linalg.eig(A_q)
    modulus, angle = jnp.abs(poles), jnp.angle(poles)
    slowest = jnp.exp(-step / duration)
    safe = jnp.maximum(modulus, jnp.finfo(float).tiny)
    inside = jnp.where(modulus > 1.0, 1.0 / safe, safe)
    # What reflection leaves is still a pole that no settled record shows.
    inside = jnp.clip(inside, 1e-12, slowest)
    negative = jnp.abs(angle) > jnp.pi * (1.0 - 1e-9)
    angle = jnp.where(negative, 0.0, angle)
    moved = jnp.sum((inside != modulus) | negative)
    s = jax.lax.complex(jnp.log(inside), angle) / step.astype(complex)

    def from_poles(values):
        return jnp.linalg.solve(vectors.T, (vectors * values[None, :]).T).T.real

    return from_poles(s), from_poles(jnp.exp(s * h)), moved


def _fit_inputs(
    experiments: Experiments, A_d: Array, C: Array, scale: Array, measured: Array
) -> tuple[Array, Array]:
    """B of the discrete-time model and D by least squares, every record from rest."""
    (records, time, nu), (ny, nx) = experiments.u.shape, C.shape

    # A plain recursion compiles in a fraction of what blocked simulation takes.
    def advance(states, u):
        response = jnp.einsum("yx,rxuk->ryuk", C, states)
        entering = u[:, None, :, None] * jnp.eye(nx)[None, :, None, :]
        return jnp.einsum("xz,rzuk->rxuk", A_d, states) + entering, response

    at_rest = jnp.zeros((records, nx, nu, nx))
    _, responses = jax.lax.scan(advance, at_rest, experiments.u.transpose(1, 0, 2))
    dynamic = responses.transpose(1, 0, 2, 3, 4).reshape(records, time, ny, nu * nx)
    direct = experiments.u[:, :, None, None, :] * jnp.eye(ny)[None, None, :, :, None]
    direct = direct.reshape(records, time, ny, ny * nu)
    design = jnp.concatenate([dynamic, direct], axis=3)
    design = jnp.where(measured[:, :, None, None], design, 0.0).reshape(-1, nu * (nx + ny))
    target = experiments.y / scale[None, None, :]
    target = jnp.where(measured[:, :, None], target, 0.0).reshape(-1)
    length = jnp.linalg.norm(design, axis=0)
    length = jnp.where(length > 0.0, length, 1.0)
    Q, R = jnp.linalg.qr(jnp.concatenate([design / length[None, :], target[:, None]], axis=1))
    del Q
    theta = jnp.linalg.lstsq(R[:-1, :-1], R[:-1, -1])[0] / length
    B_d = theta[: nu * nx].reshape(nu, nx).T
    return B_d, theta[nu * nx :].reshape(ny, nu) * scale[:, None]
