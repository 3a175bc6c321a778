"""A structure of the user's own, from a function."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._windows import windows_of

_GUESSES = 32
_SCATTER = 0.7


class FunctionPorted(AbstractPortedStructure):
    """A structure of one's own: a function of θ and κ that gives the matrices and the ports.

    Args:
        function: (θ (parameter,), κ (nk,)) → `Ports`, in JAX.
        parameters: names and nominal values, which a search starts about; a positive nominal value
            stays positive, any other is free.
        data: records, for the names and units of the channels.
        coordinates: names, one for each coordinate that a force may act on.
        parameter_units: one for each parameter; empty by default.
        coordinate_units: one for each coordinate; empty by default.
        force_units: one for each coordinate; empty by default.
        name: as in the report.

    Raises:
        ValueError: what the function gives does not fit the channels or the coordinates.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import FunctionPorted, Ports
        >>> def cart(theta, kappa):
        ...     speed = jnp.ones((1, 1))
        ...     return Ports(
        ...         A=-theta[1] / theta[0] * speed, B=speed / theta[0], C=speed, D=0 * speed,
        ...         force=(speed / theta[0])[None], position=0 * speed, velocity=speed,
        ...         load_state=0 * speed, load_input=speed,
        ...     )
        >>> data = IOData(u=np.zeros(9), y=np.zeros(9), dt=0.1)
        >>> own = FunctionPorted(cart, {"mass": 2.0, "friction": 1.0}, data, coordinates=["cart"])
        >>> own.parameter_names
        ('mass', 'friction')
    """

    function: Callable[[Array, Array], Ports] = eqx.field(static=True)
    nominal: tuple[float, ...] = eqx.field(static=True)
    labels: Labels = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        function: Callable[[Array, Array], Ports],
        parameters: Mapping[str, float],
        data: IOData,
        *,
        coordinates: Sequence[str],
        parameter_units: Sequence[str] | None = None,
        coordinate_units: Sequence[str] | None = None,
        force_units: Sequence[str] | None = None,
        name: str = "user's own",
    ):
        self.function = function
        self.nominal = tuple(float(value) for value in parameters.values())
        self.name = name
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=tuple(parameters),
            parameter_units=_units("parameter_units", parameter_units, len(parameters)),
            coordinates=tuple(coordinates),
            coordinate_units=_units("coordinate_units", coordinate_units, len(coordinates)),
            force_units=_units("force_units", force_units, len(coordinates)),
        )
        made = jax.eval_shape(function, jnp.zeros(len(self.nominal)), jnp.zeros(data.nk))
        n = made.A.shape[0]
        count = len(coordinates)
        wanted = {
            "A": (n, n),
            "B": (n, data.nu),
            "C": (data.ny, n),
            "D": (data.ny, data.nu),
            "force": (count, n, *made.force.shape[2:3]),
            "position": (count, n),
            "velocity": (count, n),
            "load_state": (count, n),
            "load_input": (count, data.nu),
        }
        for field, shape in wanted.items():
            if getattr(made, field).shape != shape:
                raise ValueError(
                    f"function: {field} has shape {getattr(made, field).shape}, but {shape} fits "
                    f"{n} states, the data's channels and {count} coordinates."
                )

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """What the function gives."""
        return self.function(theta, kappa)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Positive nominal values stay positive."""
        nominal = np.array(self.nominal)
        return np.where(nominal > 0.0, 1e-9 * nominal, -np.inf), np.full(len(nominal), np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ by a search from points scattered about the nominal ones."""
        nominal = np.array(self.nominal)
        states = self.ports(jnp.asarray(nominal), jnp.zeros(data.nk)).A.shape[0]
        scattered = np.random.default_rng(0).standard_normal((_GUESSES, len(nominal)))
        scattered[0] = 0.0
        guesses = nominal * np.exp(_SCATTER * scattered)
        return best_start(window_error(self, windows_of(data, states)), guesses)[0]


def _units(argument: str, given: Sequence[str] | None, count: int) -> tuple[str, ...]:
    units = ("",) * count if given is None else tuple(given)
    if len(units) != count:
        raise ValueError(f"{argument}: {count} are needed, got {len(units)}: {', '.join(units)}.")
    return units
