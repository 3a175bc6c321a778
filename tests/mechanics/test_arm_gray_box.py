"""The two-link arm by its physical parameters."""

import jax.numpy as jnp
import numpy as np

from lpvid.mechanics import reference_two_link_arm, two_link_arm_gray_box


def test_it_is_the_linearised_arm():
    arm = reference_two_link_arm()
    model = two_link_arm_gray_box(arm)
    frozen, exact = model.at(jnp.cos(1.2)), arm.linearised(1.2)
    for name in "ABC":
        np.testing.assert_allclose(getattr(frozen, name), getattr(exact, name), rtol=1e-9)
    assert len(model.parameter_names) == 10
    assert model.kappa_low[0] < -0.9 and model.kappa_high[0] > 0.9
