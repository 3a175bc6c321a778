"""Residuals over all records, and the normal equations of a fit."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lpvid.refinement._levenberg_marquardt import NormalEquations, Unknowns
from lpvid.refinement._losses import AbstractLoss, Mask, Residual
from lpvid.refinement._parameterisation import AbstractParameterisation, Record

# Eigenvalues of states' sensitivities below this share of the largest are rounding.
_RANK = 1e-12
# Share of a sensitivity, in squares, that states must leave of it to count.
_TOLD = 1e-20


class Problem(eqx.Module):
    """A model, its records and a loss, in coordinates z about a point: values = base + basis z.

    Attributes:
        parameterisation: the kind of model.
        loss: what is minimised.
        records: padded to one length.
        mask: which samples count.
        base: values at z = 0.
        basis: directions of the coordinates.
        x0: initial states where they are not estimated, (record, nx).
        free_start: whether they are.
        floor: each output's residual variance that is told from rounding.
        scale: each output's scale in this round.
    """

    parameterisation: AbstractParameterisation
    loss: AbstractLoss
    records: Record
    mask: Mask
    base: Float[Array, " value"]
    basis: Float[Array, "value coordinate"]
    x0: Float[Array, "record nx"]
    free_start: bool = eqx.field(static=True)
    floor: Float[Array, " ny"]
    scale: Float[Array, " ny"]

    def values(self, z: Float[Array, " coordinate"]) -> Float[Array, " value"]:
        """The model's values at coordinates z."""
        return self.base + self.basis @ z

    def _start(self, own: Array, x0: Array) -> Array:
        return own if self.free_start else x0

    def residual(self, unknowns: Unknowns) -> Residual:
        """y − ŷ of every record, zero where nothing was measured."""
        return self._residual(self.parameterisation.prepare(self.values(unknowns.shared)), unknowns)

    def _residual(self, prepared: Any, unknowns: Unknowns) -> Residual:
        def one(each):
            record, mask, own, x0 = each
            y = self.parameterisation.respond(prepared, record, self._start(own, x0))
            return jnp.where(mask[:, None], record.y - y, 0.0)

        return over_records(one, (self.records, self.mask, unknowns.own, self.x0))

    def cost(self, unknowns: Unknowns) -> tuple[Float[Array, ""], Residual]:
        """The loss, infinite for a predictor that does not forget its start, and the residual."""
        prepared = self.parameterisation.prepare(self.values(unknowns.shared))
        residual = self._residual(prepared, unknowns)
        loss = self.loss.cost(residual, self.mask, self.scale, self.floor)
        return jnp.where(self.parameterisation.forgets(prepared), loss, jnp.inf), residual

    def forgetful(self, at: Unknowns) -> Bool[Array, ""]:
        """Whether each record's last tenth depends no more on its first state than its first."""
        prepared, tangents = self.tangents(at)

        def one(each):
            record, mask, own, x0 = each
            by_own = self.sensitivity(prepared, tangents, record, mask, own, x0)[1]
            power, place = jnp.sum(by_own**2, axis=(0, 2)), jnp.arange(mask.shape[0])
            count = jnp.sum(mask)
            tenth = jnp.maximum(count // 10, 1)
            first = jnp.sum(jnp.where(place < tenth, power, 0.0))
            last = jnp.sum(jnp.where((place >= count - tenth) & mask, power, 0.0))
            return last <= first

        return jnp.all(over_records(one, (self.records, self.mask, at.own, self.x0)))

    def tangents(self, unknowns: Unknowns) -> tuple[Any, Any]:
        """What the records share, and its derivatives along every coordinate."""

        def prepare(z):
            return self.parameterisation.prepare(self.values(z))

        directions = jnp.eye(self.basis.shape[1])
        return jax.vmap(lambda d: jax.jvp(prepare, (unknowns.shared,), (d,)), out_axes=(None, 0))(
            directions
        )

    def sensitivity(
        self, prepared: Any, tangents: Any, record: Record, mask: Array, own: Array, x0: Array
    ) -> tuple[Float[Array, "coordinate time ny"], Float[Array, "own time ny"]]:
        """Derivatives of one record's output by the coordinates, and by its own initial state."""

        def respond(prepared, own):
            y = self.parameterisation.respond(prepared, record, self._start(own, x0))
            return jnp.where(mask[:, None], y, 0.0)

        count, size = self.basis.shape[1], own.shape[0]
        shared = jax.tree.map(
            lambda leaf: jnp.concatenate([leaf, jnp.zeros((size, *leaf.shape[1:]))]), tangents
        )
        starts = jnp.concatenate([jnp.zeros((count, size)), jnp.eye(size)])
        by_direction = jax.vmap(
            lambda shared, start: jax.jvp(respond, (prepared, own), (shared, start))[1]
        )(shared, starts)
        return by_direction[:count], by_direction[count:]

    def linearise(self, unknowns: Unknowns, residual: Residual) -> NormalEquations:
        """Cost, gradient and Gauss–Newton matrix."""
        white = self.loss.whitening(residual, self.mask, self.scale, self.floor)
        prepared, tangents = self.tangents(unknowns)

        def one(each):
            record, mask, own, x0, residual, weights = each
            by_shared, by_own = self.sensitivity(prepared, tangents, record, mask, own, x0)
            both = jnp.concatenate([by_shared, by_own])
            roots = jnp.sqrt(weights)
            both = (both * roots[None]) @ white.factor.T
            right = (residual * roots) @ white.factor.T
            both = both.reshape(both.shape[0], -1)
            return both @ both.T, -both @ right.reshape(-1)

        matrices, gradients = over_records(
            one,
            (self.records, self.mask, unknowns.own, self.x0, residual, white.weights),
        )
        count = self.basis.shape[1]
        return NormalEquations(
            cost=self.loss.cost(residual, self.mask, self.scale, self.floor),
            gradient=jnp.sum(gradients[:, :count], axis=0),
            matrix=jnp.sum(matrices[:, :count, :count], axis=0),
            own_gradient=gradients[:, count:],
            own_matrix=matrices[:, count:, count:],
            coupling=matrices[:, :count, count:],
        )

    def projected(
        self, at: Unknowns, factor: Float[Array, "ny ny"], kept: Float[Array, " coordinate"]
    ) -> tuple[Float[Array, "record coordinate time ny"], Float[Array, "record own time ny"]]:
        """Whitened sensitivities, the initial states eliminated; and orthonormal ones by these."""
        prepared, tangents = self.tangents(at)

        def one(each):
            record, mask, own, x0 = each
            by_shared, by_own = self.sensitivity(prepared, tangents, record, mask, own, x0)
            by_shared = (by_shared * kept[:, None, None]) @ factor.T
            if not own.shape[0]:
                return by_shared, by_own
            rows = _orthonormal((by_own @ factor.T).reshape(own.shape[0], -1))
            flat = by_shared.reshape(kept.shape[0], -1)
            left = flat - (flat @ rows.T) @ rows
            left = left.reshape(by_shared.shape)
            return without_rounding(left, by_shared), rows.reshape(by_own.shape)

        return over_records(one, (self.records, self.mask, at.own, self.x0))


def without_rounding(
    left: Float[Array, "*record coordinate time ny"],
    whole: Float[Array, "*record coordinate time ny"],
) -> Float[Array, "*record coordinate time ny"]:
    """What states leave of sensitivities; what is but rounding is nothing that a record tells."""
    size, rest = (jnp.sum(part**2, axis=(-2, -1), keepdims=True) for part in (whole, left))
    return jnp.where(rest > _TOLD * size, left, 0.0)


def _orthonormal(own: Float[Array, "own sample"]) -> Float[Array, "own sample"]:
    """Orthonormal rows of the same span (zeros for what moves nothing)."""
    size = jnp.linalg.norm(own, axis=1, keepdims=True)
    own = own / jnp.where(size > 0.0, size, 1.0)
    values, vectors = jnp.linalg.eigh(own @ own.T)
    told = values > _RANK
    roots = jnp.where(told, jax.lax.rsqrt(jnp.where(told, values, 1.0)), 0.0)
    return (vectors * roots[None, :]).T @ own


def over_records(function, arguments):
    """One record after the other: memory for one Jacobian, and no loop for a single record."""
    if jax.tree.leaves(arguments)[0].shape[0] == 1:
        single = function(jax.tree.map(lambda leaf: leaf[0], arguments))
        return jax.tree.map(lambda leaf: leaf[None], single)
    return jax.lax.map(function, arguments)
