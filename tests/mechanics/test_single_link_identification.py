"""Modes of the single-link arm from each experiment of Sun 2000 by ORSE."""

import jax
import numpy as np
import pytest

from lpvid.identify import ORSE, identify
from lpvid.mechanics import (
    ArmEffects,
    Quantisation,
    bounded_position_record,
    closed_loop_record,
    open_loop_record,
    reference_single_link_arm,
)

ARM = reference_single_link_arm()
SENSORS = ArmEffects(noise=0.005, quantisation=Quantisation())

EXPERIMENTS = {
    **{
        name: lambda key, name=name: open_loop_record(ARM, key, excitation=name, effects=SENSORS)
        for name in ("square", "periodic random", "varying square", "random")
    },
    **{
        f"bounded, random {size}": lambda key, size=size: bounded_position_record(
            ARM, key, random_size=size, duration=20.0, effects=SENSORS
        )
        for size in (False, True)
    },
    **{
        f"closed loop, {name}": lambda key, name=name: closed_loop_record(
            ARM, key, reference=name, duration=20.0, effects=SENSORS
        )
        for name in ("square", "varying square")
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_orse_finds_the_three_flexible_modes(name):
    """Within 2 %, at order eight: no more complex poles than the arm has, none to pick from."""
    data = EXPERIMENTS[name](jax.random.key(0))
    method = ORSE(order=8, block_rows=60, feedthrough=False, stabilise=0.99999)
    poles = np.log(np.asarray(identify(data, method).model.poles()).astype(complex)) / data.dt
    found = np.sort(np.abs(poles[poles.imag > 2 * np.pi]))
    true = np.asarray(ARM.linearised().poles())
    true = np.sort(np.abs(true[true.imag > 2 * np.pi]))
    assert found.shape == (3,)
    np.testing.assert_allclose(found, true, rtol=0.02)
