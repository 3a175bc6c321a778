"""Records larger than memory, identified a chunk at a time."""

import functools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lpvid.data import IOData
from lpvid.identify._checks import check_varying, constant_channels, require_samples
from lpvid.identify._engine import (
    channel_scale,
    finish,
    range_of_moments,
    range_of_triangle,
    realisation,
    scaled_signals,
)
from lpvid.identify._factor import Layout, Route
from lpvid.identify._gram import (
    HankelMoments,
    empty_triangle,
    extend_triangle,
    lagged_products,
    lower_factor,
)
from lpvid.identify._methods import AbstractSubspaceMethod
from lpvid.identify._simulation_error import (
    NormalEquations,
    block_size,
    continued_equations,
    first_regressors,
    record_equations,
)

# Samples worked on at once, whatever the size of the chunks: one compiled function serves all.
_PIECE = 32_768

Pair = tuple[np.ndarray, np.ndarray]


class Chunks:
    """One record as consecutive chunks that are read anew for every pass over the data.

    `identify` goes over the data two or three times and holds one chunk and one piece of 32768
    samples at a time; memory does not depend on the record's length. Of an unstable model B, D,
    offset and x0, and with them `residual_std` and the covariances, come from the first piece
    alone.

    Args:
        source: called without arguments for each pass; gives the chunks in time order, each an
            `IOData` of a single record with the same sample time and channels. A generator
            function does, so that only one chunk exists at a time.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import Chunks, PastOutputMOESP, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> def read():
        ...     for first in range(0, 500, 100):
        ...         piece = slice(first, first + 100)
        ...         yield IOData(u=u[piece], y=y[piece], dt=0.1)
        >>> fit = identify(Chunks(read), PastOutputMOESP(order=1, block_rows=5))
        >>> round(fit.model.A.item(), 3)
        0.8
    """

    def __init__(self, source: Callable[[], Iterable[IOData]]):
        if not callable(source):
            raise ValueError(
                f"source={source!r} can be read only once: give a function that returns the "
                f"chunks anew, such as a generator function."
            )
        self.source = source

    @classmethod
    def of_arrays(
        cls, u: np.ndarray, y: np.ndarray, dt: float, *, size: int = _PIECE, names: Any = None
    ) -> "Chunks":
        """Chunks of arrays on disk, such as `numpy.memmap`, of which a slice is read at a time.

        Args:
            u: inputs, (time,) or (time, nu).
            y: outputs, (time,) or (time, ny).
            dt: sample time in seconds.
            size: samples in a chunk.
            names: as for `IOData`.

        Raises:
            ValueError: lengths differ, or `size` is below 2.
        """
        if len(u) != len(y):
            raise ValueError(f"u has {len(u)} samples and y {len(y)}: give one record's signals.")
        if size < 2:
            raise ValueError(f"size={size}: a chunk needs 2 samples or more.")

        def source():
            for first in range(0, len(u), size):
                # A last sample on its own goes with the chunk before it.
                if len(u) - first == 1 and first:
                    return
                last = len(u) if len(u) - first - size == 1 else first + size
                part = slice(first, last)
                yield IOData(u=np.array(u[part]), y=np.array(y[part]), dt=dt, names=names)

        return cls(source)

    def first(self) -> IOData:
        """The first chunk: channels, names and sample time of all.

        Raises:
            ValueError: there is none.
        """
        for chunk in self.source():
            return chunk
        raise ValueError("The source gave no chunks: it must return them anew at every call.")

    def pieces(self, first: IOData, size: int) -> Iterator[Pair]:
        """The record in pieces of `size` samples, the last one shorter.

        Raises:
            ValueError: a chunk that does not continue the first, naming its number.
        """
        held: list[Pair] = []
        count = 0
        for number, chunk in enumerate(self.source()):
            _check_chunk(number, chunk, first)
            held.append((np.asarray(chunk.u), np.asarray(chunk.y)))
            count += chunk.n_samples
            if count < size:
                continue
            u, y = (np.concatenate(signal) for signal in zip(*held, strict=True))
            for start in range(0, count - size + 1, size):
                yield u[start : start + size], y[start : start + size]
            rest = count - count % size
            held, count = [(u[rest:].copy(), y[rest:].copy())], count - rest
        if count:
            u, y = (np.concatenate(signal) for signal in zip(*held, strict=True))
            yield u, y


