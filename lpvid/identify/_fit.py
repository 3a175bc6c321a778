"""What an identification returns."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lpvid._results import Status
from lpvid.identify._innovation import InnovationModel, Projections, innovation
from lpvid.identify._linear_fit import LinearCovariance, covariance
from lpvid.models import StateSpace


class Moments(eqx.Module):
    """What noise model and covariances are worked out from, when they are asked for.

    Attributes:
        scale: RMS of every channel, by which it was divided.
        projections: of the data, for a method with past outputs; else `None`.
        normal_matrix: matrix of the normal equations of B, D and x0, by window and output.
        firsts: which windows start a record, where the state is freed within records; `None` where
            every window is a record.
        columns: of the data matrix.
        dilution: samples over samples less unknowns, by which a residual's variance is too small.
        feedthrough: whether D was estimated.
        offset: whether the offset was estimated.
    """

    scale: Float[Array, " channel"]
    projections: Projections | None
    normal_matrix: Float[Array, "window ny entry entry"]
    firsts: Int[Array, " record"] | None
    columns: int = eqx.field(static=True)
    dilution: float = eqx.field(static=True)
    feedthrough: bool = eqx.field(static=True)
    offset: bool = eqx.field(static=True)


class StandardDeviations(eqx.Module):
    """Standard deviations of what is estimated by least squares once A and C are known.

    Attributes:
        B: as the model's.
        D: as the model's; zero where it is not estimated.
        output_offset: of each output; zero where it is not estimated.
        x0: of every record.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastInputMOESP, identify
        >>> u, e = np.random.default_rng(0).standard_normal((2, 500))
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500] + 0.1 * e
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), PastInputMOESP(order=1, block_rows=5))
        >>> round(fit.standard_deviations.D.item(), 3)
        0.004
    """

    B: Float[Array, "nx nu"]
    D: Float[Array, "ny nu"]
    output_offset: Float[Array, " ny"]
    x0: Float[Array, "record nx"]


class Fit(eqx.Module):
    """Result of `identify`.

    Noise model and covariances are worked out when they are asked for. Fits made under `jax.vmap`
    are read under `jax.vmap`: `jax.vmap(lambda fit: fit.innovation_gain)(fits)`.

    Attributes:
        model: the discrete-time model, its `dt` that of the data.
        x0: initial state of every record, (record, nx).
        singular_values: of the projected data, largest first, (block_rows ny,), for channels of
            unit RMS and independent of the number of samples.
        order: number of states.
        status: how it ended.
        stats: arrays by name: `spectral_radius` of A as returned, `eigenvalues_moved` by
            stabilisation, `excitation_rank` (full is 2 block_rows nu), `excitation_pivot` (share of
            an input row, in squares, that the other inputs do not explain: the reciprocal
            condition of the excitation), `smallest_pivot` (the same with the past outputs),
            `reflections` (whether the Gram matrix gave way to Householder reflections),
            `residual_std` of each output's simulation error, (ny,), `window` (samples after which
            the state was freed anew because the model is unstable; 0: never).
        output_offset: constant to add to the model's output, (ny,); zero unless the method
            estimates it (`offset=True`); `None` in fits that `identify` did not make.
        moments: what noise model and covariances come from; `None` in fits that `identify` did not
            make, which have neither.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastOutputMOESP, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), PastOutputMOESP(order=1, block_rows=5))
        >>> fit.order, fit.x0.shape, round(fit.stats["spectral_radius"].item(), 3)
        (1, (1, 1), 0.8)
        >>> fit.route
        'Householder reflections, since the Gram matrix was too ill-conditioned'
    """

    model: StateSpace
    x0: Float[Array, "record nx"]
    singular_values: Float[Array, " row"]
    order: int = eqx.field(static=True)
    status: Status
    stats: dict[str, Array]
    output_offset: Float[Array, " ny"] | None = None
    moments: Moments | None = None

    @property
    def innovation(self) -> InnovationModel | None:
        """Noise model of a method with past outputs (PO-MOESP, N4SID, CVA); else `None`.

        Its `status` says whether the Riccati equation had a stabilising solution.
        """
        if self.moments is None or self.moments.projections is None:
            return None
        return _innovation(self.model, self.moments, self.stats["residual_std"])

    @property
    def innovation_gain(self) -> Float[Array, "nx ny"] | None:
        """K of the innovation form; `None` for PI-MOESP and ORSE.

        A − K C is stable unless `innovation.status` is `no_stable_gain`: the Riccati equation has
        no stabilising solution there, and K is zero.
        """
        found = self.innovation
        return None if found is None else found.gain

    @property
    def innovation_covariance(self) -> Float[Array, "ny ny"] | None:
        """Covariance of the one-step prediction errors; `None` for PI-MOESP and ORSE."""
        found = self.innovation
        return None if found is None else found.covariance

    @property
    def covariance(self) -> Float[Array, "unknown unknown"]:
        """Covariance of [B column by column, D row by row, output offset].

        D and the offset only where the method estimates them. For the given A and C (whose own
        errors are not in it), and simulation errors that are white and independent between
        outputs; for other noise it may be too small or too large. There
        `lpvid.refine(...).robust_covariance` holds.
        """
        return self._linear()[1].shared

    @property
    def standard_deviations(self) -> StandardDeviations:
        """Standard deviations of B, D, the offset and the initial states, as for `covariance`."""
        moments, found = self._linear()
        ny, nu = self.model.D.shape
        spread = jnp.sqrt(jnp.maximum(jnp.diagonal(found.shared), 0.0))
        n_b, n_d = self.order * nu, ny * nu if moments.feedthrough else 0
        starts = found.x0 if moments.firsts is None else found.x0[moments.firsts]
        return StandardDeviations(
            B=spread[:n_b].reshape(nu, self.order).T,
            D=spread[n_b : n_b + n_d].reshape(ny, nu) if n_d else jnp.zeros((ny, nu)),
            output_offset=spread[n_b + n_d :] if moments.offset else jnp.zeros(ny),
            x0=jnp.sqrt(jnp.maximum(jnp.diagonal(starts, axis1=1, axis2=2), 0.0)),
        )

    def _linear(self) -> tuple[Moments, LinearCovariance]:
        if self.moments is None:
            raise ValueError("covariance: only a Fit that identify made has one.")
        found = _covariance(self.moments, self.stats["residual_std"], self.order)
        return self.moments, found

    @property
    def route(self) -> str:
        """How the data were factored, in words; for fits that `identify` made."""
        if "reflections" not in self.stats:
            raise ValueError("route: only a Fit that identify made has one.")
        if bool(self.stats["reflections"]):
            return "Householder reflections, since the Gram matrix was too ill-conditioned"
        return "Cholesky factor of the structured Gram matrix"

    def describe(self) -> str:
        """What was done and found, in a few lines.

        Example:
            >>> import numpy as np
            >>> from lpvid.data import IOData
            >>> from lpvid.identify import PastInputMOESP, identify
            >>> u, e = np.random.default_rng(0).standard_normal((2, 500))
            >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500] + 0.1 * e
            >>> fit = identify(IOData(u=u, y=y, dt=0.1), PastInputMOESP(order=1, block_rows=5))
            >>> print(fit.describe())
            Successful.
            Order 1; next singular value 0.0... of the last one kept.
            Data matrix: Cholesky factor of the structured Gram matrix; reciprocal condition ...
            Excitation: rank 10, reciprocal condition ...
            Largest pole modulus 0.79...; simulation error y1: 0.09...
        """
        stats = {name: np.asarray(value) for name, value in self.stats.items()}
        values = np.asarray(self.singular_values)
        kept, left = values[self.order - 1], values[min(self.order, values.size - 1)]
        errors = ", ".join(
            f"y{k + 1}: {error:.4g}" for k, error in enumerate(np.atleast_1d(stats["residual_std"]))
        )
        return "\n".join(
            [
                Status[self.status],
                f"Order {self.order}; next singular value "
                f"{left / max(kept, np.finfo(float).tiny):.3g} of the last one kept.",
                f"Data matrix: {self.route}; reciprocal condition {stats['smallest_pivot']:.2g}.",
                f"Excitation: rank {stats['excitation_rank']}, reciprocal condition "
                f"{stats['excitation_pivot']:.2g}.",
                f"Largest pole modulus {stats['spectral_radius']:.6g}; simulation error {errors}",
            ]
        )


@jax.jit
def _innovation(model: StateSpace, moments: Moments, residual_std: Array) -> InnovationModel:
    nu = model.B.shape[1]
    u_scale, y_scale = moments.scale[:nu], moments.scale[nu:]
    scaled = StateSpace(
        model.A,
        model.B * u_scale[None],
        model.C / y_scale[:, None],
        model.D * u_scale[None] / y_scale[:, None],
        model.dt,
    )
    assert moments.projections is not None
    simulated = (residual_std / y_scale) ** 2 * moments.dilution
    found = innovation(scaled, moments.projections, moments.columns, simulated)
    return InnovationModel(
        gain=found.gain / y_scale[None],
        covariance=found.covariance * y_scale[:, None] * y_scale[None],
        status=found.status,
    )


@eqx.filter_jit
def _covariance(moments: Moments, residual_std: Array, nx: int) -> LinearCovariance:
    ny = residual_std.shape[0]
    u_scale, y_scale = moments.scale[:-ny], moments.scale[-ny:]
    variance = (residual_std / y_scale) ** 2 * moments.dilution
    found = covariance(
        moments.normal_matrix,
        variance,
        nx=nx,
        feedthrough=moments.feedthrough,
        offset=moments.offset,
    )
    units = [jnp.repeat(1.0 / u_scale, nx)]
    if moments.feedthrough:
        units.append((y_scale[:, None] / u_scale[None]).reshape(-1))
    if moments.offset:
        units.append(y_scale)
    unit = jnp.concatenate(units)
    return LinearCovariance(found.shared * unit[:, None] * unit[None], found.x0)
