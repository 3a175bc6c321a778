"""Unseen combinations of parameters: known redundancies, by name, and structures without any."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.mechanics import reference_two_link_arm, two_link_arm_structure
from lpvid.models import FunctionStructure
from lpvid.restructure import HinfMatching, identifiability, restructure

MATCH_ONLY = HinfMatching(passes=0, bundle_steps=0)
ARM = reference_two_link_arm()
ARM_STRUCTURE = two_link_arm_structure(lengths=(0.35, 0.30))


def spring(p):
    """Two springs in a row of gears (a product), two in parallel (a sum), one mass, a ghost."""
    stiffness = p[0] * p[1] + p[2] + p[3]
    A = jnp.array([[0.0, 1.0], [-stiffness / p[4], -0.3]])
    return A, jnp.array([[0.0], [1.0]]) / p[4], jnp.eye(2)[:1]


NAMES = ("k1", "k2", "k3", "k4", "mass", "ghost")
POINT = [2.0, 3.0, 1.0, 4.0, 0.5, 0.0]
# What multiplies is fixed in one structure, what adds in the other.
PRODUCT = FunctionStructure(
    spring,
    nominal=POINT,
    names=NAMES,
    lower=[-np.inf, -np.inf, 1.0, 4.0, -np.inf, -np.inf],
    upper=[np.inf, np.inf, 1.0, 4.0, np.inf, np.inf],
)
SUM = FunctionStructure(
    spring,
    nominal=POINT,
    names=NAMES,
    lower=[2.0, 3.0, -np.inf, -np.inf, -np.inf, 0.0],
    upper=[2.0, 3.0, np.inf, np.inf, np.inf, 0.0],
)


def test_a_product_and_a_parameter_without_effect_are_named():
    seen = identifiability(PRODUCT, POINT)
    assert seen.rank == 2 and seen.singular_values.shape == (4,)
    assert seen.names == ("k1", "k2", "ghost")
    assert set(seen.describe()) == {
        "k1 and k2 enter only as k1*k2: fix one of them, or tie them.",
        "ghost does not enter the response: fix it.",
    }


def test_a_sum_is_named():
    seen = identifiability(SUM, POINT)
    assert seen.rank == 2 and seen.names == ("k3", "k4")
    assert seen.describe() == ("k3 and k4 enter only as k3 + k4: fix one of them, or tie them.",)
    np.testing.assert_allclose(np.abs(seen.directions[0, 2:4]), seen.directions[0, 2:4].max())


def test_what_is_fixed_or_tied_is_not_asked_about():
    fixed = identifiability(PRODUCT, POINT, fixed=("ghost", "k1"))
    assert fixed.rank == 2 and fixed.names == () and fixed.singular_values.shape == (2,)
    # Tied, k1 = k2 enters as its square, and the ghost goes along with the mass.
    tied = identifiability(PRODUCT, [2.0, 2.0, 1.0, 4.0, 0.5, 0.5], tied=["k?", ("mass", "ghost")])
    assert tied.rank == 1 and tied.names == ()
    alone = identifiability(PRODUCT, [2.0, 2.0, 1.0, 4.0, 0.5, 0.0], tied=[("k1", "k2")])
    assert alone.names == ("ghost",)
    with pytest.raises(ValueError, match="no parameter is called 'spring'"):
        identifiability(PRODUCT, POINT, fixed=("spring",))


@pytest.mark.slow
def test_a_result_knows_what_it_was_given():
    lag = FunctionStructure(
        lambda p: (-p[:1, None] / p[1], p[2:, None] * jnp.eye(1), jnp.eye(1)),
        nominal=[2.0, 3.0, 1.0],
        names=("rate", "length", "gain"),
    )
    black_box = lag.matrices(jnp.array([4.0, 2.0, 1.5]))
    options = {"starts": 0, "initial": [3.0, 2.0, 1.0], "method": MATCH_ONLY}
    assert restructure(black_box, lag, **options).unidentifiable == ("rate", "length")
    known = restructure(black_box, lag, fixed={"length": 2.0}, **options)
    assert known.fixed == ("length",) and known.unidentifiable == ()
    equal = restructure(black_box, lag, tied=[("rate", "length")], **options)
    assert equal.tied == (("rate", "length"),)
    # Tied they drop out altogether, and are named together.
    assert equal.unidentifiable == ("rate", "length")
    # At high frequency the response is gain / jω: the rate is not told there.
    far = restructure(black_box, lag, omega=[1e7, 2e7], fixed={"length": 2.0}, **options)
    assert far.omega.shape == (2,)
    seen = identifiability(lag, far.parameters, omega=far.omega, fixed=far.fixed)
    assert seen.singular_values.shape == (2,)


@pytest.mark.slow
def test_a_ratio_is_named():
    lag = FunctionStructure(
        lambda p: (-p[:1, None] / p[1], jnp.eye(1), jnp.eye(1)), nominal=[2.0, 3.0]
    )
    (sentence,) = identifiability(lag, [2.0, 3.0]).describe()
    assert sentence.startswith("parameter 1 and parameter 2 enter only as parameter 1/parameter 2")


@pytest.mark.slow
def test_the_arms_parameters_are_all_seen():
    seen = identifiability(ARM_STRUCTURE, ARM.structured_parameters(1.1))
    assert seen.rank == 16 and seen.names == () and seen.describe() == ()
    # A model good to a hundredth does not tell all of them.
    rough = identifiability(ARM_STRUCTURE, ARM.structured_parameters(1.1), tolerance=1e-2)
    assert rough.rank < 16 and rough.names


@pytest.mark.slow
def test_the_common_factor_of_the_dissipative_arm_is_found():
    form = ARM_STRUCTURE.search_structure()
    point = 0.3 * jax.random.normal(jax.random.key(0), (14,))
    seen = identifiability(form, point)
    assert seen.rank == 13
    # W by a factor of e², stiffnesses and gains by its inverse.
    factor = np.zeros(14)
    factor[[0, 2, 5, 9]], factor[10:] = 1.0, -2.0
    found = np.asarray(seen.directions[0])
    np.testing.assert_allclose(found / found[0], factor, atol=1e-9)
    assert "enter only by combinations that stay when they move together" in seen.describe()[0]


@pytest.mark.parametrize("parameters", [[1.0], np.full(6, np.nan)])
def test_impossible_points_are_refused(parameters):
    with pytest.raises(ValueError, match="parameters: 6 finite numbers"):
        identifiability(PRODUCT, parameters)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda p: identifiability(PRODUCT, p).rank)(jnp.asarray(POINT))
