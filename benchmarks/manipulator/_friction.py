"""Close the loop and follow set-points: a model with the friction it found against a linear one.

The arm with 0.4 A of friction is recorded in its bounded-position experiment; `close_the_loop` fits
the single-link structure and looks for what it lacks among the laws of friction and drag. Both
models then run under the PD of 002 (u = 0.5 (R − y1) − 1.4 y4) beside the arm itself.
"""

import jax
import jax.numpy as jnp
import numpy as np

from lpvid.control import set_point_following, simulate_closed_loop
from lpvid.effects import LIBRARY
from lpvid.loop import close_the_loop
from lpvid.loop.structures import FlexibleLink
from lpvid.mechanics import (
    ArmEffects,
    DryFriction,
    ProportionalDerivative,
    Quantisation,
    bounded_position_record,
    reference_single_link_arm,
)
from lpvid.report import text_table

_CHANNELS = ["hub angle", "base strain", "tachometer"]
_FAMILIES = ("friction", "drag")
_RATE, _SECONDS = 300.0, 12.0
_SET_POINTS = (1.0, 3.0, -2.0, 0.0)
_GOAL = 3.0


def main() -> None:
    """Record, close the loop, follow set-points, print."""
    arm = reference_single_link_arm()
    effects = ArmEffects(friction=DryFriction(0.4), quantisation=Quantisation(), noise=2e-3)
    data = bounded_position_record(
        arm, jax.random.key(0), random_size=True, duration=_SECONDS, rate=_RATE, effects=effects
    ).select(outputs=_CHANNELS)
    laws = [law for law in LIBRARY if law.family in _FAMILIES]
    # Told the number of modes: left to itself the structure takes fewer of the sticking arm's.
    structure = FlexibleLink(data.split(2.0 / 3.0)[0], modes=3)
    loop = close_the_loop(structure, data, laws=laws, most_effects=1, progress=True)
    print(f"\n{loop.verdict}: {loop.advice}")
    for effect in loop.effects:
        numbers = ", ".join(
            f"{number.name} = {number.value:.4g} ± {number.std:.2g} {number.unit}"
            for number in effect.parameters
        )
        print(f"{effect.name} at {effect.port}: {numbers}")
    reference = jnp.repeat(jnp.asarray(_SET_POINTS), int(3.0 * _RATE))
    # Its speed is the last output, of the arm as of the models.
    controller = ProportionalDerivative(0.5, 1.4)
    plant = simulate_closed_loop(
        arm,
        controller,
        reference=reference,
        dt=1.0 / _RATE,
        effects=effects,
        key=jax.random.key(1),
    )
    measured = plant.data().select(outputs=["y1", "y2", "y4"])
    models = {"linear": loop.model_before, "with the friction found": loop.model}
    motions = {
        name: model.simulate_closed_loop(controller, reference=reference)
        for name, model in models.items()
    }
    found = set_point_following(motions, measured, reference=reference)
    rows = [
        [name, *(f"{value:.4f}" for value in np.asarray(row))]
        for name, row in zip(found.labels, found.relative_error, strict=True)
    ]
    print(text_table(rows, ["model", *(f"δ of the {name}" for name in _CHANNELS)]))
    linear, traced = np.asarray(found.relative_error)[:, 0]
    met = "met" if linear >= _GOAL * traced else "MISSED"
    print(f"δ_1: {linear / traced:.2f} times smaller with the friction (goal {_GOAL:g}: {met})")


if __name__ == "__main__":
    main()
