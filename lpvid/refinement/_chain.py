"""Least squares over pieces in a row: square-root elimination from piece to piece."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lpvid.refinement._levenberg_marquardt import AbstractQuadratic, Unknowns

# Columns in this order: state, (of joints) next state, shared unknowns, right-hand side.
Rows = Float[Array, "record piece row column"]
Joints = Float[Array, "record piece joint wide"]


class Eliminated(eqx.Module):
    """Every state as a function of the next one and of the shared unknowns.

    triangle · x_k + beyond · x_{k+1} + shared · θ + right = 0.

    Attributes:
        triangle: upper triangular.
        beyond: on the next piece's state.
        shared: on the shared unknowns.
        right: right-hand side.
        rest: what is left for the shared unknowns: rows of their matrix and right-hand side.
    """

    triangle: Float[Array, "record piece nx nx"]
    beyond: Float[Array, "record piece nx nx"]
    shared: Float[Array, "record piece nx shared"]
    right: Float[Array, "record piece nx"]
    rest: Float[Array, "record row narrow"]

    def states(
        self, shared: Float[Array, "shared column"], right: bool, last: Array | None = None
    ) -> Float[Array, "record piece nx column"]:
        """States for several shared unknowns at once, from the last piece to the first.

        Args:
            shared: columns of shared unknowns.
            right: whether the right-hand side counts.
            last: added to every piece's right-hand side, (record, piece, nx, column).
        """
        known = self.shared @ shared[None, None]
        if right:
            known = known + self.right[..., None]
        if last is not None:
            known = known + last

        def back(beyond, each):
            triangle, after, known = each
            right = -(known + after @ beyond)
            state = jax.scipy.linalg.solve_triangular(triangle, right, lower=False)
            return state, state

        def one(triangle, beyond, known):
            nothing = jnp.zeros(known.shape[1:])
            return jax.lax.scan(back, nothing, (triangle, beyond, known), reverse=True)[1]

        return jax.vmap(one)(self.triangle, self.beyond, known)


def eliminate(rows: Rows, joints: Joints, damping: Float[Array, " nx"]) -> Eliminated:
    """Eliminate the states of all pieces in turn, by orthogonal transformations.

    A square-root information filter over the pieces (Bierman 1977), the joints its process: no
    power of a state matrix over more than a piece is formed, so plants that grow over the record
    do no harm, nor do those that forget their state. Nothing is squared.

    Args:
        rows: least-squares rows of each piece, on its state, the shared unknowns and 1.
        joints: rows that tie each piece to the next, with large weights, on its state, the next
            state, the shared unknowns and 1; zero where there is no next piece.
        damping: weights that hold every state where it is.
    """
    nx, columns = damping.shape[0], rows.shape[-1]
    held = jnp.concatenate([jnp.diag(damping), jnp.zeros((nx, columns - nx))], axis=1)

    def widened(rows):
        return jnp.concatenate([rows[:, :nx], jnp.zeros((rows.shape[0], nx)), rows[:, nx:]], axis=1)

    def forward(arrived, each):
        rows, joint = each
        # Large weights first: Householder's triangle is then accurate row by row.
        parts = [joint, widened(arrived), widened(rows), widened(held)]
        triangle = jnp.linalg.qr(jnp.concatenate(parts), mode="r")
        return triangle[nx:, nx:], triangle[:nx]

    def one(rows, joints):
        return jax.lax.scan(forward, jnp.zeros((columns, columns)), (rows, joints))

    rest, solved = jax.vmap(one)(rows, joints)
    return Eliminated(
        triangle=solved[..., :nx],
        beyond=solved[..., nx : 2 * nx],
        shared=solved[..., 2 * nx : -1],
        right=solved[..., -1],
        rest=rest[..., nx:],
    )


class ChainEquations(AbstractQuadratic):
    """Least-squares rows of pieces in a row, and the joints between them.

    Attributes:
        cost: the cost itself.
        gradient: with respect to the shared unknowns.
        rows: of each piece, reduced to a triangle, on its state, the shared unknowns and 1.
        joints: weighted, on a state, the next state, the shared unknowns and 1.
        information: what a piece tells, on average, of each row by which it meets others.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " shared"]
    rows: Rows
    joints: Joints
    information: Float[Array, " joint"]

    @property
    def least_damping(self) -> float:
        """Nothing is squared: steps that 1e-11 of the strongest direction shows are told apart."""
        return 1e-22

    def _scales(self) -> tuple[Array, Array]:
        """Sizes of the shared unknowns' and the states' columns, of the data alone."""
        nx = self.joints.shape[-1] - self.rows.shape[-1]
        sizes = jnp.sqrt(jnp.sum(self.rows[..., :-1] ** 2, axis=(0, 1, 2)))
        sizes = jnp.where(sizes > 0.0, sizes, 1.0)
        return sizes[nx:], sizes[:nx] / jnp.sqrt(self.rows.shape[0] * self.rows.shape[1])

    def step(self, damping: Float[Array, ""], held: Bool[Array, " shared"]) -> Unknowns:
        """The damped step, by orthogonal transformations."""
        shared_scale, own_scale = self._scales()
        root = jnp.sqrt(damping)
        eliminated = eliminate(self.rows, self.joints, root * own_scale)
        count = shared_scale.shape[0]
        rest = eliminated.rest.reshape(-1, count + 1)
        rest = rest * jnp.concatenate([jnp.where(held, 0.0, 1.0 / shared_scale), jnp.ones(1)])[None]
        damped = jnp.diag(jnp.where(held, 1.0, root))
        damped = jnp.concatenate([damped, jnp.zeros((count, 1))], axis=1)
        triangle = jnp.linalg.qr(jnp.concatenate([rest, damped]), mode="r")
        shared = -jax.scipy.linalg.solve_triangular(
            triangle[:count, :count], triangle[:count, count], lower=False
        )
        shared = jnp.where(held, 0.0, shared / shared_scale)
        own = eliminated.states(shared[:, None], True)[..., 0]
        return Unknowns(shared, own.reshape(own.shape[0], -1))

    def gain(self, step: Unknowns) -> Float[Array, ""]:
        """−eᵀJδ − ½ |Jδ|²."""
        nx = self.joints.shape[-1] - self.rows.shape[-1]
        own = step.own.reshape(step.own.shape[0], -1, nx)
        beyond = jnp.concatenate([own[:, 1:], jnp.zeros_like(own[:, :1])], axis=1)
        shared = jnp.broadcast_to(step.shared, (*own.shape[:2], step.shared.shape[0]))
        total = jnp.asarray(0.0)
        for rows, parts in ((self.rows, (own, shared)), (self.joints, (own, beyond, shared))):
            moved = jnp.einsum("rkpc,rkc->rkp", rows[..., :-1], jnp.concatenate(parts, axis=-1))
            total = total - jnp.sum(moved * (rows[..., -1] + 0.5 * moved))
        return total
