"""Is the residual white, and is it free of the inputs? Tests with bands and p-values."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load when first used
from jaxtyping import Array, Float

from lpvid.analysis._predict import Numbers

# Longest autoregression that the residual's spectrum is estimated by.
_LONGEST_MODEL = 40
# Share of the largest eigenvalue below which a combination of lags has no variance: an input such
# as a few sines moves only in so many directions.
_RANK_TOLERANCE = 1e-8


class ResidualTests(eqx.Module):
    """Outcome of `residual_tests`; `print` shows it as a table.

    Attributes:
        lags: 1 … L.
        autocorrelation: of each output's residual at these lags, (lag, ny).
        autocorrelation_band: half-width that holds `level` of white residuals, (lag,).
        whiteness_p: p-value of each output's portmanteau (Ljung-Box), (ny,).
        joint_whiteness_p: p-value of all auto- and cross-correlations between outputs together.
        cross_lags: −L … L.
        cross_correlation: between residual and inputs, e(t) with u(t − lag), (2L + 1, ny, nu).
        cross_band: half-width that holds `level` where residual and input are independent,
            whatever the colour of either, (2L + 1, ny, nu).
        dynamics_p: p-value for lags 0 … L, (ny, nu). Small: dynamics from this input are missing
            or wrong.
        feedback_p: p-value for lags −L … −1, (ny, nu). Small: the input answers to the output
            (feedback), or the model is late.
        level: probability that the bands hold.
        input_names: one for each input.
        output_names: one for each output.
    """

    lags: Float[Array, " lag"]
    autocorrelation: Float[Array, "lag ny"]
    autocorrelation_band: Float[Array, " lag"]
    whiteness_p: Float[Array, " ny"]
    joint_whiteness_p: Float[Array, ""]
    cross_lags: Float[Array, " cross_lag"]
    cross_correlation: Float[Array, "cross_lag ny nu"]
    cross_band: Float[Array, "cross_lag ny nu"]
    dynamics_p: Float[Array, "ny nu"]
    feedback_p: Float[Array, "ny nu"]
    level: float = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)

    def rows(self) -> list[dict[str, str | float]]:
        """One mapping for each test: `test`, `output`, `input`, `p` and `outside_band`.

        `outside_band` is the share of the lags outside their band, about 1 − `level` by chance.
        """
        outside = np.abs(self.autocorrelation) > np.asarray(self.autocorrelation_band)[:, None]
        rows = []
        for k, output in enumerate(self.output_names):
            names = {"test": "whiteness", "output": output, "input": ""}
            shares = {"p": float(self.whiteness_p[k]), "outside_band": outside[:, k].mean().item()}
            rows.append(names | shares)
        if len(self.output_names) > 1:
            names = {"test": "joint whiteness", "output": "all", "input": ""}
            shares = {"p": float(self.joint_whiteness_p), "outside_band": outside.mean().item()}
            rows.append(names | shares)
        crossed = np.abs(self.cross_correlation) > np.asarray(self.cross_band)
        middle = len(self.lags)
        for test, p, part in (
            ("dynamics", self.dynamics_p, crossed[middle:]),
            ("feedback", self.feedback_p, crossed[:middle]),
        ):
            for k, output in enumerate(self.output_names):
                for j, source in enumerate(self.input_names):
                    names = {"test": test, "output": output, "input": source}
                    shares = {"p": float(p[k, j]), "outside_band": part[:, k, j].mean().item()}
                    rows.append(names | shares)
        return rows

    def table(self) -> str:
        """The rows as text; p-values below 1 − `level` are marked by a star."""
        lines = [("test", "output", "input", "p-value", "", "outside band")]
        for row in self.rows():
            p = float(row["p"])
            value = "< 0.0001" if p < 1e-4 else f"{p:.4f}"
            share = f"{100.0 * float(row['outside_band']):.1f} %"
            star = "*" if p < 1.0 - self.level else ""
            test, output, source = (str(row[name]) for name in ("test", "output", "input"))
            lines.append((test, output, source, value, star, share))
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
            for line in lines
        )

    def __str__(self) -> str:
        return self.table()


def residual_tests(
    residual: Numbers,
    u: Numbers | None = None,
    *,
    lengths: Sequence[int] | None = None,
    lags: int | None = None,
    level: float = 0.95,
    noise_parameters: float | int = 0,
    model_parameters: float | int = 0,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> ResidualTests:
    r"""Test a residual for whiteness and for independence of the inputs.

    **Whiteness.** $Q = N(N+2)\sum_{k=1}^{L} \mathrm{tr}(R_k^T R_0^{-1} R_k R_0^{-1})/n_k$ with
    $n_k$ the pairs of samples k apart in one record, against $\chi^2$: per output that of Ljung and
    Box (Biometrika 65 (1978) 297-303), jointly that of Hosking (J. Am. Stat. Assoc. 75 (1980)
    602-608). Innovations of a good noise model are white. The residual of an output-error model is
    as coloured as the noise: there only the tests against the inputs judge the model.

    **Inputs.** Given u, $\sum_t e(t) u(t-\tau)$ has the covariance
    $\sum_s R_{ee}(s) R_{uu}(s + \tau_1 - \tau_2)$ over lags (L. Ljung, System Identification, 2nd
    ed. (1999), section 16.6), so bands and p-values hold for coloured residuals and inputs alike.
    $R_{ee}$ is that of an autoregression of the residual whose order the Bayesian criterion
    chooses, and $R_{uu}$ that of the record.

    **Degrees of freedom.** Parameters fitted to the same record take correlation out of the
    residual. What they took is subtracted from the degrees of freedom, shared evenly by the tests:
    `noise_parameters` from whiteness (ny² L), `model_parameters` from lags 0 … L of the inputs
    (ny nu (L + 1) for rich inputs). That counts them in full, which is right where L covers the
    memory of the model (a finite impulse response, well damped modes) and rejects too much where it
    does not (for lightly damped modes 11 % at a level of 5 %; 4 % without the correction): there
    leave it at zero, which errs towards accepting. On a record that took no part in the fit both
    are zero and the level is exact for long records. Lags below zero are never corrected.

    Plain NumPy, not for `jit`: the autoregression's order is chosen by looking at the values.

    Args:
        residual: measured less predicted output, (time, ny) or (time,), records one after another.
        u: inputs, (time, nu) or (time,); without them whiteness alone is tested.
        lengths: samples of each record; one record by default. No product crosses a boundary.
        lags: L, by default 25, but at most a quarter of the shortest record.
        level: probability that the bands hold, lag by lag.
        noise_parameters: free parameters of the noise model, nx ny for an innovation gain (up to
            2 nx ny where the noise rather than the input settles A).
        model_parameters: free parameters from inputs to outputs, nx (nu + ny) + ny nu for a black
            box with D.
        input_names: u1, u2, … by default.
        output_names: y1, y2, … by default.

    Returns:
        Correlations, bands and p-values.

    Raises:
        ValueError: shapes, lengths or names that do not fit, non-finite samples, a residual or
            input that is constant, too many lags, or fewer lags than parameters.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import residual_tests
        >>> rng = np.random.default_rng(1)
        >>> u, noise = rng.standard_normal((2, 500))
        >>> forgotten = 0.3 * np.roll(u, 2)
        >>> print(residual_tests(noise + forgotten, u, lags=10))
        test       output  input  p-value      outside band
        whiteness  y1             0.9291       0.0 %
        dynamics   y1      u1     < 0.0001  *  9.1 %
        feedback   y1      u1     0.9190       0.0 %
    """
    e = _signal(residual, "residual")
    n_samples, ny = e.shape
    inputs = np.zeros((n_samples, 0)) if u is None else _signal(u, "u")
    if inputs.shape[0] != n_samples:
        raise ValueError(
            f"u has {inputs.shape[0]} samples, residual {n_samples}; give both over the same time."
        )
    records = (n_samples,) if lengths is None else tuple(int(n) for n in lengths)
    if sum(records) != n_samples or min(records) < 1:
        raise ValueError(f"lengths: {records} do not add up to the {n_samples} samples.")
    count = _checked_lags(lags, records)
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level}; give a probability between 0 and 1 such as 0.95.")
    outputs = _names(output_names, ny, "y", "output_names")
    sources = _names(input_names, inputs.shape[1], "u", "input_names")
    e, inputs = _centred(e, "residual", outputs), _centred(inputs, "u", sources)

    pairs = np.array([sum(max(n - k, 0) for n in records) for k in range(count + 1)], float)
    auto = _correlations(e, e, records, count)[count:]
    own = np.diagonal(auto, axis1=1, axis2=2) / np.diagonal(auto[0])[None]
    # Mean square of a white signal's sample autocorrelation, exact for normal samples.
    spread = pairs[1:] / (n_samples * (n_samples + 2.0))
    share = noise_parameters / ny**2
    own_p = _p_value(np.sum(own[1:] ** 2 / spread[:, None], axis=0), count - share)
    halves = np.linalg.cholesky(auto[0])
    half_white = np.linalg.solve(halves[None], auto[1:])
    white = np.linalg.solve(halves[None], half_white.transpose(0, 2, 1))
    joint = np.sum(white**2 / spread[:, None, None])
    joint_p = _p_value(joint, ny**2 * count - noise_parameters)

    quantile = math.sqrt(2.0) * float(scipy.special.erfinv(level))
    cross, deviation, causal_p, other_p = _against_inputs(
        e, inputs, records, count, model_parameters
    )
    return ResidualTests(
        lags=jnp.arange(1.0, count + 1.0),
        autocorrelation=jnp.asarray(own[1:]),
        autocorrelation_band=jnp.asarray(quantile * np.sqrt(spread)),
        whiteness_p=jnp.asarray(own_p),
        joint_whiteness_p=jnp.asarray(joint_p),
        cross_lags=jnp.arange(-float(count), count + 1.0),
        cross_correlation=jnp.asarray(cross),
        cross_band=jnp.asarray(quantile * deviation),
        dynamics_p=jnp.asarray(causal_p),
        feedback_p=jnp.asarray(other_p),
        level=float(level),
        input_names=sources,
        output_names=outputs,
    )


def _against_inputs(e, inputs, records, count, model_parameters):
    """Correlations with the inputs, their standard deviations, p-values of lags ≥ 0 and < 0."""
    ny, nu = e.shape[1], inputs.shape[1]
    size = np.sqrt(np.sum(e**2, axis=0)[:, None] * np.sum(inputs**2, axis=0)[None])
    cross = _correlations(e, inputs, records, count) / size[None]
    deviation = np.zeros_like(cross)
    causal_p, other_p = np.ones((2, ny, nu))
    fitted = model_parameters / (ny * max(nu, 1))
    for k in range(ny):
        power = np.mean(e[:, k] ** 2)
        colour = power * _autoregressive_correlation(e[:, k], records, max(records))
        for j in range(nu):
            covariance = _lag_covariance(colour, inputs[:, j], records, count) / size[k, j] ** 2
            deviation[:, k, j] = np.sqrt(np.diagonal(covariance))
            ahead, behind = slice(count, None), slice(0, count)
            causal_p[k, j] = _quadratic_p(cross[ahead, k, j], covariance[ahead, ahead], fitted)
            other_p[k, j] = _quadratic_p(cross[behind, k, j], covariance[behind, behind], 0)
    return cross, deviation, causal_p, other_p


def _lag_covariance(colour, signal, records, count: int) -> np.ndarray:
    """Covariance over lags −count … count of Σ_t e(t) u(t − lag), u given, e of a known colour.

    Exact for records of any length: u is taken for zero outside its record, as in the sums.
    """
    lags = np.arange(-count, count + 1)
    means = sum(_shifted(record, lags).sum(axis=0) for record in _parts(signal, records))
    means = means / signal.size
    total = np.zeros((lags.size, lags.size))
    crossed = np.zeros(lags.size)
    for record in _parts(signal, records):
        n = record.size
        kernel = np.concatenate([colour[n - 1 : 0 : -1], colour[:n]])[:, None]
        # Some lags at a time, so that long records do not fill the memory.
        step = max(1, 2**21 // n)
        for first in range(0, lags.size, step):
            some = slice(first, first + step)
            # Without the mean, which the residual has lost too.
            columns = _shifted(record, lags[some]) - means[some]
            coloured = scipy.signal.fftconvolve(columns, kernel, mode="full", axes=0)
            coloured = coloured[n - 1 : 2 * n - 1]
            total[some] += _correlations(coloured, record[:, None], (n,), count)[:, :, 0].T
            crossed[some] += coloured.sum(axis=0)
    total -= crossed[:, None] * means[None]
    return 0.5 * (total + total.T)


def _parts(signal: np.ndarray, records) -> list[np.ndarray]:
    return np.split(signal, np.cumsum(records)[:-1])


def _shifted(record: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """u(t − lag) in columns, zero outside the record."""
    at = np.arange(record.size)[:, None] - lags[None]
    inside = (at >= 0) & (at < record.size)
    return np.where(inside, record[np.clip(at, 0, record.size - 1)], 0.0)


def _quadratic_p(values: np.ndarray, covariance: np.ndarray, fitted: float | int) -> float:
    """p-value of zero-mean values with a covariance that may be singular."""
    eigenvalues, vectors = np.linalg.eigh(covariance)
    kept = eigenvalues > _RANK_TOLERANCE * eigenvalues[-1]
    turned = vectors[:, kept].T @ values
    return float(_p_value(np.sum(turned**2 / eigenvalues[kept]), np.sum(kept) - fitted))


def _p_value(statistic, freedom):
    if freedom <= 0:
        raise ValueError(
            "lags: the parameters taken off leave no degree of freedom; test more lags, or test on "
            "a record that took no part in the fit (noise_parameters=0, model_parameters=0)."
        )
    return scipy.special.gammaincc(freedom / 2.0, np.asarray(statistic) / 2.0)


def _correlations(left, right, records, count: int) -> np.ndarray:
    """Σ_t left(t) right(t − lag) within records, (2 count + 1, left channel, right channel)."""
    total = np.zeros((2 * count + 1, left.shape[1], right.shape[1]))
    for one, other in zip(_parts(left, records), _parts(right, records), strict=True):
        size = scipy.fft.next_fast_len(one.shape[0] + count, real=True)
        a = scipy.fft.rfft(one, size, axis=0)
        b = scipy.fft.rfft(other, size, axis=0)
        sums = scipy.fft.irfft(a[:, :, None] * b.conj()[:, None, :], size, axis=0)
        total += np.concatenate([sums[size - count :], sums[: count + 1]])
    return total


def _autoregressive_correlation(signal: np.ndarray, records, count: int) -> np.ndarray:
    """Autocorrelation 0 … count − 1 of the autoregression that describes a signal best.

    Burg's method, which unlike Yule and Walker's does not fill the valleys of a coloured spectrum;
    the Bayesian criterion chooses the order. A white signal gives order zero, hence the plain bands
    ±z/√N.
    """
    longest = min(_LONGEST_MODEL, signal.size // 20, min(records) - 1)
    forward = _parts(signal, records)
    backward = forward
    rho, weights, power = np.ones(1), np.zeros(0), 1.0
    best, chosen = 0.0, (rho, weights)
    for order in range(1, longest + 1):
        pairs = [(f[1:], b[:-1]) for f, b in zip(forward, backward, strict=True)]
        squares = sum(float(f @ f + b @ b) for f, b in pairs)
        if squares <= 1e-24 * float(signal @ signal):
            break
        reflection = 2.0 * sum(float(f @ b) for f, b in pairs) / squares
        rho = np.append(rho, reflection * power + weights @ rho[:0:-1])
        weights = np.append(weights - reflection * weights[::-1], reflection)
        power *= 1.0 - reflection**2
        if power <= 1e-12:
            break
        forward = [f - reflection * b for f, b in pairs]
        backward = [b - reflection * f for f, b in pairs]
        score = signal.size * math.log(power) + order * math.log(signal.size)
        if score < best:
            best, chosen = score, (rho, weights)
    rho, weights = chosen
    order = weights.size
    found = np.zeros(max(count, order + 1))
    found[: order + 1] = rho
    if order:
        # Beyond its order the autocorrelation is the free response of the autoregression.
        filter_ = np.append(1.0, -weights)
        start = scipy.signal.lfiltic([1.0], filter_, rho[:0:-1])
        rest = np.zeros(found.size - order - 1)
        found[order + 1 :] = scipy.signal.lfilter([1.0], filter_, rest, zi=start)[0]
    return found[:count]


def _signal(values: Numbers, name: str) -> np.ndarray:
    array = np.asarray(values, float)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] == 0:
        raise ValueError(
            f"{name} has shape {np.shape(values)}; give (time,) or (time, channel), records one "
            "after another with their lengths."
        )
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} holds NaN or infinity; look for a diverged simulation.")
    return array


def _centred(signal: np.ndarray, name: str, channels: tuple[str, ...]) -> np.ndarray:
    centred = signal - signal.mean(axis=0)
    still = np.ptp(signal, axis=0) <= 1e-13 * np.abs(signal).max(axis=0, initial=0.0)
    for channel in np.flatnonzero(still):
        raise ValueError(
            f"{name}: {channels[channel]} is constant, so it has no correlations; leave it out."
        )
    return centred


def _checked_lags(lags: int | None, records: tuple[int, ...]) -> int:
    largest = min(records) // 4
    if largest < 1:
        raise ValueError(f"lengths: a record of {min(records)} samples is too short to test.")
    count = min(25, largest) if lags is None else int(lags)
    if not 1 <= count <= largest:
        raise ValueError(
            f"lags is {lags}; give at least 1 and at most {largest}, a quarter of the shortest "
            "record."
        )
    return count


def _names(names: Sequence[str] | None, count: int, prefix: str, argument: str) -> tuple[str, ...]:
    if names is None:
        return tuple(f"{prefix}{i + 1}" for i in range(count))
    if len(names) != count:
        raise ValueError(f"{argument}: {len(names)} given for {count} channels.")
    return tuple(str(name) for name in names)