def _check_chunk(number: int, chunk: IOData, first: IOData) -> None:
    if len(chunk.lengths) > 1:
        raise ValueError(
            f"Chunk {number} holds {len(chunk.lengths)} records: chunks are consecutive parts of "
            f"one record."
        )
    if not np.isclose(chunk.dt, first.dt, rtol=1e-6):
        raise ValueError(
            f"Chunk {number} has dt={chunk.dt:.9g} s but chunk 0 has dt={first.dt:.9g} s: bring "
            f"them to one sample time first."
        )
    if (chunk.input_names, chunk.output_names) != (first.input_names, first.output_names):
        raise ValueError(
            f"Chunk {number} has the channels {chunk.input_names}, {chunk.output_names} but chunk "
            f"0 has {first.input_names}, {first.output_names}: use data.select or names=."
        )


class ChunkedSource:
    """The stages of an identification over chunks: the counterpart of those in memory."""

    def __init__(self, chunks: Chunks, first: IOData, method: AbstractSubspaceMethod):
        self.chunks, self.first, self.method = chunks, first, method
        self.n_samples = 0
        self.still = np.zeros(first.nu + first.ny, bool)
        self._known: tuple[HankelMoments, Array, Array] | None = None

    @property
    def lengths(self) -> tuple[int, ...]:
        """Samples of the one record, known once it was gone over."""
        return (self.n_samples,)

    def check_varying(self) -> None:
        """Raise for a constant channel."""
        check_varying(self.first, self.still)

    def range(self, method, layout: Layout, route: Route, correlate: bool) -> dict[str, Any]:
        """Range of the observability matrix, as `range_of_records` finds it."""
        moments, centre, scale = self._moments(layout)
        columns = layout.columns((self.n_samples,))
        settings = dict(columns=columns, method=method, layout=layout, correlate=correlate)
        if route == "gram":
            found = _range_of_moments(moments, centre, scale, **settings)
        else:
            whole = self._triangle(layout, slice(None), centre, scale)
            found = _range_of_triangle(whole, centre, scale, **settings)
        return found | dict(still=jnp.asarray(np.any(self.still)))

    def input_factor(self, channel: int, layout: Layout) -> np.ndarray:
        """Triangle of the rows of one input, from a pass over all chunks."""
        assert self._known is not None
        _, centre, scale = self._known
        alone = slice(channel, channel + 1)
        return np.asarray(self._triangle(layout, alone, centre, scale))

    def _triangle(self, layout: Layout, channels: slice, centre: Array, scale: Array) -> Array:
        """Lower triangle of the rows of `layout`, of some of the channels."""
        constant = self.method.offset
        upper = empty_triangle(layout.rows(), constant)
        centres, scales = np.asarray(centre)[None, channels], np.asarray(scale)[None, channels]
        edge = layout.n_lags - 1
        carry: np.ndarray | None = None
        for u, y in self.chunks.pieces(self.first, _PIECE):
            w = (np.concatenate([u, y], axis=1)[:, channels] - centres) / scales
            new = len(w) - edge if carry is None else len(w)
            joined = w if carry is None else np.concatenate([carry, w])
            padded = np.pad(joined, ((0, _PIECE + edge - len(joined)), (0, 0)))
            upper = _extend(upper, padded, new, layout=layout, constant=constant)
            carry = joined[-edge:]
        return lower_factor(upper, constant)

    def _moments(self, layout: Layout) -> tuple[HankelMoments, Array, Array]:
        """Moments, centre and scale, from one pass over the data."""
        if self._known is not None:
            return self._known
        edge, channels = layout.n_lags - 1, layout.nu + layout.ny
        centre = np.zeros(channels)
        if self.method.offset:
            # Any level near the mean keeps the sums from cancelling.
            centre = np.concatenate([self.first.u.mean(axis=0), self.first.y.mean(axis=0)])
        lagged = jnp.zeros((layout.n_lags, channels, channels))
        total = square = jnp.zeros(channels)
        carry, head = np.zeros((edge, channels)), np.zeros((0, channels))
        low, high = np.full(channels, np.inf), np.full(channels, -np.inf)
        for u, y in self.chunks.pieces(self.first, _PIECE):
            w = np.concatenate([u, y], axis=1)
            low, high = np.minimum(low, w.min(axis=0)), np.maximum(high, w.max(axis=0))
            w = w - centre
            self.n_samples += len(w)
            head = np.concatenate([head, w[: edge - len(head)]])
            padded = np.pad(w, ((0, _PIECE - len(w)), (0, 0)))
            lagged, total, square = _add(lagged, total, square, carry, padded)
            carry = np.concatenate([carry, w])[-edge:]
        self.still = constant_channels(low, high)
        require_samples(layout, self.lengths)
        scale = channel_scale(total, square, self.n_samples, self.method.offset)
        moments = HankelMoments(
            lagged=lagged,
            heads=jnp.asarray(head[None]),
            tails=jnp.asarray(carry[None]),
            total=total,
        )
        self._known = moments, jnp.asarray(centre), scale
        return self._known

    def complete(self, found: dict[str, Any], rounding: float, *, windows, **settings):
        """B, D, offset and x0, as `complete_records` finds them.

        Where the windows are shorter than the record (an unstable model), those of the first piece
        alone are used: their number must not grow with the record.
        """
        order, stabilise = settings.pop("order"), settings.pop("stabilise")
        offset = settings["offset"]
        A, C, moved = _realisation(found, ny=self.first.ny, order=order, stabilise=stabilise)
        samples = self.n_samples
        if len(windows) > 1:
            u, y = next(self.chunks.pieces(self.first, _PIECE))
            # A window may be longer than the piece.
            window = min(windows[0], len(u))
            lengths = (window,) * (len(u) // window)
            samples = sum(lengths)
            equations = _windowed(
                found, A, C, u[:samples], y[:samples], offset=offset, lengths=lengths
            )
        else:
            equations = self._equations(found, A, C, offset)
        done = _finish(found, A, C, moved, equations, rounding, samples=samples, **settings)
        return done | dict(samples=samples)

    def _equations(self, found, A, C, offset: bool) -> NormalEquations:
        """Normal equations of the whole record, the regressors handed from piece to piece."""
        nu = self.first.nu + offset
        block = block_size(A.shape[0], nu, C.shape[0])
        state = first_regressors(C, nu)
        total = None
        for u, y in self.chunks.pieces(self.first, _PIECE // block * block):
            more, state = _continued(found, A, C, u, y, state, offset=offset)
            total = more if total is None else jax.tree.map(jnp.add, total, more)
        return jax.tree.map(lambda x: x[None], total)


@jax.jit
def _add(lagged, total, square, carry, w):
    """Moments with one more piece: its products with itself and with the samples before it."""
    n_lags = lagged.shape[0]
    more = lagged_products(jnp.concatenate([carry, w]), n_lags) - lagged_products(carry, n_lags)
    return lagged + more, total + jnp.sum(w, axis=0), square + jnp.sum(w * w, axis=0)


@functools.partial(jax.jit, static_argnames=("layout", "constant"))
def _extend(upper, w, columns, *, layout, constant):
    return extend_triangle(upper, w, columns, layout.rows(), constant)


@functools.partial(jax.jit, static_argnames="offset")
def _continued(found, A, C, u, y, state, *, offset):
    return continued_equations(A, C, *scaled_signals(found, u, y, offset), state)


@functools.partial(jax.jit, static_argnames=("offset", "lengths"))
def _windowed(found, A, C, u, y, *, offset, lengths):
    return record_equations(A, C, *scaled_signals(found, u, y, offset), lengths)


_RANGE_SETTINGS = ("columns", "method", "layout", "correlate")
_range_of_moments = jax.jit(range_of_moments, static_argnames=_RANGE_SETTINGS)
_range_of_triangle = jax.jit(range_of_triangle, static_argnames=_RANGE_SETTINGS)
_realisation = jax.jit(realisation, static_argnames=("ny", "order", "stabilise"))
_finish = jax.jit(finish, static_argnames=("samples", "full_rank", "feedthrough", "offset"))
