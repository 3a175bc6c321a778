"""Structure (32) against the arm's own linearisation, and the dissipative form's promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.mechanics import (
    OPERATING_POINTS,
    ArmScales,
    DissipativeTwoLinkArm,
    reference_two_link_arm,
    two_link_arm_structure,
)

ARM = reference_two_link_arm()
LENGTHS = (0.35, 0.30)
STRUCTURE = two_link_arm_structure(lengths=LENGTHS)
SCALES = ArmScales(jnp.array([30.0, 100, 300, 600]), jnp.array([50.0, 20.0]), jnp.array([8.0, 3.0]))


@pytest.mark.parametrize("theta2", OPERATING_POINTS)
def test_structure_is_the_linearised_arm(theta2):
    model = STRUCTURE.matrices(ARM.structured_parameters(theta2))
    expected = ARM.linearised(theta2)
    for name in "ABCD":
        wanted = np.asarray(getattr(expected, name))
        np.testing.assert_allclose(
            getattr(model, name), wanted, rtol=1e-9, atol=1e-9 * max(np.abs(wanted).max(), 1.0)
        )


def test_entries_lie_where_equation_32_puts_them():
    model = STRUCTURE.matrices(jnp.arange(1.0, 17.0))
    A = np.zeros((6, 6))
    A[:2, 4:] = np.eye(2)
    A[2:, :4] = [[1, 5, 9, 13], [2, 6, 10, 14], [3, 7, 11, 15], [4, 8, 12, 16]]
    B = np.zeros((6, 2))
    B[2:] = [[-9, -13], [-10, -14], [-11, -15], [-12, -16]]
    np.testing.assert_array_equal(model.A, A)
    np.testing.assert_array_equal(model.B, B)
    np.testing.assert_array_equal(model.C, [[0, 0, 1, 0, 0.35, 0], [0, 0, 0, 1, 0.35, 0.3]])
    np.testing.assert_array_equal(model.D, 0.0)
    assert STRUCTURE.parameter_names[0] == "theta 1" and STRUCTURE.n_parameters == 16


def dissipative_parameters(theta2, scales):
    """Parameters of the dissipative form that hold the arm, by NumPy's Cholesky factor."""
    rest = jnp.array([0.0, theta2, 0.0, 0.0])
    mobility = np.linalg.inv(np.asarray(ARM.mass_matrix(rest)))
    stiffness = np.diag(ARM.stiffness_matrix())[2:]
    units = (np.ones(4), np.ones(2), np.ones(2)) if scales is None else scales
    factor = np.linalg.cholesky(mobility) / np.sqrt(np.asarray(units[0]))[:, None]
    relative = np.tril(factor / np.diag(factor)[:, None], -1) + np.diag(np.log(np.diag(factor)))
    logs = [np.log(stiffness / units[1]), np.log(np.asarray(ARM.velocity_gains) / units[2])]
    return jnp.asarray(np.concatenate([relative[np.tril_indices(4)], *logs]))


@pytest.mark.parametrize("scales", [None, SCALES], ids=["unit scales", "given scales"])
def test_dissipative_form_holds_the_arm(scales):
    structure = two_link_arm_structure(lengths=LENGTHS, scales=scales)
    parameters = dissipative_parameters(1.1, scales)
    expected = ARM.structured_parameters(1.1)
    np.testing.assert_allclose(structure.from_search(parameters), expected, rtol=1e-9)
    model = structure.search_structure().matrices(parameters)
    np.testing.assert_allclose(model.A[2:, :4].T.reshape(16), expected, rtol=1e-9)
    assert structure.search_structure().n_parameters == parameters.shape[0] == 14


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1.5, 1.5), min_size=14, max_size=14))
def test_no_value_of_the_dissipative_form_is_unstable(values):
    model = DissipativeTwoLinkArm(LENGTHS).matrices(jnp.asarray(values))
    poles = np.linalg.eigvals(np.asarray(model.A))
    assert poles.real.max() <= 1e-9 * np.abs(poles).max()


def test_a_common_factor_of_the_dissipative_form_cannot_be_seen():
    form = DissipativeTwoLinkArm(LENGTHS)
    parameters = dissipative_parameters(1.1, None)
    diagonal = jnp.array([0, 2, 5, 9])
    shifted = parameters.at[diagonal].add(0.15).at[10:].add(-0.3)
    np.testing.assert_allclose(form.entries(shifted), form.entries(parameters), rtol=1e-12)


@pytest.mark.parametrize("scales", [None, SCALES], ids=["no scales", "scales"])
def test_starts_lie_around_the_plant(scales):
    form = DissipativeTwoLinkArm(LENGTHS, scales)
    black_box = ARM.linearised(1.1)
    starts = form.starts(jax.random.key(0), 200, black_box)
    assert starts.shape == (200, 14)
    sizes = jax.vmap(lambda p: jnp.max(jnp.abs(form.matrices(p).poles())))(starts)
    fastest = np.max(np.abs(black_box.poles()))
    # Within a decade of the plant, and no two alike.
    assert 0.1 < np.median(sizes) / fastest < 10.0
    assert np.unique(np.asarray(starts), axis=0).shape[0] == 200


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lengths": (0.35, 0.0)}, "lengths: two positive"),
        ({"scales": SCALES._replace(gains=jnp.array([1.0, -1.0]))}, "gains must hold 2 positive"),
        ({"scales": SCALES._replace(gains=jnp.ones(3))}, "gains must hold 2 positive"),
    ],
)
def test_impossible_arms_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        two_link_arm_structure(**({"lengths": LENGTHS} | options))
