"""Multiple shooting: pieces of the records with states of their own, made to meet."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lpvid.refinement._chain import ChainEquations, eliminate
from lpvid.refinement._criterion import Problem, over_records, without_rounding
from lpvid.refinement._levenberg_marquardt import Unknowns
from lpvid.refinement._losses import Residual
from lpvid.refinement._parameterisation import Record

# Weight of a gap at which covariances are computed, over what a piece tells of its state.
_RIGID = 1e10
_SMALL = 1e-150


class Pieces(eqx.Module):
    """Records cut into pieces of one length, each with some samples of the next one.

    Attributes:
        records: (record, piece, time, channel).
        joined: whether a piece is followed by one with measured samples.
    """

    records: Record
    joined: Bool[Array, "record piece"]


class Simulated(NamedTuple):
    """What `Shooting.cost` keeps: the residual, and the gaps between the pieces."""

    residual: Residual
    gaps: Float[Array, "record piece row"]
    sizes: Float[Array, " row"]


class Shooting(eqx.Module):
    """A problem over pieces, the gaps between them under an augmented Lagrangian.

    cost + ½ Σ w² (c + λ/w²)² with the gaps c_k = F_k(x_k, ϑ) − x_{k+1} (Nocedal and Wright 2006,
    §17.3; multiple shooting for estimation: Bock 1983).

    Attributes:
        problem: over whole records.
        pieces: of them.
        weights: w² of every row of a gap; empty where gaps are not weighed.
        multipliers: λ.
    """

    problem: Problem
    pieces: Pieces
    weights: Float[Array, " row"]
    multipliers: Float[Array, "record piece row"]

    @property
    def _size(self) -> tuple[int, int]:
        """Number of pieces and samples in each."""
        count = self.pieces.joined.shape[1]
        return count, -(-self.problem.mask.shape[1] // count)

    def _cut(self, signal: Array) -> Array:
        """A signal of whole records, (record, time, channel), as pieces."""
        count, size = self._size
        padded = jnp.pad(signal, ((0, 0), (0, count * size - signal.shape[1]), (0, 0)))
        return padded.reshape(signal.shape[0], count, size, signal.shape[2])

    def _whole(self, signal: Array) -> Array:
        """Pieces (record, …, piece, time, channel) as whole records."""
        joined = signal.reshape(*signal.shape[:-3], -1, signal.shape[-1])
        return joined[..., : self.problem.mask.shape[1], :]

    def nodes(self, own: Float[Array, "record own"]) -> Float[Array, "record piece nx"]:
        """The states at which the pieces start, the first as known where it is not free."""
        count = self.pieces.joined.shape[1]
        nodes = own.reshape(own.shape[0], count, -1)
        if self.problem.free_start:
            return nodes
        return nodes.at[:, 0].set(self.problem.x0)

    def _piece(self, prepared: Any, record: Record, state: Array) -> tuple[Array, Array, Array]:
        """Output of one piece, and the rows by which it meets the one before and the next."""
        return self.problem.parameterisation.shoot(prepared, record, state, self._size[1])

    def _gaps(self, begin: Array, end: Array) -> Array:
        after = jnp.concatenate([begin[1:], jnp.zeros_like(begin[:1])])
        return end - after

    def simulate(self, unknowns: Unknowns) -> Simulated:
        """y − ŷ and the gaps."""
        prepared = self.problem.parameterisation.prepare(self.problem.values(unknowns.shared))

        def one(each):
            record, joined, nodes = each
            y, begin, end = jax.vmap(lambda r, x: self._piece(prepared, r, x))(record, nodes)
            gaps = jnp.where(joined[:, None], self._gaps(begin, end), 0.0)
            power = jnp.sum(jnp.where(joined[:, None], end**2, 0.0), axis=0)
            return y, gaps, power

        y, gaps, power = over_records(
            one, (self.pieces.records, self.pieces.joined, self.nodes(unknowns.own))
        )
        residual = self.problem.records.y - self._whole(y)
        residual = jnp.where(self.problem.mask[:, :, None], residual, 0.0)
        joints = jnp.maximum(jnp.sum(self.pieces.joined), 1).astype(float)
        return Simulated(residual, gaps, jnp.sqrt(jnp.sum(power, axis=0) / joints))

    def largest_gap(self, simulated: Simulated) -> Float[Array, ""]:
        """Over the root mean square of what does not meet."""
        sizes = jnp.where(simulated.sizes > 0.0, simulated.sizes, 1.0)
        return jnp.max(jnp.abs(simulated.gaps) / sizes[None, None])

    def _pulled(self, simulated: Simulated) -> Array:
        """√w² (c + λ/w²)."""
        root = jnp.sqrt(self.weights)
        shift = self.multipliers / jnp.where(root > 0.0, root, 1.0)[None, None]
        return root[None, None] * simulated.gaps + jnp.where(root[None, None] > 0.0, shift, 0.0)

    def pushed(self, simulated: Simulated) -> Float[Array, "record piece row"]:
        """The multipliers after this solution."""
        return self.multipliers + self.weights[None, None] * simulated.gaps

    def _total(self, simulated: Simulated) -> Float[Array, ""]:
        problem = self.problem
        cost = problem.loss.cost(simulated.residual, problem.mask, problem.scale, problem.floor)
        return cost + 0.5 * jnp.sum(self._pulled(simulated) ** 2)

    def cost(self, unknowns: Unknowns) -> tuple[Float[Array, ""], Simulated]:
        """The augmented Lagrangian, and what was simulated."""
        simulated = self.simulate(unknowns)
        return self._total(simulated), simulated

    def _slopes(self, prepared: Any, tangents: Any, record: Record, nodes: Array):
        """Derivatives of one record's pieces by states and shared unknowns: y, begin, end."""
        count, nx = self.problem.basis.shape[1], nodes.shape[1]
        shared = jax.tree.map(
            lambda leaf: jnp.concatenate([jnp.zeros((nx, *leaf.shape[1:])), leaf]), tangents
        )
        states = jnp.concatenate([jnp.eye(nx), jnp.zeros((count, nx))])
        if self.problem.free_start:
            free = jnp.ones(nodes.shape[0])
        else:
            free = jnp.asarray(np.arange(nodes.shape[0]) > 0, float)

        def piece(record, state, free):
            def directional(shared, direction):
                return jax.jvp(
                    lambda p, x: self._piece(p, record, x),
                    (prepared, state),
                    (shared, free * direction),
                )[1]

            return jax.vmap(directional)(shared, states)

        return jax.vmap(piece)(record, nodes, free)

    def _joints(self, begin: Array, end: Array, joined: Array, nx: int) -> Array:
        """Slopes of the gaps by state, next state and shared unknowns, (piece, row, column)."""
        begin, end = begin.mT, end.mT
        after = jnp.concatenate([begin[1:], jnp.zeros_like(begin[:1])])
        parts = [end[..., :nx], -after[..., :nx], end[..., nx:] - after[..., nx:]]
        return jnp.where(joined[:, None, None], jnp.concatenate(parts, axis=-1), 0.0)

    def _lines(self, unknowns: Unknowns, factor: Array, roots: Residual):
        """Of every record: whitened slopes of the output, slopes of the gaps, what rows tell."""
        prepared, tangents = self.problem.tangents(unknowns)
        nodes = self.nodes(unknowns.own)
        kept = self._cut(jnp.where(self.problem.mask[:, :, None], roots, 0.0))

        def one(each):
            record, joined, nodes, kept = each
            y, begin, end = self._slopes(prepared, tangents, record, nodes)
            y = (y * kept[:, None]) @ factor.T
            nx = nodes.shape[1]
            told = jnp.sum(y[:, :nx] ** 2, axis=(0, 2, 3))
            spread = jnp.sum(begin[:, :nx] ** 2, axis=0)
            return y, self._joints(begin, end, joined, nx), told, spread

        y, joints, told, spread = over_records(
            one, (self.pieces.records, self.pieces.joined, nodes, kept)
        )
        pieces = float(np.prod(self.pieces.joined.shape))
        # What a piece tells of each row by which it meets others: of a state, its information.
        told = jnp.sum(told, axis=0) / pieces
        inverse = 1.0 / jnp.maximum(told, _SMALL)
        information = 1.0 / jnp.maximum(inverse @ (jnp.sum(spread, axis=0) / pieces), _SMALL)
        return y, joints, jnp.where(information < 1.0 / _SMALL, information, 0.0)

    def linearise(self, unknowns: Unknowns, simulated: Simulated) -> ChainEquations:
        """Cost, gradient and the pieces' least-squares rows."""
        problem = self.problem
        residual = simulated.residual
        white = problem.loss.whitening(residual, problem.mask, problem.scale, problem.floor)
        roots = jnp.sqrt(white.weights)
        y, joints, information = self._lines(unknowns, white.factor, roots)
        right = self._cut((residual * roots) @ white.factor.T)
        rows = jnp.concatenate([y, -right[:, :, None]], axis=2)
        rows = rows.reshape(*rows.shape[:3], -1).mT
        weighted = jnp.sqrt(self.weights)[None, None, :, None] * joints
        joints = jnp.concatenate([weighted, self._pulled(simulated)[..., None]], axis=-1)
        nx = unknowns.own.shape[1] // self._size[0]
        gradient = jnp.einsum("rktc,rkt->c", rows[..., nx:-1], rows[..., -1])
        gradient = gradient + jnp.einsum("rkmc,rkm->c", joints[..., 2 * nx : -1], joints[..., -1])
        return ChainEquations(
            cost=self._total(simulated),
            gradient=gradient,
            rows=jnp.linalg.qr(rows, mode="r"),
            joints=joints,
            information=information,
        )

    def projected(
        self, unknowns: Unknowns, factor: Float[Array, "ny ny"], kept: Float[Array, " coordinate"]
    ) -> tuple[Float[Array, "record coordinate time ny"], Float[Array, "record own time ny"]]:
        """Whitened sensitivities, all states eliminated; and what the first states move.

        The latter orthonormal: they are what every record's last state moves, and so the earlier
        ones that lead there.
        """
        y, joints, information = self._lines(
            unknowns, factor, jnp.ones_like(self.problem.records.y)
        )
        count = kept.shape[0]
        nx = y.shape[2] - count
        y = y * jnp.concatenate([jnp.ones(nx), kept])[None, None, :, None, None]
        rows = y.reshape(*y.shape[:3], -1).mT
        rows = jnp.concatenate([rows, jnp.zeros_like(rows[..., :1])], axis=-1)
        rows = jnp.linalg.qr(rows, mode="r")
        joints = joints * jnp.sqrt(_RIGID * information)[None, None, :, None]
        joints = joints * jnp.concatenate([jnp.ones(2 * nx), kept])[None, None, None]
        joints = jnp.concatenate([joints, jnp.zeros_like(joints[..., :1])], axis=-1)
        size = jnp.sqrt(jnp.mean(jnp.sum(rows[..., :nx] ** 2, axis=2), axis=(0, 1)))
        eliminated = eliminate(rows, joints, 1e-11 * jnp.where(size > 0.0, size, 1.0))
        # The last piece with measured samples is the one that nothing follows.
        before = jnp.pad(self.pieces.joined[:, :-1], ((0, 0), (1, 0)), constant_values=True)
        last = before & ~self.pieces.joined
        units = jnp.concatenate([jnp.zeros((nx, count)), jnp.eye(nx)], axis=1)
        last = jnp.where(last[:, :, None, None], units[None, None], 0.0)
        shared = jnp.concatenate([jnp.eye(count), jnp.zeros((count, nx))], axis=1)
        states = eliminated.states(shared, False, last)
        moved = jnp.einsum("rkstn,rksc->rcktn", y[:, :, :nx], states)
        held = jnp.swapaxes(y[:, :, nx:], 1, 2)
        moved = self._whole(moved.at[:, :count].add(held))
        return without_rounding(moved[:, :count], self._whole(held)), moved[:, count:]


def unweighted(problem: Problem, pieces: Pieces) -> Shooting:
    """For what needs no weights of the gaps: simulation and sensitivities."""
    return Shooting(problem, pieces, jnp.zeros(0), jnp.zeros((*pieces.joined.shape, 0)))


def cut_up(records: Record, mask: Array, length: int, overlap: int) -> Pieces:
    """Every record cut into pieces of nearly `length` samples, and `overlap` of the next piece."""
    longest = mask.shape[1]
    count = -(-longest // length)
    size = -(-longest // count)
    places = np.arange(count)[:, None] * size + np.arange(size + overlap)[None, :]
    missing = int(places.max()) + 1 - longest

    def cut(signal: Array, mode: str = "constant") -> Array:
        return jnp.pad(signal, ((0, 0), (0, missing), (0, 0)), mode=mode)[:, places]

    # As in `padded_records`: the schedule stays where it was, signals end.
    kappa = None if records.kappa is None else cut(records.kappa, "edge")
    joined = jnp.pad(mask[:, np.arange(1, count) * size], ((0, 0), (0, 1)))
    place = jnp.broadcast_to(records.place[:, None], joined.shape)
    return Pieces(Record(cut(records.u), cut(records.y), kappa, place), joined)
