"""Structures of the two-link flexible arm at a frozen posture: (32) and its dissipative form."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from lpvid.models import AbstractStructure, StateSpace

Parameters = Float[Array, " parameter"]

_LOWER = np.tril_indices(4)
_ON_DIAGONAL = _LOWER[0] == _LOWER[1]


class TwoLinkArmStructure(AbstractStructure):
    """The arm's structure (32): sixteen free entries in A, shared with B; C known.

    With x = [v, θ̇, v̇]: A[2:6, 0:4] holds ϑ1..4, ϑ5..8, ϑ9..12, ϑ13..16 column by column,
    A[0:2, 4:6] = I, B[2:6] = −[ϑ9..12 | ϑ13..16], C = [[0, 0, 1, 0, ℓ1, 0], [0, 0, 0, 1, ℓ1, ℓ2]].

    A search in these entries meets unstable models and poor local minima; restructuring
    therefore looks for its starts in the dissipative form of the same plant.

    Attributes:
        lengths: ℓ of both links, m.
        scales: rough sizes of the arm for the starts, if known.

    Source: 001, equations 30 to 32 (indices of the printed equation corrected).

    Example:
        >>> TwoLinkArmStructure((0.35, 0.30)).n_parameters
        16
    """

    lengths: tuple[float, float] = eqx.field(static=True)
    scales: "ArmScales | None" = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """theta 1 to theta 16."""
        return tuple(f"theta {i}" for i in range(1, 17))

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model (32) at ϑ, shape (16,)."""
        columns = parameters.reshape(4, 4).T
        A = jnp.zeros((6, 6)).at[0:2, 4:6].set(jnp.eye(2)).at[2:6, 0:4].set(columns)
        B = jnp.zeros((6, 2)).at[2:6].set(-columns[:, 2:4])
        first, second = self.lengths
        C = jnp.array([[0.0, 0.0, 1.0, 0.0, first, 0.0], [0.0, 0.0, 0.0, 1.0, first, second]])
        return StateSpace(A, B, C)

    @eqx.filter_jit
    def closed_form(self, black_box: StateSpace) -> Float[Array, "16"]:
        """ϑ of a black box of order 6, by four conditions on its basis; sensitive to noise.

        With x_𝔵 = S x and S = [S_v, S_θ̇, S_v̇] the structure asks for 𝔄 S_θ̇ = −𝔅, 𝔄 S_v̇ = S_v,
        ℭ S = C and T_v 𝔅 = 0, where T_v are the first rows of S⁻¹. So S_θ̇ = −𝔄⁻¹𝔅, and S_v̇
        solves [ℭ; ℭ𝔄] S_v̇ = [C_v; 0] up to a null space that T_v S_v̇ = 0 fixes, T_v lying in the
        left null space of [𝔅, 𝔄⁻¹𝔅]. Exact on noise-free models; on the reference arm a model
        3 % off in H∞ gives parameters off by factors of 2 to 20. Works under `jit` and `vmap`.

        Args:
            black_box: continuous-time model of order 6 with a regular A.

        Raises:
            ValueError: the black box is not in continuous time, or of another size.

        Example:
            >>> structure = TwoLinkArmStructure((0.35, 0.30))
            >>> arm = structure.matrices(DissipativeTwoLinkArm((0.35, 0.30)).entries(jnp.ones(14)))
            >>> structure.closed_form(arm.transform(jnp.eye(6)[::-1])).shape
            (16,)
        """
        sizes = (black_box.nx, black_box.nu, black_box.ny, black_box.dt)
        if sizes != (6, 2, 2, 0.0):
            raise ValueError(
                "black_box: (nx, nu, ny, dt) = (6, 2, 2, 0) is needed for the closed form, got "
                f"{sizes}; identify with order=6 and convert with d2c."
            )
        A, B, C = black_box.A, black_box.B, black_box.C
        first, second = self.lengths
        deflections = jnp.array([[first, 0.0], [first, second], [0.0, 0.0], [0.0, 0.0]])
        rates = -jnp.linalg.solve(A, B)
        conditions = jnp.concatenate([C, C @ A])
        particular = jnp.linalg.pinv(conditions) @ deflections
        null = jnp.linalg.svd(conditions)[2][4:].T
        left = jnp.linalg.svd(jnp.concatenate([B, rates], axis=1).T)[2][4:]
        velocities = particular - null @ jnp.linalg.solve(left @ null, left @ particular)
        S = jnp.concatenate([A @ velocities, rates, velocities], axis=1)
        # Columns of A S beside those of −B, which are the same ones here.
        columns = jnp.linalg.solve(S, A @ S[:, :4])
        return columns[2:6].T.reshape(16)

    def search_structure(self) -> "DissipativeTwoLinkArm":
        """The dissipative form, in which every parameter value is a stable model."""
        return DissipativeTwoLinkArm(self.lengths, self.scales)

    def from_search(self, parameters: Float[Array, "14"]) -> Float[Array, "16"]:
        """ϑ1..16 of a point of the dissipative form."""
        return self.search_structure().entries(parameters)


