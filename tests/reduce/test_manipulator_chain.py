"""Chapter 3 of 002 on the simulated arm: identify, rank, reduce, update, validate."""

import jax
import pytest

from lpvid.control import data_matching
from lpvid.identify import ORSE, identify
from lpvid.mechanics import (
    ArmEffects,
    DryFriction,
    Quantisation,
    closed_loop_record,
    reference_single_link_arm,
)
from lpvid.reduce import ModeSingularValue, OutputUpdate, modal_truncation, update_model


@pytest.mark.slow
def test_ten_of_twenty_two_states_lose_little_after_updating_and_mrm_beats_msv():
    """Below 5 %, as issue and 002 have it; MRM ahead where the rigid modes carry the response."""
    effects = ArmEffects(friction=DryFriction(0.4), noise=0.005, quantisation=Quantisation())
    arm = reference_single_link_arm(payload_mass=0.3)
    data = closed_loop_record(arm, jax.random.key(100), compensation=0.8, effects=effects)
    first = data.split(0.5)[0]
    method = ORSE(order=22, block_rows=60, feedthrough=False, stabilise=0.99999)
    fit = identify(first, method)
    models = {"full": fit}
    for name, rank in (("MRM", None), ("MSV", ModeSingularValue())):
        reduced = modal_truncation(fit.model, 10, data=first, rank=rank, x0=fit.x0)
        updated = update_model(reduced.model, first, OutputUpdate(), x0=reduced.x0)
        models |= {name: reduced, f"{name} updated": updated}
    found = data_matching(models, data)
    delta = dict(zip(found.labels, found.mean, strict=True))
    assert delta["MRM updated"] < 1.05 * delta["full"]
    assert delta["MRM updated"] < delta["MRM"] < delta["MSV"]
    assert delta["MRM updated"] < delta["MSV updated"]
