"""The published algorithms: Ho and Kalman's realisation of the moments (003)."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lpvid.identify.step._method import AbstractStepMethod, Experiments, Realisation
from lpvid.identify.step._moments import Integration, divide_series, moment_weights
from lpvid.models import StateSpace

# Moments grow with powers of time: beyond this order no record in double precision carries them.
_LARGEST_ORDER = 20


class _MomentMethod(AbstractStepMethod):
    """What the method and its dual share: they differ in which factor gives A."""

    dual: eqx.AbstractClassVar[bool]
    integration: Integration = eqx.field(static=True, default="smooth")

    def __check_init__(self):
        if self.integration not in ("smooth", "held"):
            raise ValueError(f'integration={self.integration!r}: give "smooth" or "held".')

    def largest_order(self, ny: int, nu: int, time: int) -> int:
        """Largest order that double precision carries."""
        del ny, nu, time
        return _LARGEST_ORDER

    def realise(self, experiments: Experiments, order: int) -> Realisation:
        """The continuous-time model of `order` states."""
        return _realise(experiments, order=order, integration=self.integration, dual=self.dual)


class PrimalRealisation(_MomentMethod):
    r"""The published method (003, equations 5 to 25): A from the observability matrix.

    $U(t) = [u_1 … ] [u_1(∞) …]^{-1}$, p_0 likewise from the outputs, ρ_0 = p_0(∞),
    $p_i(t) = ∫_0^t (p_{i-1} - ρ_{i-1} U) dτ$, ρ_i = p_i(∞), which are −C A^{-(i+1)} B. Their block
    Hankel matrix factors into $O C_o$, $\hat A = O_d^† O_u$, $\hat B = \hat A C_o(:, 1:nu)$,
    $\hat C = -O(1:ny, :) \hat A$, $\hat D = ρ_0 + \hat C \hat A^{-1} \hat B$. α_y is the integer in
    [n/ny + 1, n/ny + 2), α_u the one in [n/nu, n/nu + 1).

    Exact where the records are free of noise. The weights τ^i of the moments make it sensitive:
    output noise of a thousandth destroys a model of order 5; `DeviationSubspace` is for such data.
    A reduced order keeps the low frequencies, and may come out unstable.

    Args:
        integration: "smooth": integrals over signals that are smooth after the onset of the inputs
            (steps at the onset, filtered steps), with an error of order eight in the sample time.
            "held": for inputs held between samples that move in any way; sums that are exact for
            the discrete-time model, which is then converted to continuous time. At full order the
            two agree; at a reduced order they are different approximations.

    Raises:
        ValueError: another integration.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PrimalRealisation, identify_step_response
        >>> t = 0.01 * np.arange(2000)
        >>> data = IOData(u=2.0 * np.ones(2000), y=2.0 - 2.0 * np.exp(-3.0 * t), dt=0.01)
        >>> fit = identify_step_response(data, order=1, method=PrimalRealisation())
        >>> round(fit.model.A.item(), 6)
        -3.0
    """

    dual = False


class DualRealisation(_MomentMethod):
    r"""The published method's dual (003, section 2.4): A from the controllability matrix.

    As `PrimalRealisation`, but $\hat A = C_u C_d^†$ from the factor $C_o$, with α_u the integer in
    [n/nu + 1, n/nu + 2) and α_y the one in [n/ny, n/ny + 1). At full order the two agree.

    Args:
        integration: as for `PrimalRealisation`.

    Raises:
        ValueError: another integration.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import DualRealisation, identify_step_response
        >>> t = 0.01 * np.arange(2000)
        >>> data = IOData(u=2.0 * np.ones(2000), y=2.0 - 2.0 * np.exp(-3.0 * t), dt=0.01)
        >>> fit = identify_step_response(data, order=1, method=DualRealisation())
        >>> round(fit.model.dc_gain().item(), 6)
        1.0
    """

    dual = True


def block_counts(order: int, ny: int, nu: int, dual: bool) -> tuple[int, int]:
    """α_y and α_u: the smallest integers not below n/ny + 1 and n/nu (dual: n/ny, n/nu + 1)."""
    rows, columns = -(-order // ny), -(-order // nu)
    return (rows, columns + 1) if dual else (rows + 1, columns)


@functools.partial(jax.jit, static_argnames=("order", "integration", "dual"))
def _realise(
    experiments: Experiments, *, order: int, integration: Integration, dual: bool
) -> Realisation:
    ny, nu = experiments.y.shape[2], experiments.u.shape[2]
    rows, columns = block_counts(order, ny, nu, dual)
    rho, std = _moments(experiments, rows + columns - 1, integration)
    hankel, spread = (
        jnp.concatenate(
            [jnp.concatenate(list(x[1 + i : 1 + i + columns]), axis=1) for i in range(rows)]
        )
        for x in (rho, std)
    )
    left, values, right = jnp.linalg.svd(hankel, full_matrices=False)
    root = jnp.sqrt(values[:order])
    observability, controllability = left[:, :order] * root[None, :], root[:, None] * right[:order]
    if dual:
        A = controllability[:, :-nu] @ jnp.linalg.pinv(controllability[:, nu:])
    else:
        A = jnp.linalg.pinv(observability[ny:]) @ observability[:-ny]
    B = A @ controllability[:, :nu]
    C = -observability[:ny] @ A
    D = rho[0] + C @ jnp.linalg.solve(A, B)
    if integration == "held":
        # A and B are those of δ = (z − 1)/h.
        h = experiments.dt
        held = StateSpace(jnp.eye(order) + h * A, h * B, C, D, dt=h).to_continuous()
        A, B = held.A, held.B
    floor = jnp.linalg.norm(spread)
    return Realisation(
        A=A,
        B=B,
        C=C,
        D=D,
        moments=rho,
        moments_std=std,
        singular_values=values,
        floor=floor,
        resolved=values[order - 1] > floor,
        poles_moved=jnp.asarray(0),
    )


def _moments(experiments: Experiments, count: int, integration: Integration) -> tuple[Array, Array]:
    """ρ_0 … ρ_count and their standard deviations, (moment, ny, nu)."""
    time = experiments.u.shape[1]
    rho_0 = jnp.einsum("ry,ru->yu", experiments.final_y, experiments.combination)
    behind = jnp.einsum(
        "rta,ru->tau", experiments.final_u[:, None] - experiments.u, experiments.combination
    )
    # e = p_0 − ρ_0 U by differences from the final values, which are zero where all has settled.
    lacking = experiments.y - experiments.final_y[:, None]
    e = jnp.einsum("rty,ru->tyu", lacking, experiments.combination)
    e = e + jnp.einsum("ya,tau->tyu", rho_0, behind)
    # From the settled windows on there is nothing but noise to integrate.
    start = jnp.max(experiments.window)
    weights = moment_weights(count, time, experiments.dt, integration)
    weights = jnp.where((jnp.arange(time) < start)[None, :], weights, 0.0)
    rho = divide_series(
        jnp.einsum("it,tyu->iyu", weights, e), jnp.einsum("it,tau->iau", weights, behind)
    )
    # Noise adds up in squares; rounding, whose signs need not change, in the worst case plainly.
    noise = experiments.noise[:, None] * jnp.linalg.norm(experiments.combination, axis=0)[None, :]
    rounding = jnp.finfo(float).eps * (jnp.max(jnp.abs(e), axis=0) + jnp.abs(rho_0))
    averaged = jnp.sqrt(jnp.min(experiments.lengths - experiments.window).astype(float))
    squares = jnp.sum(weights**2, axis=1) + (jnp.sum(weights, axis=1) / averaged) ** 2
    plain = jnp.sum(jnp.abs(weights), axis=1)
    std = jnp.sqrt(squares)[:, None, None] * noise[None] + plain[:, None, None] * rounding[None]
    std = jnp.concatenate([(noise / averaged + rounding)[None], std])
    return jnp.concatenate([rho_0[None], rho]), std