class ArmScales(NamedTuple):
    """Rough sizes of an arm: a factor of two or three off is good enough.

    Attributes:
        mobility: diagonal of W = M⁻¹ for (θ1, θ2, v1, v2).
        stiffness: generalised stiffness of v1 and v2, 4 EI ℓ.
        gains: of the two velocity loops, N·m·s/rad.
    """

    mobility: Float[Array, "4"]
    stiffness: Float[Array, "2"]
    gains: Float[Array, "2"]


class DissipativeTwoLinkArm(AbstractStructure):
    """The same arm by a symmetric positive definite mobility, stiffnesses and gains.

    ϑ1..4 = −k1 W[:, 2], ϑ5..8 = −k2 W[:, 3], ϑ9..12 = −λ1 W[:, 0], ϑ13..16 = −λ2 W[:, 1] with
    W = S L Lᵀ S by its logarithmic Cholesky factor, S the square root of the mobility scales.
    Fourteen parameters, no value of which is an unstable model (only deflections that are not
    coupled with any joint remain undamped); one common factor of (W⁻¹, k, λ) is not visible from
    outside.

    Attributes:
        lengths: ℓ of both links, m.
        scales: sizes that the parameters are relative to; ones by default.

    Source: 001, equations 30 to 32, with M⁻¹ = W.

    Example:
        >>> DissipativeTwoLinkArm((0.35, 0.30)).entries(jnp.zeros(14))[2].item()
        -1.0
    """

    lengths: tuple[float, float] = eqx.field(static=True)
    scales: ArmScales | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Ten Cholesky entries, then the logarithms of stiffnesses and gains."""
        cholesky = (f"mobility L[{i},{j}]" for i, j in zip(*_LOWER, strict=True))
        return (*cholesky, "log stiffness 1", "log stiffness 2", "log gain 1", "log gain 2")

    def entries(self, parameters: Parameters) -> Float[Array, "16"]:
        """ϑ1..16 of structure (32)."""
        scales = _unit_scales() if self.scales is None else self.scales
        # Off-diagonal entries are relative to their row's diagonal: all of one size.
        factor = jnp.zeros((4, 4)).at[_LOWER].set(parameters[:10])
        diagonal = jnp.exp(jnp.diag(factor))
        factor = diagonal[:, None] * (jnp.tril(factor, -1) + jnp.eye(4))
        factor = jnp.sqrt(scales.mobility)[:, None] * factor
        mobility = factor @ factor.T
        stiffness = scales.stiffness * jnp.exp(parameters[10:12])
        gains = scales.gains * jnp.exp(parameters[12:14])
        columns = [
            -stiffness[0] * mobility[:, 2],
            -stiffness[1] * mobility[:, 3],
            -gains[0] * mobility[:, 0],
            -gains[1] * mobility[:, 1],
        ]
        return jnp.concatenate(columns)

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model at these parameters."""
        return TwoLinkArmStructure(self.lengths).matrices(self.entries(parameters))

    @eqx.filter_jit
    def starts(
        self, key: PRNGKeyArray, count: int, black_box: StateSpace
    ) -> Float[Array, "start parameter"]:
        """Scatter about the scales; without scales, about sizes read off the black box's poles."""
        spread = 0.5 if self.scales is not None else 0.9
        diagonal, coupling, rest = jax.random.split(key, 3)
        factor = jnp.where(
            jnp.asarray(_ON_DIAGONAL)[None],
            0.5 * spread * jax.random.normal(diagonal, (count, 10)),
            0.7 * jax.random.normal(coupling, (count, 10)),
        )
        logs = spread * jax.random.normal(rest, (count, 4))
        centre = jnp.zeros(14)
        if self.scales is None:
            centre = self._centre(black_box)
        scattered = jnp.concatenate([factor, logs], axis=1)
        return centre[None] + scattered.at[0].set(0.0)

    def _centre(self, black_box: StateSpace) -> Parameters:
        """Sizes of W, k and λ from the poles: gains move real poles, stiffnesses the fast ones.

        Joint rates are about λ W_θθ and squared frequencies k W_vv; a deflection v moves the
        link's end by ℓ² v, an angle by ℓ θ, which gives W_vv / W_θθ ≈ (k₀/ℓ)² with k₀ about 3
        for a uniform link.
        """
        size = jnp.sort(jnp.abs(black_box.poles()))
        rate = jnp.exp(jnp.mean(jnp.log(jnp.maximum(size, 1e-3 * size[-1]))))
        lengths = jnp.asarray(self.lengths)
        mobility = jnp.concatenate([jnp.ones(2), (3.0 / lengths) ** 2])
        stiffness = rate**2 / mobility[2:]
        gains = rate / mobility[:2]
        diagonal = 0.5 * jnp.log(mobility)
        factor = jnp.zeros((4, 4)).at[jnp.diag_indices(4)].set(diagonal)
        return jnp.concatenate([factor[_LOWER], jnp.log(stiffness), jnp.log(gains)])


