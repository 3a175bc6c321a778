"""Black boxes of the study: every noise realisation of every local record identified."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from lpvid import montecarlo
from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import PastInputMOESP, identify
from lpvid.mechanics import add_noise
from lpvid.models import AlignedAverage, StateSpace, average, d2c

_ORDER = 6
# Sixty samples of 1 ms span the arm's slowest time constant (46 ms): with fewer, the low
# frequencies come out several per cent wrong.
_BLOCK_ROWS = 60
_SNR_DB = 30.0


class BlackBox(eqx.Module):
    """What one run of the identification gives.

    Attributes:
        model: continuous-time model of order 6.
        status: how the identification ended.
    """

    model: StateSpace
    status: Status


class Identification(eqx.Module):
    """A pipeline: noise onto a record, PI-MOESP, continuous time (001, section 3.3.1).

    Attributes:
        template: a record of the study; its signals are replaced, its schedule is not looked at.
    """

    template: IOData

    def __call__(self, key: PRNGKeyArray, point: dict) -> BlackBox:
        """The black box of one noise realisation at one point."""
        noisy = add_noise(key, point["y"], _SNR_DB)
        method = PastInputMOESP(order=_ORDER, block_rows=_BLOCK_ROWS)
        fit = identify(self.template.replace(u=point["u"], y=noisy), method, throw=False)
        return BlackBox(d2c(fit.model), fit.status)


def identify_runs(
    local: IOData, key: PRNGKeyArray, runs: int, *, progress: bool
) -> tuple[montecarlo.Study, IOData]:
    """All black boxes (point, run), and the first run's noisy records.

    Args:
        local: noise-free records, one for each point.
        key: random key of the noise.
        runs: noise realisations for each point.
        progress: whether to show a bar.
    """
    keys = jax.random.split(key, runs)
    records = local.records
    points = {name: jnp.stack([getattr(r, name) for r in records]) for name in ("u", "y")}
    pipeline = Identification(records[0])
    study = montecarlo.run(pipeline, keys, points=points, progress=progress)
    noisy = [
        add_noise(jax.random.fold_in(keys[0], i), record.y, _SNR_DB)
        for i, record in enumerate(records)
    ]
    return study, local.replace(y=jnp.concatenate(noisy))


def averages(identified: montecarlo.Study, theta2: Sequence[float]) -> list[StateSpace]:
    """The average of each point's models in an aligned basis.

    Raises:
        ValueError: no identification of a point succeeded.
    """
    models = []
    for index, kept in enumerate(identified.kept):
        if not kept.any():
            raise ValueError(
                f"theta2: no identification succeeded at {theta2[index]:.3g} rad; give longer "
                "records or less noise."
            )
        chosen = np.flatnonzero(kept)
        members = jax.tree.map(
            lambda leaf, i=index, c=chosen: jnp.asarray(leaf[i][c]), identified.values.model
        )
        models.append(average(members, AlignedAverage()))
    return models
