import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.identify import _gram
from lpvid.identify._factor import Layout, factor_of_gram, factor_of_triangle


def formed(w, lengths, rows):
    """The block-Hankel matrix itself."""
    delays = rows[:, 0].max() + 1
    parts, start = [], 0
    for length in lengths:
        columns = length - delays + 1
        parts.append(np.stack([w[start + i : start + i + columns, c] for i, c in rows]))
        start += length
    return np.concatenate(parts, axis=1)


@pytest.mark.parametrize(
    "lengths, constant", [((57,), False), ((40, 25, 33), True), ((14, 20) * 9, False)]
)
def test_gram_and_factor_are_those_of_the_formed_matrix(lengths, constant):
    w = np.random.default_rng(0).standard_normal((sum(lengths), 3)) + 3.0
    layout = Layout(7, 2, 1, True, True)
    rows = layout.rows()
    matrix = formed(w, lengths, rows)
    assert matrix.shape == (rows.shape[0], layout.columns(lengths))
    if constant:
        matrix = matrix - matrix.mean(axis=1, keepdims=True)
    truth = matrix @ matrix.T
    moments = _gram.hankel_moments(jnp.asarray(w), lengths, layout.n_lags)
    gram = _gram.hankel_gram(moments, rows, matrix.shape[1], constant=constant)
    np.testing.assert_allclose(gram, truth, atol=1e-10)
    factor = np.asarray(_gram.hankel_factor(jnp.asarray(w), lengths, rows, constant=constant))
    np.testing.assert_allclose(factor @ factor.T, truth, atol=1e-10)
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


@pytest.mark.parametrize("past", [(True, True), (False, False)])
def test_both_routes_give_the_same_factor(past):
    w = jnp.asarray(np.random.default_rng(2).standard_normal((300, 3)))
    layout = Layout(4, 1, 2, *past)
    rows, columns = layout.rows(), layout.columns((300,))

    @jax.jit
    def factors(w):
        moments = _gram.hankel_moments(w, (300,), layout.n_lags)
        gram = _gram.hankel_gram(moments, rows, columns, constant=False)
        whole = _gram.hankel_factor(w, (300,), rows)
        return (
            factor_of_gram(gram / columns, layout),
            factor_of_triangle(whole / np.sqrt(columns), layout),
        )

    one, two = factors(w)
    for name in ("outputs_instruments", "outputs", "instruments_inputs"):
        a, b = np.asarray(getattr(one.factor, name)), np.asarray(getattr(two.factor, name))
        # Signs of the factor's columns are free.
        np.testing.assert_allclose(a @ a.T, b @ b.T, atol=1e-12)
    a, b = np.asarray(one.outputs_now), np.asarray(two.outputs_now)
    np.testing.assert_allclose(a @ a.T, b @ b.T, atol=1e-12)
    np.testing.assert_allclose(a, np.asarray(one.factor.outputs)[:, :2], atol=1e-12)
    assert int(one.conditioning.excitation_rank) == int(two.conditioning.excitation_rank)
    assert int(one.conditioning.excitation_rank) == layout.input_rows == (8 if past[0] else 4)
    for name in ("smallest_pivot", "excitation_pivot"):
        found = getattr(one.conditioning, name), getattr(two.conditioning, name)
        np.testing.assert_allclose(*found, rtol=1e-9)
