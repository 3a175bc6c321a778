import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.identify import _gram
from lpvid.identify._factor import data_factor, hankel_rows


def formed(w, lengths, rows):
    """The block-Hankel matrix itself."""
    delays = rows[:, 0].max() + 1
    parts, start = [], 0
    for length in lengths:
        columns = length - delays + 1
        parts.append(np.stack([w[start + i : start + i + columns, c] for i, c in rows]))
        start += length
    return np.concatenate(parts, axis=1)


@pytest.mark.parametrize("lengths", [(57,), (40, 25, 33), (14, 20) * 9])
def test_gram_and_factor_are_those_of_the_formed_matrix(lengths):
    w = np.random.default_rng(0).standard_normal((sum(lengths), 3))
    rows = hankel_rows(7, 2, 1, past_outputs=True)
    matrix = formed(w, lengths, rows)
    truth = matrix @ matrix.T
    np.testing.assert_allclose(_gram.hankel_gram(jnp.asarray(w), lengths, rows), truth, atol=1e-11)
    factor = np.asarray(_gram.hankel_factor(jnp.asarray(w), lengths, rows))
    np.testing.assert_allclose(factor @ factor.T, truth, atol=1e-11)
    assert np.all(np.triu(factor, 1) == 0)


@settings(max_examples=10, deadline=None)
@given(
    n=st.sampled_from([1, 5, 11, 64, 90]), lags=st.sampled_from([1, 2, 12]), seed=st.integers(0, 99)
)
def test_lagged_products_by_definition(n, lags, seed):
    w = np.random.default_rng(seed).standard_normal((n, 2))
    found = _gram.lagged_products(jnp.asarray(w), lags)
    for lag in range(lags):
        expected = w[: n - lag].T @ w[lag:] if lag < n else np.zeros((2, 2))
        np.testing.assert_allclose(found[lag], expected, atol=1e-12)


def test_chunks_do_not_change_the_products(monkeypatch):
    w = np.random.default_rng(1).standard_normal((1000, 2))
    whole = _gram.lagged_products(jnp.asarray(w), 9)
    monkeypatch.setattr(_gram, "_CHUNK", 64)
    np.testing.assert_allclose(_gram.lagged_products(jnp.asarray(w), 9), whole, atol=1e-11)


def test_both_routes_give_the_same_factor():
    rng = np.random.default_rng(2)
    w, scale = rng.standard_normal((300, 3)), np.array([1.0, 2.0, 0.5])

    @functools.partial(jax.jit, static_argnums=0)
    def factor(route):
        return data_factor(
            jnp.asarray(w),
            jnp.asarray(scale),
            (300,),
            block_rows=4,
            nu=1,
            past_outputs=True,
            route=route,
        )

    (one, one_cond), (two, two_cond) = factor("gram"), factor("qr")
    for name in ("outputs_instruments", "outputs", "instruments_inputs"):
        a, b = np.asarray(getattr(one, name)), np.asarray(getattr(two, name))
        # Signs of the factor's columns are free.
        np.testing.assert_allclose(a @ a.T, b @ b.T, atol=1e-9)
    assert int(one_cond.excitation_rank) == int(two_cond.excitation_rank) == 8
    np.testing.assert_allclose(one_cond.smallest_pivot, two_cond.smallest_pivot, rtol=1e-9)