def _unit_scales() -> ArmScales:
    return ArmScales(jnp.ones(4), jnp.ones(2), jnp.ones(2))


def two_link_arm_structure(
    *, lengths: tuple[float, float], scales: ArmScales | None = None
) -> TwoLinkArmStructure:
    """Structure (32) of a two-link flexible arm with links of known `lengths` in metres.

    Args:
        lengths: of both links, m.
        scales: roughly how large mobility, stiffness and gains are; without it the starts are
            scattered more widely, about sizes read off the black box.

    Raises:
        ValueError: a length or a scale is not positive, or a scale has the wrong length.

    Source: 001, equations 30 to 32 (indices of the printed equation corrected).

    Example:
        >>> two_link_arm_structure(lengths=(0.35, 0.30)).parameter_names[0]
        'theta 1'
    """
    if len(lengths) != 2 or min(lengths) <= 0:
        raise ValueError(f"lengths: two positive numbers (metres) are needed, got {lengths}.")
    if scales is not None:
        scales = ArmScales(
            mobility=_positive("mobility", scales.mobility, 4),
            stiffness=_positive("stiffness", scales.stiffness, 2),
            gains=_positive("gains", scales.gains, 2),
        )
    return TwoLinkArmStructure((float(lengths[0]), float(lengths[1])), scales)


def _positive(name: str, value: ArrayLike, count: int) -> Array:
    array = jnp.asarray(value, float)
    known = not isinstance(array, Tracer)
    if array.shape != (count,) or (known and not bool(jnp.all(array > 0))):
        raise ValueError(f"scales: {name} must hold {count} positive numbers, got {value}.")
    return array
