"""What a method for settling records is given, and what it returns."""

import abc

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int


class Experiments(eqx.Module):
    """Settling records from the instant their inputs first move, all padded to one length.

    Attributes:
        u: inputs, (record, time, nu); beyond a record's end its final value.
        y: outputs, (record, time, ny); beyond a record's end its final value.
        lengths: samples of each record that were measured.
        window: first sample of the settled window of each record.
        settling: first sample from which a record lies within a thousandth of its range, or within
            the noise, of its final values.
        inputs_settled: first sample from which the inputs of a record keep that close to theirs.
        final_u: means over the settled window, (record, nu).
        final_y: means over the settled window, (record, ny).
        combination: right inverse of the matrix of final inputs, (record, nu): what the records are
            multiplied by to make U(∞) = I.
        noise: standard deviation of each output over the settled windows.
        dt: sample time in seconds.
    """

    u: Float[Array, "record time nu"]
    y: Float[Array, "record time ny"]
    lengths: Int[Array, " record"]
    window: Int[Array, " record"]
    settling: Int[Array, " record"]
    inputs_settled: Int[Array, " record"]
    final_u: Float[Array, "record nu"]
    final_y: Float[Array, "record ny"]
    combination: Float[Array, "record nu"]
    noise: Float[Array, " ny"]
    dt: float = eqx.field(static=True)


class Realisation(eqx.Module):
    """What a method makes of the experiments.

    Attributes:
        A: state matrix of the continuous-time model; B, C, D the others.
        B: input matrix.
        C: output matrix.
        D: feedthrough.
        moments: ρ_0, ρ_1, … as far as the method uses them, (moment, ny, nu).
        moments_std: their standard deviations, of white output noise.
        singular_values: of the Hankel matrix, largest first.
        floor: singular values below this are what noise or rounding would make.
        resolved: whether the smallest singular value in use lies above it.
        poles_moved: poles that had to be moved to make the model stable or real.
    """

    A: Float[Array, "nx nx"]
    B: Float[Array, "nx nu"]
    C: Float[Array, "ny nx"]
    D: Float[Array, "ny nu"]
    moments: Float[Array, "moment ny nu"]
    moments_std: Float[Array, "moment ny nu"]
    singular_values: Float[Array, " row"]
    floor: Float[Array, ""]
    resolved: Bool[Array, ""]
    poles_moved: Int[Array, ""]


class AbstractStepMethod(eqx.Module):
    """A method for records that settle: from the experiments to a model of a given order.

    `identify_step_response` checks the records, finds their settled windows and final values, and
    asks the method for the rest. See `PrimalRealisation`, `DualRealisation`, `DeviationSubspace`.

    Example:
        >>> from lpvid.identify import AbstractStepMethod, DeviationSubspace
        >>> isinstance(DeviationSubspace(), AbstractStepMethod)
        True
    """

    @abc.abstractmethod
    def largest_order(self, ny: int, nu: int, time: int) -> int:
        """Largest order that records of so many channels and samples can carry."""

    @abc.abstractmethod
    def realise(self, experiments: Experiments, order: int) -> Realisation:
        """The continuous-time model of `order` states."""
