"""Every fault of the data ends in an error or a warning that says what to do."""

import warnings

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from lpvid._results import Status
from lpvid.data import IOData, join
from lpvid.identify import (
    AbstractOrderRule,
    Chunks,
    ContinuousTimeMOESP,
    PastInputMOESP,
    PastOutputMOESP,
    identify,
    stabilisation,
)
from lpvid.identify._checks import check_varying

from .helpers import common_problem, respond, three_modes

DT = 1 / 50


@pytest.fixture(scope="module")
def record():
    u, _, y = common_problem(400)
    return u, y


@pytest.mark.parametrize("dt", [0.0, -0.01, np.nan, np.inf])
def test_sample_times_must_be_positive_and_finite(record, dt):
    with pytest.raises(ValueError, match="dt"):
        IOData(u=record[0], y=record[1], dt=dt)


def test_records_of_different_sample_times_are_not_joined(record):
    one, two = (IOData(u=record[0], y=record[1], dt=dt) for dt in (0.02, 0.01))
    with pytest.raises(ValueError, match="bring them to one sample time"):
        join([one, two])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_samples_that_are_not_finite_are_named(record, bad):
    u, y = record[0], record[1].copy()
    y[123, 1] = bad
    with pytest.raises(ValueError, match=r"y2.*123|123.*y2"):
        IOData(u=u, y=y, dt=DT)


def test_fifty_samples(record):
    data = IOData(u=record[0][:50], y=record[1][:50], dt=DT)
    with pytest.warns(UserWarning, match="50 samples are few for order=6 .* Take 140 samples"):
        identify(data, PastOutputMOESP(order=6))
    with pytest.raises(ValueError, match="50 samples, but block_rows=20 .* at least 199"):
        identify(data, PastOutputMOESP(order=6, block_rows=20))


def test_an_order_too_high_for_the_rows_or_the_data(record):
    data = IOData(u=record[0], y=record[1], dt=DT)
    with pytest.raises(ValueError, match="raise block_rows to 31 or more, or lower the order"):
        identify(data, PastOutputMOESP(order=60, block_rows=20))


def test_constant_and_unexciting_inputs_beside_an_offset(record):
    u, y = record
    method = PastOutputMOESP(order=6, block_rows=8, offset=True)
    names = {"u": ("push", "pull")}
    still = IOData(u=np.column_stack([u[:, 0], 0 * u[:, 0] + 3.3]), y=y, dt=DT, names=names)
    with pytest.raises(ValueError, match=r"'pull' is constant.*leave it out with data.select"):
        identify(still, method)
    sine = np.column_stack([u[:, 0], np.sin(0.3 * np.arange(len(u)))])
    data = IOData(u=sine, y=y, dt=DT, names=names)
    for identified in (identify, lambda *both: stabilisation(*both, orders=[6])):
        with pytest.raises(ValueError, match=r"'pull' excites 2 of the 16 .*use a richer input"):
            identified(data, method)


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda u: lfilter(*butter(4, 0.005), u), r"Input 'pull' hardly excites.*widen its spec"),
        (None, "push, pull hardly move independently.*excite them by independent signals"),
    ],
)
def test_inputs_that_only_just_excite(record, spoil, message):
    """Full rank, but a condition that leaves few digits: a warning, and a model."""
    u = record[0]
    second = u[:, 0] + 1e-8 * u[:, 1] if spoil is None else spoil(u[:, 1])
    u = np.column_stack([u[:, 0], second])
    y = respond(three_modes(), u)
    y = y + 0.01 * np.random.default_rng(0).standard_normal(y.shape)
    data = IOData(u=u, y=y, dt=DT, names={"u": ("push", "pull")})
    with pytest.warns(UserWarning, match=message):
        identify(data, PastOutputMOESP(order=6, block_rows=8))


@pytest.mark.parametrize(
    "identified",
    [
        lambda data: identify(data, PastInputMOESP(order=2, block_rows=8)),
        lambda data: identify(Chunks(lambda: [data]), PastInputMOESP(order=2, block_rows=8)),
        lambda data: identify(data, ContinuousTimeMOESP(order=2, tau=0.1, block_rows=3)),
        lambda data: stabilisation(data, PastInputMOESP(block_rows=8), orders=[2]),
    ],
)
def test_constant_outputs_are_named_by_every_method(record, identified):
    u, y = record
    data = IOData(u=u, y=np.column_stack([y[:, 0], 0.0 * y[:, 1] + 2.0]), dt=DT)
    with pytest.raises(ValueError, match=r"Output 'y2' is constant.*data.select\(outputs"):
        identified(data)


@pytest.mark.parametrize("level", [0.0, 2.0])
@pytest.mark.parametrize("chunked", [False, True])
def test_a_constant_output_has_a_status_of_its_own(record, level, chunked):
    u, y = record
    data = IOData(u=u, y=np.column_stack([y[:, 0], 0.0 * y[:, 1] + level]), dt=DT)
    method = PastInputMOESP(order=2, block_rows=8)
    fit = identify(Chunks(lambda: [data]) if chunked else data, method, throw=False)
    assert fit.status == Status.constant_channel


@pytest.mark.parametrize("late", [False, True])
def test_a_channel_that_moves_at_any_time_is_not_constant(late):
    """However late, and whatever its level: it need only move by more than rounding."""
    signal = np.full(500, 1e3)
    signal[-1 if late else 1] += 1e-8
    u = np.column_stack([np.arange(500.0), signal])
    check_varying(IOData(u=u, y=u, dt=DT))
    u[:, 1] = np.round(signal, 7)
    with pytest.raises(ValueError, match="Input 'u2' is constant"):
        check_varying(IOData(u=u, y=u, dt=DT))


def test_an_order_above_the_rank_without_past_outputs(record):
    """One state, no noise: past it singular values are rounding, whatever becomes of the model."""
    u = record[0][:, :1]
    y = lfilter([1.0], [1.0, -0.8], u, axis=0)
    data = IOData(u=u, y=y, dt=DT)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            identify(data, PastInputMOESP(order=8, block_rows=10))
            said = " ".join(str(warning.message) for warning in caught)
        except ValueError as error:
            said = str(error)
    assert "order=8 is above the numerical rank of the data (1)" in said


def test_whole_numbers_of_numpy_are_taken(record):
    data = IOData(u=record[0], y=record[1], dt=DT)
    method = PastOutputMOESP(order=np.int64(6), block_rows=np.int32(8))
    assert method == PastOutputMOESP(order=6, block_rows=8)
    assert type(identify(data, method).order) is int
    assert ContinuousTimeMOESP(order=np.int64(2)).order == 2


@pytest.mark.parametrize("order", [0, 15])
def test_a_rule_of_ones_own_keeps_to_what_the_rows_carry(record, order):
    class Fixed(AbstractOrderRule):
        def choose(self, evidence):
            return order

    data = IOData(u=record[0], y=record[1], dt=DT)
    with pytest.raises(ValueError, match=f"chose {order}, but block_rows=8 carries 1 to 14"):
        identify(data, PastOutputMOESP(order=Fixed(), block_rows=8))


def test_good_data_bring_no_warning(record):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        identify(IOData(u=record[0], y=record[1], dt=DT), PastOutputMOESP(order=6, block_rows=8))
