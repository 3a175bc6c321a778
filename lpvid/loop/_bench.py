"""What one call of `close_the_loop` works with."""

import dataclasses

import numpy as np

from lpvid.data import IOData
from lpvid.loop._assess import noise_in
from lpvid.loop._noise_floor import NoiseFloor
from lpvid.loop._program import Records, Setting


@dataclasses.dataclass(frozen=True)
class Bench:
    """Everything one call works with.

    Attributes:
        setting: structure, laws, sample time.
        data: estimation records and held-out records.
        train: estimation records for the predictor.
        held_out: data that took no part.
        schedules: names of what a parameter may follow.
        duration: s over which what follows time goes from −1 to 1.
        first_sample: of the held-out data in the record they come from.
        floor: noise measured from periods or repeats, if there are any.
    """

    setting: Setting
    data: tuple[IOData, IOData]
    train: Records
    held_out: Records
    schedules: tuple[str, ...]
    duration: float
    first_sample: int
    floor: NoiseFloor | None

    def noise(self, *residuals: np.ndarray) -> np.ndarray:
        """Noise floor (ny,): measured, or the least that residuals show.

        Args:
            residuals: (time, ny) each.
        """
        if self.floor is not None:
            return self.floor.spread
        return np.min([noise_in(residual) for residual in residuals], axis=0)
