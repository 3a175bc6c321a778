"""Sensors that cannot tell the sign: found before the rounds, since no linear model comes near."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lpvid.data import IOData
from lpvid.effects import AbsoluteValueSensor
from lpvid.loop._assess import free_run
from lpvid.loop._bench import Bench
from lpvid.loop._candidates import Place, Trial
from lpvid.loop._columns import along, scales_of
from lpvid.loop._compare import better
from lpvid.loop._program import Records
from lpvid.loop._records import records_of
from lpvid.loop._refit import Ranked, seated
from lpvid.loop._rounds import Chosen, held_out_errors, likelihood_on
from lpvid.loop._score import Scored
from lpvid.loop._tune import Fitted, empty_unknowns, fit
from lpvid.loop._verdict import LEVEL
from lpvid.loop.structures import unfolded

_TURNS = 5


def folded_sensor(bench: Bench, base: Fitted) -> Chosen | None:
    """The model of the signal behind a folded output, the sensor on it; `None` if not just one is.

    A score test asks for small steps from the model as it is; that of y = |z| is far from any
    linear model of y. So the parameters are fitted to the straightened signal first.

    Args:
        bench: what the call works with.
        base: the model without effects.
    """
    setting, train = bench.setting, bench.data[0]
    sensors = [k for k, law in enumerate(setting.laws) if isinstance(law, AbsoluteValueSensor)]
    straight, outputs = unfolded(train) if sensors else (train, ())
    # One sensor has one sign to settle; several would have to be seated together.
    if len(outputs) != 1:
        return None
    place = Place(sensors[0], "output", outputs[0])
    behind, records = _behind(bench, base, straight, outputs[0])
    entry = Ranked(
        Trial(place, np.zeros(0)), Scored(0.0, np.ones(1), 1.0), np.zeros((0, train.ny, 1)), 0.0
    )
    trace = along(setting, records, behind.slots, behind.unknowns, behind.gain)
    found = fit(
        setting,
        bench.train,
        (place,),
        (scales_of(trace, place),),
        seated(behind.unknowns, 0, entry, whole=True),
        base.noise,
        ratio=behind.ratio,
        gain=behind.gain,
    )
    before, after = (
        likelihood_on(one, held_out_errors(one, bench.held_out)) for one in (base, found)
    )
    gain, p_value = better(before, after)
    won = found.searched.log_likelihood - base.searched.log_likelihood
    if not (np.isfinite(gain) and won > 0.0) or p_value > LEVEL:
        return None
    return Chosen(found, entry._replace(scored=Scored(won, np.ones(1), p_value)), (), gain, p_value)


def _behind(bench: Bench, base: Fitted, straight: IOData, output: int) -> tuple[Fitted, Records]:
    """The model fitted to straightened records, whose signs it then corrects, by turns."""

    def records_with(signal: np.ndarray) -> tuple[IOData, Records]:
        y = np.array(straight.y)
        y[:, output] = signal
        data = eqx.tree_at(lambda tree: tree.y, straight, jnp.asarray(y))
        nodes, length = np.asarray(bench.train.kappa_nodes), bench.train.u.shape[0]
        hold = bench.setting.hold
        return data, records_of(data, nodes, bench.duration, None, length, hold=hold)

    def started(signal: np.ndarray) -> tuple[Fitted, Records, np.ndarray]:
        data, records = records_with(signal)
        theta = np.asarray(bench.setting.structure.start(data), float)
        still = base.unknowns.start.shape
        unknowns = empty_unknowns(theta, still[1], still[0], base.unknowns.amplitude.shape[2])
        return fit(bench.setting, records, (), (), unknowns, base.noise), records, signal

    # Physics may know the sign of the signal as a whole.
    signal = np.asarray(straight.y)[:, output]
    found, records, signal = max(
        (started(signal), started(-signal)), key=lambda one: one[0].searched.log_likelihood
    )
    for _ in range(_TURNS):
        following = np.copysign(signal, free_run(found, records)[:, output])
        if np.array_equal(following, signal):
            break
        turned = records_with(following)[1]
        better_signs = fit(bench.setting, turned, (), (), found.unknowns, base.noise)
        if better_signs.searched.log_likelihood <= found.searched.log_likelihood:
            break
        found, records, signal = better_signs, turned, following
    return found, records
