"""What a fit returns is where a refinement starts: offsets, feedthrough, and what may be held."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.identify import PastOutputMOESP, identify, simulation_fit
from lpvid.models import StateSpace
from lpvid.refinement import HuberLoss, OutputError, profile_likelihood, refine
from lpvid.refinement._offset import WithOffset, starting_offset
from lpvid.refinement._parameterisation import padded_records
from lpvid.refinement._recognise import recognise

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


def in_two_records(shifts):
    y = [OUTPUT[:150] + shifts[0], OUTPUT[150:] + shifts[1]]
    return IOData(u=[INPUT[:150], INPUT[150:]], y=y, dt=0.1)


def test_where_the_offsets_of_the_records_begin(refined):
    shifts = np.array([[5.0], [-3.0]])
    both = in_two_records(shifts)
    means = np.array([np.mean(record.y, axis=0) for record in both.records])
    start, estimated = starting_offset(TRUTH, "per record", both)
    assert estimated
    np.testing.assert_allclose(start, means)
    known, estimated = starting_offset(refined, shifts, both)
    assert not estimated
    np.testing.assert_allclose(known, shifts)
    # One of all records is told apart from their mean.
    rest = refined.output_offset - np.mean(both.y, axis=0)
    begun = starting_offset(refined, "per record", both)[0]
    np.testing.assert_allclose(begun, means + np.asarray(rest)[None])
    with pytest.raises(ValueError, match=r"\(1,\), or \(2, 1\) for constants of each record"):
        starting_offset(TRUTH, shifts.T, both)
    # Each record gets its own back.
    kind = WithOffset(recognise(TRUTH, both, OutputError()).parameterisation, start, jnp.ones(1))
    assert kind.names[-2:] == ("offset[0,0]", "offset[1,0]")
    records, _ = padded_records(both)
    values = jnp.array([0.8, 1.0, 1.0, *shifts[:, 0]])
    for place, shift in enumerate(shifts):
        record = jax.tree.map(lambda leaf, at=place: leaf[at], records)
        y = kind.respond(kind.prepare(values), record, jnp.zeros(1))
        expected = np.asarray(TRUTH.simulate(u=record.u)) + shift - np.asarray(start)[place]
        np.testing.assert_allclose(y, expected, atol=1e-12)


@pytest.mark.slow
def test_every_record_has_an_offset_of_its_own():
    shifts = np.array([[5.0], [-3.0]])
    both = in_two_records(shifts)
    found = refine(TRUTH, both, output_offset="per record")
    assert found.parameter_names[-2:] == ("offset[0,0]", "offset[1,0]")
    errors = found.standard_errors[-2:, None]
    assert np.all(np.abs(found.output_offset - shifts) < 4.0 * errors)
    # The mean of noise of 0.05 over 150 or 250 samples, and a gain that has to be known as well.
    assert np.all(errors < 4.0 * 0.05 / np.sqrt(np.array([[150.0], [250.0]])))
    assert found.residual.std() == pytest.approx(0.05, rel=0.15)
    again = refine(found, both, max_steps=3)
    np.testing.assert_allclose(again.output_offset, found.output_offset, atol=1e-6)
    # Taken out beforehand, they are known.
    known = refine(TRUTH, both, output_offset=found.output_offset)
    np.testing.assert_allclose(known.model.A, found.model.A, atol=1e-6)
    assert known.output_offset.shape == (2, 1) and len(known.parameters) == 3
    with pytest.raises(ValueError, match="constants of 2 records"):
        refine(found, SHIFTED)


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
    with pytest.raises(ValueError, match=r"bounds: offset\[0\] cannot be bounded"):
        refine(refined, SHIFTED, bounds={"offset*": (0.0, 1.0)})


def test_entries_of_a_black_box_have_no_profile(refined):
    with pytest.raises(ValueError, match="profile a StructuredModel"):
        profile_likelihood(refined, SHIFTED, "A[0,0]")
    with pytest.raises(ValueError, match=r"name: 'offset\[0\]' of a black box has no profile"):
        profile_likelihood(refined, SHIFTED, "offset[0]")
    with pytest.raises(ValueError, match="there is no parameter 'offset'"):
        profile_likelihood(refined, SHIFTED, "offset")


@pytest.mark.slow
def test_a_robust_loss_has_no_profile(refined):
    robust = refine(refined, SHIFTED, loss=HuberLoss())
    with pytest.raises(ValueError, match="SquaredLoss"):
        profile_likelihood(robust, SHIFTED, "A[0,0]")
