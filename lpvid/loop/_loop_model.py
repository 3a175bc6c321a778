"""The model that a closed loop leaves behind: structure, parameters and effects, ready to use."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from lpvid._results import Status
from lpvid.control import ClosedLoopMotion
from lpvid.data import IOData
from lpvid.loop._assess import free_run, robust_covariance
from lpvid.loop._checks import checked_fit
from lpvid.loop._numbers import parameter_numbers, seated_effect
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop._program import Feedback, Records
from lpvid.loop._records import records_of
from lpvid.loop._result import EstimatedNumber, SeatedEffect
from lpvid.loop._rounds import held_out_errors
from lpvid.loop._search import run
from lpvid.loop._tune import Fitted, refit, simulation_fit, with_starts
from lpvid.mechanics import SampledController


class LoopModel(NamedTuple):
    """A structure with its parameters and effects, as `close_the_loop` found them.

    Attributes:
        fitted: everything estimated, and the predictor's gain.
        nodes: of the scheduling that the gain is known at (node, nk).
        duration: s over which what follows "time" goes from its first to its last value.
        schedules: names of what a strength may follow.
        covariance: of everything estimated, robust to autocorrelation.

    Example:
        >>> from lpvid import IOData, close_the_loop
        >>> u = np.repeat(np.random.default_rng(0).standard_normal(60), 10)
        >>> y = np.zeros(600)
        >>> for k in range(599):
        ...     y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
        >>> noisy = y + 1e-3 * np.random.default_rng(1).standard_normal(600)
        >>> data = IOData(u=u, y=noisy, dt=0.05)
        >>> model = close_the_loop("black-box", data, laws=()).model
        >>> bool(np.std(model.simulate(data)[:, 0] - y) < 5e-4)
        True
    """

    fitted: Fitted
    nodes: np.ndarray
    duration: float
    schedules: tuple[str, ...]
    covariance: np.ndarray

    @property
    def structure(self) -> AbstractPortedStructure:
        """The structure, without its parameters."""
        return self.fitted.setting.structure

    @property
    def parameters(self) -> np.ndarray:
        """ϑ (parameter,), in the order of `structure.parameter_names`."""
        return np.asarray(self.fitted.unknowns.theta)

    @property
    def estimates(self) -> tuple[EstimatedNumber, ...]:
        """The parameters by name, with standard errors and units."""
        return parameter_numbers(self.fitted, self.covariance)

    @property
    def effects(self) -> tuple[SeatedEffect, ...]:
        """The effects in the model, with their numbers."""
        return tuple(
            seated_effect(self.fitted, self.covariance, slot, self.schedules)
            for slot in range(len(self.fitted.places))
        )

    def simulate(
        self, data: IOData, *, initial_states: Float[ArrayLike, "record state"] | None = None
    ) -> np.ndarray:
        """Response to the inputs of records, effects included; nothing measured is fed back.

        Args:
            data: records like those that the model was found on; their time starts at zero. A
                schedule that leaves the range of those is held at its end.
            initial_states: of each record, in the structure's states; fitted to the records if
                `None`.

        Returns:
            Outputs (time, ny), of one record after the other.

        Raises:
            ValueError: channels or sample time do not suit, or the states' shape is wrong.
        """
        records = self._records(data)
        if initial_states is None:
            return free_run(self.fitted, records)
        starts = jnp.asarray(initial_states, float)
        wanted = (len(data.lengths), self.fitted.unknowns.start.shape[1])
        if starts.shape != wanted:
            raise ValueError(
                f"initial_states: {wanted} numbers are needed, one row for each record; got shape "
                f"{starts.shape}."
            )
        unknowns = eqx.tree_at(lambda tree: tree.start, self.fitted.unknowns, starts)
        none = jnp.zeros_like(self.fitted.gain)
        out = run(self.fitted.setting, records, self.fitted.slots, unknowns, none)
        return np.asarray(records.y - out.innovations)

    def predict(self, data: IOData) -> np.ndarray:
        """One-step predictions (time, ny), initial states fitted to the records.

        Args:
            data: records like those that the model was found on.

        Raises:
            ValueError: channels or sample time do not suit.
        """
        return np.asarray(data.y) - held_out_errors(self.fitted, self._records(data))

    def refine(self, data: IOData, *, simulation: bool = False) -> "LoopModel":
        """The same model, its parameters and effects fitted again to other or longer records.

        A search over many laws is best made on a part of a long record; what it found is then
        fitted to all of it. Held-out data stay held out only if they are not among the records.

        Args:
            data: records like those that the model was found on.
            simulation: whether the error of simulation is minimised, nothing measured fed back, in
                place of the one-step predictor's. It weighs what the model lacks by how far that
                carries, and asks for a stable plant.

        Raises:
            ValueError: channels or sample time do not suit.
            DataError: the errors are not finite, as where an unstable model is simulated.
        """
        records, old = self._records(data), self.fitted
        begun = old._replace(unknowns=with_starts(old, records))
        if not simulation:
            refined = refit(begun, records, old.ratio, old.ratios)
        else:
            refined = simulation_fit(begun, records)
        checked_fit(refined.searched.log_likelihood, self.structure)
        return loop_model(refined, self.nodes, self.duration, self.schedules)

    def simulate_closed_loop(
        self,
        controller: SampledController,
        *,
        reference: Float[ArrayLike, "time *nr"],
        kappa: Float[ArrayLike, "time *nk"] | None = None,
        initial_states: Float[ArrayLike, " state"] | None = None,
    ) -> ClosedLoopMotion:
        """Motion under a sampled controller, effects included, from rest.

        The controller reads the model's outputs at every sample; its command acts at once and is
        held until the next one.

        Args:
            controller: any `SampledController`.
            reference: set-points (time,) or (time, nr), at the model's sample time.
            kappa: scheduling signals (time,) or (time, nk) of a model that has any.
            initial_states: in the structure's states; zero if `None`.

        Raises:
            ValueError: shapes that do not suit, or an output that depends on the command at once.
        """
        wanted = jnp.asarray(reference, float)
        wanted = wanted[:, None] if wanted.ndim == 1 else wanted
        samples = wanted.shape[0]
        structure, unknowns = self.structure, self.fitted.unknowns
        theta, node = unknowns.theta, jnp.asarray(self.nodes[0])
        if np.any(np.asarray(structure.ports(theta, node).D)):
            raise ValueError(
                "The model has feedthrough: its output depends on the command that is computed "
                "from it. Use a structure without."
            )
        still = IOData(
            u=np.zeros((samples, len(structure.input_names))),
            y=np.zeros((samples, len(structure.output_names))),
            dt=self.fitted.setting.dt,
            kappa=kappa,
        )
        states = unknowns.start.shape[1]
        start = jnp.zeros(states) if initial_states is None else jnp.asarray(initial_states, float)
        if start.shape != (states,):
            raise ValueError(f"initial_states: {states} numbers are needed, got {start.shape}.")
        out = run(
            self.fitted.setting,
            self._records(still),
            self.fitted.slots,
            eqx.tree_at(lambda tree: tree.start, unknowns, start[None]),
            jnp.zeros_like(self.fitted.gain),
            Feedback(controller, wanted),
        )
        finite = jnp.all(jnp.isfinite(out.innovations))
        return ClosedLoopMotion(
            reference=wanted,
            u=out.u,
            # Against measurements of zero.
            y=-out.innovations,
            states=out.before,
            status=Status.where(finite, Status.successful, Status.nonfinite),
            dt=self.fitted.setting.dt,
        )

    def _records(self, data: IOData) -> Records:
        structure, dt = self.structure, self.fitted.setting.dt
        channels = len(structure.input_names), len(structure.output_names)
        if (data.nu, data.ny) != channels:
            raise ValueError(
                f"data: {channels[0]} inputs and {channels[1]} outputs are needed, got {data.nu} "
                f"and {data.ny}."
            )
        if not np.isclose(data.dt, dt, rtol=1e-6):
            raise ValueError(
                f"data: the model holds its inputs over {dt} s, the records are sampled at "
                f"{data.dt} s; resample them."
            )
        scheduling = 0 if data.kappa is None else np.asarray(data.kappa).shape[1]
        if scheduling != self.nodes.shape[1]:
            raise ValueError(
                f"data: {self.nodes.shape[1]} scheduling signals are needed, got {scheduling}."
            )
        hold = self.fitted.setting.hold
        return records_of(data, self.nodes, self.duration, hold=hold)


def loop_model(
    fitted: Fitted, nodes: np.ndarray, duration: float, schedules: tuple[str, ...]
) -> LoopModel:
    """The model without the derivatives that only its search and covariance needed.

    Args:
        fitted: the model.
        nodes: of the scheduling.
        duration: s of the schedule "time".
        schedules: names of what a strength may follow.
    """
    covariance = robust_covariance(fitted)
    searched = fitted.searched._replace(columns=np.zeros((0, 0, 0)))
    return LoopModel(fitted._replace(searched=searched), nodes, duration, schedules, covariance)
