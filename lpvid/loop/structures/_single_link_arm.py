"""A hub that carries a flexible link: clamped modes as appendages."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._channels import require_channels
from lpvid.loop.structures._regression import drive_sign, least_squares, moments, rigid_body
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._units import per, times
from lpvid.loop.structures._windows import Windows, windows_of

_MOST_OUTPUTS = 6
_SHARES = (0.1, 0.3, 0.6)
_FREQUENCIES = 12
_MODES = (1, 2, 3)
# A mode more is worth it from this drop of the mean log squared error on.
_WORTH = 0.5


class FlexibleLink(AbstractPortedStructure):
    r"""A driven hub with clamped modes: hub angle, and strains or deflections where measured.

    J θ̈ + c θ̇ = ± u + Σ τ_i, τ_i = J_i (ω_i² η_i + 2 ζ_i ω_i η̇_i), η̈_i + θ̈ = −τ_i / J_i: each
    clamped mode is an inertia J_i on a spring, η_i its deflection as an angle, which is what a
    uniform beam's modes come to when their amplitudes are scaled so. What the drive makes of the
    input cannot be told from the inertias, so all are for one unit of the input. Every further
    output has its own gain for each mode; one whose name begins with "tacho" reads the hub's speed.
    Coordinates: hub and first mode's deflection, where a force is a pair.
    States [θ, θ + η_1, …, θ̇, θ̇ + η̇_1, …].

    Args:
        data: records, for the names and units of one input and of the outputs, hub angle first,
            and for the sign of the input.
        modes: number of flexible modes, 1 to 3; as many as the prediction error asks for when left
            out.

    Raises:
        ValueError: the numbers of inputs, outputs or modes do not fit.

    Source: 002, section 2.3.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import FlexibleLink
        >>> u = np.repeat(np.random.default_rng(0).standard_normal(30), 10)
        >>> data = IOData(u=u, y=0.01 * np.cumsum(np.cumsum(u)), dt=0.1, names={"y": "hub"})
        >>> FlexibleLink(data).parameter_names[:3]
        ('hub inertia', 'viscous friction', 'frequency 1')
    """

    labels: Labels = eqx.field(static=True)
    modes: int = eqx.field(static=True)
    rates: tuple[bool, ...] = eqx.field(static=True)
    sign: float
    name: str = eqx.field(default="single-link-arm", static=True)

    def __init__(self, data: IOData, *, modes: int | None = None):
        require_channels(data, self.name, inputs=1, outputs=range(1, _MOST_OUTPUTS + 1))
        if modes not in (None, *_MODES):
            raise ValueError(f"modes={modes}: give 1, 2 or 3.")
        self.modes = modes = _chosen_modes(data) if modes is None else modes
        self.rates = tuple(name.lower().startswith("tacho") for name in data.output_names[1:])
        force, position = data.input_units[0], data.output_units[0]
        inertia, damping = per(times(force, "s²"), position), per(times(force, "s"), position)
        names, units = ["hub inertia", "viscous friction"], [inertia, damping]
        for mode in range(1, modes + 1):
            names += [f"frequency {mode}", f"damping ratio {mode}", f"modal inertia {mode}"]
            units += ["rad/s", "", inertia]
        further = zip(data.output_names[1:], data.output_units[1:], self.rates, strict=True)
        for output, unit, rate in further:
            count = 1 if rate else modes
            names += [f"gain of {output}" + ("" if rate else f" {k + 1}") for k in range(count)]
            units += [per(times(unit, "s") if rate else unit, position)] * count
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=tuple(names),
            parameter_units=tuple(units),
            coordinates=("hub", "first mode"),
            coordinate_units=(position,) * 2,
            force_units=(force,) * 2,
        )
        self.sign = drive_sign(data)

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ: J, c, then ω, ζ, J_i of each mode, then the outputs' gains."""
        del kappa
        m = self.modes
        omega, zeta, inertias = jnp.moveaxis(theta[2 : 2 + 3 * m].reshape(m, 3), 1, 0)
        mobility = 1.0 / jnp.concatenate([theta[:1], inertias])
        # Each row is one mode's deflection.
        bent = np.concatenate([-np.ones((m, 1)), np.eye(m)], axis=1)
        stiff, lossy = inertias * omega**2, 2.0 * inertias * zeta * omega
        stiffness = bent.T @ (stiff[:, None] * bent)
        damping = bent.T @ (lossy[:, None] * bent)
        damping = damping.at[0, 0].add(theta[1])
        still, unit, blank = jnp.zeros((m + 1, m + 1)), jnp.eye(m + 1), jnp.zeros((2, m + 1))
        C = [jnp.eye(1, 2 * m + 2)[0]]
        first = 2 + 3 * m
        for rate in self.rates:
            if rate:
                C.append(theta[first] * jnp.eye(2 * m + 2)[m + 1])
                first += 1
            else:
                C.append(jnp.concatenate([theta[first : first + m] @ bent, jnp.zeros(m + 1)]))
                first += m
        readings = jnp.asarray(np.stack([np.eye(m + 1)[0], bent[0]]))
        elastic = jnp.concatenate([stiff[0] * readings[1], lossy[0] * readings[1]])
        return Ports(
            A=jnp.block(
                [[still, unit], [-mobility[:, None] * stiffness, -mobility[:, None] * damping]]
            ),
            B=jnp.zeros((2 * m + 2, 1)).at[m + 1, 0].set(self.sign * mobility[0]),
            C=jnp.stack(C),
            D=jnp.zeros((len(C), 1)),
            force=jnp.concatenate([blank, readings * mobility[None]], axis=1)[:, :, None],
            position=jnp.concatenate([readings, blank], axis=1),
            velocity=jnp.concatenate([blank, readings], axis=1),
            load_state=jnp.stack([jnp.zeros(2 * m + 2), elastic]),
            load_input=jnp.zeros((2, 1)).at[0, 0].set(self.sign),
        )

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Inertias and frequencies are positive."""
        lower = np.full(len(self.labels.parameters), -np.inf)
        lower[0] = 1e-15
        for mode in range(self.modes):
            lower[2 + 3 * mode], lower[4 + 3 * mode] = 1e-6, 1e-15
        return lower, np.full(len(lower), np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ from modes tried over the band one after the other."""
        return self._found(data, windows_of(data, self._states))[0]

    def _found(self, data: IOData, windows: list[Windows]) -> tuple[np.ndarray, float]:
        if self.modes == 1:
            guesses = self._first_guesses(windows)
        else:
            fewer = FlexibleLink(data, modes=self.modes - 1)
            guesses = self._guesses_from(fewer._found(data, windows)[0], windows)
        return best_start(window_error(self, windows), np.array(guesses))

    @property
    def _states(self) -> int:
        return 2 * (self.modes + 1)

    def _first_guesses(self, windows: list[Windows]) -> list[np.ndarray]:
        ny = len(self.labels.outputs)
        known = [moments(entry, 1, ny) for entry in windows]
        rigid = np.abs(rigid_body(windows, ny=ny))
        guesses = []
        for omega in _band(windows):
            # Where a period of the mode spans about twelve samples.
            fitting = int(np.argmin([abs(np.log(omega * entry.step / 0.5)) for entry in windows]))
            here = known[fitting]
            gains = []
            for output, rate in enumerate(self.rates, 1):
                if rate:
                    target, regressor = here.positions[output], here.velocities[0]
                else:
                    regressor = -here.accelerations[0]
                    target = here.accelerations[output] + omega**2 * here.positions[output]
                    target = target + 0.04 * omega * here.velocities[output]
                gains.append(float(least_squares(regressor[:, None], target)[0]))
            for inertia, friction in rigid[[0, len(rigid) // 2, -1]]:
                for share in _SHARES:
                    mode = [omega, 0.02, share * inertia]
                    guesses.append([(1.0 - share) * inertia, friction, *mode, *gains])
        return [np.array(guess) for guess in guesses]

    def _guesses_from(self, fewer: np.ndarray, windows: list[Windows]) -> list[np.ndarray]:
        m = self.modes
        head, tail = fewer[: 3 * m - 1], fewer[3 * m - 1 :]
        guesses = []
        for omega in _band(windows):
            for share in _SHARES:
                for factor in (0.3, -0.3):
                    gains, first = [], 0
                    for rate in self.rates:
                        own = tail[first : first + (1 if rate else m - 1)]
                        first += len(own)
                        gains += [*own] if rate else [*own, factor * own[0]]
                    mode = [omega, 0.02, share * head[0]]
                    hub = [(1.0 - share) * head[0], *head[1:]]
                    guesses.append(np.array([*hub, *mode, *gains]))
        return guesses


def _band(windows: list[Windows]) -> np.ndarray:
    longest = windows[-1].step * windows[-1].samples
    return np.geomspace(2.0 / longest, 2.5 / windows[0].step, _FREQUENCIES)


def _chosen_modes(data: IOData) -> int:
    windows = windows_of(data, 2 * (_MODES[-1] + 1))
    chosen, least = 0, np.inf
    for modes in _MODES:
        score = FlexibleLink(data, modes=modes)._found(data, windows)[1]
        if score > least - _WORTH:
            break
        chosen, least = modes, score
    return chosen
