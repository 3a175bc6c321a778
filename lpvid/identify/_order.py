"""The order from the singular values."""

import numpy as np
from jaxtyping import Float

# Singular values below this share of the largest are rounding: no gap is looked for among them.
_FLOOR = 1e-11


def choose_order(singular_values: Float[np.ndarray, " row"], largest: int) -> int:
    """Order after which the singular values fall most, as a ratio, up to `largest`."""
    floored = np.maximum(singular_values, _FLOOR * singular_values[0])
    largest = min(largest, floored.shape[0] - 1)
    return int(np.argmax(floored[:largest] / floored[1 : largest + 1])) + 1
