"""Fixed and tied values, and the local coordinates of a black box."""

from collections.abc import Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Ties = Sequence[str | Sequence[str]]

_MOST_NAMES = 20


class Selection(eqx.Module):
    """Values as a function of fewer: values = constant + matrix · chosen.

    Attributes:
        constant: fixed values, zero elsewhere.
        matrix: a column for every value (or group of tied values) that is estimated.
    """

    constant: Float[Array, " value"]
    matrix: Float[Array, "value chosen"]

    def chosen(self, values: Float[Array, " value"]) -> Float[Array, " chosen"]:
        """The estimated values; of tied ones the mean."""
        return (self.matrix.T @ values) / jnp.sum(self.matrix, axis=0)

    def values(self, chosen: Float[Array, " chosen"]) -> Float[Array, " value"]:
        """All values."""
        return self.constant + self.matrix @ chosen


def matching(names: tuple[str, ...], pattern: str, argument: str) -> list[int]:
    """Indices of the names that a pattern with * and ? matches.

    Raises:
        ValueError: none does.
    """
    # Brackets belong to names such as A[0,1].
    escaped = pattern.replace("[", "[[]")
    found = [i for i, name in enumerate(names) if fnmatchcase(name, escaped)]
    if not found:
        raise ValueError(
            f"{argument}: no parameter is called {pattern!r} (* and ? are wildcards); there are "
            f"{_some(names, pattern)}."
        )
    return found


def _some(names: tuple[str, ...], pattern: str) -> str:
    """All names, or of many those most like the pattern and how many there are."""
    if len(names) <= _MOST_NAMES:
        return ", ".join(names)
    alike = get_close_matches(pattern, names, n=_MOST_NAMES // 2, cutoff=0.5)
    shown = alike + [name for name in names if name not in alike][: _MOST_NAMES - len(alike)]
    return f"{', '.join(shown)} and {len(names) - len(shown)} more"


def select(
    names: tuple[str, ...], values: Float[Array, " value"], fixed: Sequence[str], tied: Ties
) -> Selection:
    """Read `fixed` and `tied`.

    Raises:
        ValueError: a pattern matches nothing, a value is tied twice or both tied and fixed, or
            nothing is left to estimate.
    """
    if isinstance(fixed, str) or isinstance(tied, str):
        raise ValueError("fixed, tied: give a sequence of patterns, such as ('mass *',).")
    held = {i for pattern in fixed for i in matching(names, pattern, "fixed")}
    groups: list[list[int]] = []
    seen: set[int] = set()
    for entry in tied:
        patterns = [entry] if isinstance(entry, str) else list(entry)
        group = sorted({i for pattern in patterns for i in matching(names, pattern, "tied")})
        clash = [names[i] for i in group if i in seen or i in held]
        if clash:
            raise ValueError(
                f"tied: {', '.join(clash)} is fixed, or tied twice; name it in one place only."
            )
        seen.update(group)
        groups.append(group)
    leaders = {group[0]: group for group in groups}
    columns = []
    for i in range(len(names)):
        members = leaders.get(i, [] if i in seen or i in held else [i])
        if members:
            column = np.zeros(len(names))
            column[members] = 1.0
            columns.append(column)
    if not columns:
        raise ValueError("fixed: every parameter is fixed; leave one to be estimated.")
    mask = np.zeros(len(names))
    mask[sorted(held)] = 1.0
    constant = values * jnp.asarray(mask) if held else jnp.zeros(len(names))
    return Selection(constant, jnp.asarray(np.stack(columns, axis=1)))


def _outside(matrix: Array, gauge: Array) -> Array:
    """The part of the gauge that the selected values cannot follow."""
    orthonormal = matrix / jnp.linalg.norm(matrix, axis=0, keepdims=True)
    return gauge - orthonormal @ (orthonormal.T @ gauge)


def complement(
    selection: Selection, gauge: Float[Array, "value direction"], units: Array, remaining: int
) -> Float[Array, "chosen coordinate"]:
    """Orthonormal directions of the chosen values, orthogonal to what the gauge can move.

    The local coordinates of McKelvey, Helmersson and Ribarits (2004), Automatica 40: only these
    directions change the model, the others its basis.
    """
    size = jnp.linalg.norm(selection.matrix / units[:, None], axis=0)
    orthonormal = selection.matrix / units[:, None] / size[None, :]
    count = gauge.shape[1]
    if remaining < count:
        _, _, right = jnp.linalg.svd(_outside(orthonormal, gauge), full_matrices=True)
        gauge = gauge @ right[count - remaining :].T
    tangent = orthonormal.T @ gauge
    basis = jnp.linalg.qr(tangent, mode="complete")[0][:, remaining:]
    return basis / size[:, None]
