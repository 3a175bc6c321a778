"""What a fit returns is where a refinement starts: offsets, feedthrough, and what may be held."""

import jax
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.identify import PastOutputMOESP, identify, simulation_fit
from lpvid.models import StateSpace
from lpvid.refinement import HuberLoss, profile_likelihood, refine

RNG = np.random.default_rng(0)
INPUT = RNG.standard_normal(400)
TRUTH = StateSpace([[0.8]], [[1.0]], [[1.0]], dt=0.1)
OUTPUT = np.asarray(TRUTH.simulate(u=INPUT)) + 0.05 * RNG.standard_normal((400, 1))
SHIFTED = IOData(u=INPUT, y=OUTPUT + 5.0, dt=0.1)
CENTRED = IOData(u=INPUT, y=OUTPUT, dt=0.1)
METHOD = PastOutputMOESP(order=1, block_rows=5, feedthrough=False, offset=True)


@pytest.fixture(scope="module")
def refined():
    return refine(identify(SHIFTED, METHOD), SHIFTED)


def test_an_estimated_offset_is_kept(refined):
    assert refined.output_offset.item() == pytest.approx(5.0, abs=0.02)
    assert refined.model.A.item() == pytest.approx(0.8, abs=0.005)
    assert refined.noise_covariance.item() == pytest.approx(0.0025, rel=0.25)
    assert refined.residual.std() == pytest.approx(0.05, rel=0.15)
    # BFT of the true model: noise of 0.05 on an output of standard deviation 1/0.6.
    assert simulation_fit(refined, SHIFTED)[0] == pytest.approx(97.0, abs=0.5)


def test_a_refined_model_is_a_start(refined):
    again = refine(refined, SHIFTED)
    np.testing.assert_allclose(again.model.A, refined.model.A, atol=1e-7)
    np.testing.assert_allclose(again.output_offset, refined.output_offset, atol=1e-7)


def test_an_offset_is_estimated_on_request_or_known(refined):
    free = refine(TRUTH, SHIFTED, output_offset="free")
    np.testing.assert_allclose(free.output_offset, refined.output_offset, atol=1e-6)
    assert free.parameter_names[-1] == "offset[0]"
    known = refine(refined, SHIFTED, output_offset=np.array([5.0]))
    assert known.output_offset == 5.0 and len(known.parameters) == 3
    with pytest.raises(ValueError, match="output_offset: shape"):
        refine(TRUTH, SHIFTED, output_offset=np.array([1.0, 2.0]))
    with pytest.raises(ValueError, match="'free'"):
        refine(TRUTH, SHIFTED, output_offset="estimate")


def test_feedthrough_is_the_fits_under_jit_too(refined):
    def parameters(y):
        data = CENTRED.replace(y=y)
        method = PastOutputMOESP(order=1, block_rows=5, feedthrough=False)
        return refine(identify(data, method), data).parameters

    assert jax.jit(parameters)(CENTRED.y).shape == (3,)
    assert refined.parameter_names == ("A[0,0]", "B[0,0]", "C[0,0]", "offset[0]")


def test_entries_of_a_black_box_cannot_be_held(refined):
    with pytest.raises(ValueError, match="hold entries of D or offsets"):
        refine(refined, SHIFTED, fixed=("A*",))
    with pytest.raises(ValueError, match="hold entries of D or offsets"):
        refine(refined, SHIFTED, tied=(("B*", "C*"),))
    with pytest.raises(ValueError, match="no bounds"):
        refine(refined, SHIFTED, bounds={"A*": (0.0, 1.0)})


def test_entries_of_a_black_box_have_no_profile(refined):
    with pytest.raises(ValueError, match="profile a StructuredModel"):
        profile_likelihood(refined, SHIFTED, "A[0,0]")


@pytest.mark.slow
def test_a_robust_loss_has_no_profile(refined):
    robust = refine(refined, SHIFTED, loss=HuberLoss())
    with pytest.raises(ValueError, match="SquaredLoss"):
        profile_likelihood(robust, SHIFTED, "A[0,0]")
