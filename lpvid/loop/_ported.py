"""Quasi-linear models with ports: the places where an effect may act on them."""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData


class Ports(eqx.Module):
    """Continuous-time matrices at one κ, and how effects read the state and act on it.

    ẋ = A x + B u + Σ_j E_j f_j, y = C x + D u, with the generalised force f_j on coordinate j,
    whose position is q_j = `position`[j] x and whose rate is q̇_j = `velocity`[j] x. The force that
    the model itself transmits at coordinate j is `load_state`[j] x + `load_input`[j] u. A force's
    sign is that of M q̈ = … + f: friction is negative where the velocity is positive. On a relative
    coordinate (a spring's length, a joint's twist q_1 − q_2) a force is a pair, f on body 1 and −f
    on body 2.

    A row of zeros says that the model does not know the signal.

    Attributes:
        A: (state, state).
        B: (state, input).
        C: (output, state).
        D: (output, input).
        force: E (coordinate, state, direction). One direction where physics gives it; the identity,
            one direction a state, in a black box, where it is free.
        position: (coordinate, state).
        velocity: (coordinate, state).
        load_state: (coordinate, state).
        load_input: (coordinate, input).
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state nu"]
    C: Float[Array, "ny state"]
    D: Float[Array, "ny nu"]
    force: Float[Array, "coordinate state direction"]
    position: Float[Array, "coordinate state"]
    velocity: Float[Array, "coordinate state"]
    load_state: Float[Array, "coordinate state"]
    load_input: Float[Array, "coordinate nu"]


class Labels(NamedTuple):
    """Names and units of what a structure has, units as text and empty where there is none.

    Attributes:
        inputs: one for each input.
        input_units: their units.
        outputs: one for each output.
        output_units: their units.
        parameters: one for each entry of θ.
        parameter_units: their units.
        coordinates: one for each coordinate that a force may act on.
        coordinate_units: units of their positions.
        force_units: units of the generalised forces on them.
    """

    inputs: tuple[str, ...]
    input_units: tuple[str, ...]
    outputs: tuple[str, ...]
    output_units: tuple[str, ...]
    parameters: tuple[str, ...]
    parameter_units: tuple[str, ...]
    coordinates: tuple[str, ...]
    coordinate_units: tuple[str, ...]
    force_units: tuple[str, ...]


class AbstractPortedStructure(eqx.Module):
    """A parameterised quasi-linear model, with ports, that takes its start from data.

    Parameters are plain numbers in their units, so that θ_i (1 + a φ) scales the physical quantity;
    they may differ by many orders of magnitude, so whoever searches over them scales them.

    Attributes:
        name: as in the report, `servo`.
        labels: names and units.
    """

    name: eqx.AbstractVar[str]
    labels: eqx.AbstractVar[Labels]

    @property
    def input_names(self) -> tuple[str, ...]:
        """One for each input."""
        return self.labels.inputs

    @property
    def input_units(self) -> tuple[str, ...]:
        """One for each input."""
        return self.labels.input_units

    @property
    def output_names(self) -> tuple[str, ...]:
        """One for each output."""
        return self.labels.outputs

    @property
    def output_units(self) -> tuple[str, ...]:
        """One for each output."""
        return self.labels.output_units

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """One for each entry of θ."""
        return self.labels.parameters

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """One for each entry of θ."""
        return self.labels.parameter_units

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """One for each coordinate that a force may act on."""
        return self.labels.coordinates

    @property
    def coordinate_units(self) -> tuple[str, ...]:
        """Units of the coordinates' positions."""
        return self.labels.coordinate_units

    @property
    def force_units(self) -> tuple[str, ...]:
        """Units of the generalised forces on the coordinates."""
        return self.labels.force_units

    @abc.abstractmethod
    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ and κ; composes with jit, vmap and grad.

        Args:
            theta: θ (parameter,).
            kappa: κ (nk,); empty where the model does not depend on it.
        """

    @abc.abstractmethod
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest θ, (parameter,) each; infinite where there is no bound."""

    @abc.abstractmethod
    def start(self, data: IOData) -> np.ndarray:
        """θ (parameter,) from records alone, near enough to be refined from.

        Args:
            data: records of the plant; effects and offsets may be in them.
        """
