"""Offsets known beforehand, taken out of other data too."""

import numpy as np
import pytest

from lpvid.data import IOData, Offset, preprocess


def _data(seed, lengths=(20, 30)):
    rng = np.random.default_rng(seed)
    u = [rng.standard_normal((n, 2)) + 3.0 for n in lengths]
    y = [rng.standard_normal((n, 1)) - 1.0 for n in lengths]
    return IOData(u=u, y=y, dt=0.1)


def test_each_records_own_means_are_taken_out_of_both_parts_and_put_back():
    train, test = _data(0).split(0.5)
    clean, undo = preprocess(train, Offset.mean_of(train))
    for record in clean.records:
        np.testing.assert_allclose(np.mean(record.u, axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(np.mean(record.y, axis=0), 0.0, atol=1e-12)
    clean_test, undo_test = preprocess(test, *undo.steps)
    for before, after, fitted in zip(test.records, clean_test.records, train.records, strict=True):
        mean = np.mean(fitted.u, axis=0)
        np.testing.assert_allclose(after.u, before.u - mean[None], atol=1e-12)
    np.testing.assert_allclose(undo_test(clean_test).y, test.y, atol=1e-12)
    np.testing.assert_allclose(undo_test.output(clean_test.y), test.y, atol=1e-12)
    np.testing.assert_allclose(undo_test.output(clean_test.y, trend=False), clean_test.y)


def test_data_with_other_records_are_refused():
    offset = Offset.mean_of(_data(0))
    with pytest.raises(ValueError, match=r"offsets for 2 record\(s\), 2 input\(s\) and 1 output"):
        preprocess(_data(1, (20,)), offset)
