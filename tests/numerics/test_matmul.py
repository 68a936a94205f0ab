"""Products, sums, elementary functions, nearest neighbours: exact, and the same bits everywhere."""

from math import fsum, inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba import njit
from scipy import special

from mace_rl.numerics import elementary, matmul
from mace_rl.numerics.nearest import Neighbours

SIZES = st.integers(1, 13)


def chain(a: np.ndarray, b: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The same in extended precision, which holds a product of two float32 exactly."""
    result = np.broadcast_to(start, (len(a), b.shape[1])).astype(np.longdouble)
    for k in range(len(b)):
        exact = np.longdouble(a[:, k, None]) * np.longdouble(b[k]) + result
        result = exact.astype(np.float32).astype(np.longdouble)
    return result.astype(np.float32)


@settings(deadline=None, max_examples=60)
@given(st.data(), SIZES, st.integers(1, 40), st.sampled_from([16, 32, 64, 80, 128, 256, 272]))
def test_every_element_is_one_chain(data, rows, count, columns):
    draw = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    a = draw.standard_normal((rows, count)).astype(np.float32)
    b = draw.standard_normal((count, columns)).astype(np.float32)
    start, c = draw.standard_normal((2, rows, columns)).astype(np.float32)
    matmul.product(a, b, start[0], c)
    assert (c == chain(a, b, start[0])).all()
    transposed = np.asfortranarray(a)  # other distances
    matmul.product(transposed, b, start[0], c)
    assert (c == chain(a, b, start[0])).all()
    # A chain may be cut anywhere, and rows do not know of each other.
    half = count // 2
    cut, one = start.copy(), np.empty((1, columns), np.float32)
    matmul.add_product(a[:, :half], b[:half], cut)
    matmul.add_product(a[:, half:], b[half:], cut)
    assert (cut == chain(a, b, start)).all()
    matmul.product(a[-1:], b, start[0], one)
    assert (one[0] == c[-1]).all()


@pytest.mark.parametrize("bad", [nan, inf])
def test_bad_numbers_pass_through_and_spread_no_farther(bad):
    a, b = np.ones((5, 3), np.float32), np.ones((3, 16), np.float32)
    a[2, 1] = bad
    c = np.empty((5, 16), np.float32)
    matmul.product(a, b, np.zeros(16, np.float32), c)
    np.testing.assert_array_equal(c[2], np.full(16, bad))
    assert (np.delete(c, 2, axis=0) == 3).all()


@settings(deadline=None)
@given(arrays(np.float64, st.integers(0, 300), elements=st.floats(-1e3, 1e3)))
def test_dot_agrees_with_an_exact_sum(values):
    assert matmul.dot(values, values) == pytest.approx(fsum(values * values), rel=1e-13)


@njit(error_model="numpy")
def over(function, values):
    """A compiled function of every value, in a loop that becomes vector operations."""
    result = np.empty_like(values)
    for i in range(len(values)):
        result[i] = function(values[i])
    return result


@pytest.mark.parametrize(
    ("ours", "exact", "low", "high", "relative", "absolute"),
    [
        (elementary.exp, np.exp, -87.3, 88.7, 1.2e-7, 0.0),
        (elementary.log, np.log, 1e-37, 3e38, 1.2e-7, 1e-9),
        (elementary.log, np.log, 0.5, 2.0, 1.2e-7, 1e-9),
        (elementary.tanh, np.tanh, -12.0, 12.0, 0.0, 2e-7),
        (elementary.tanh, np.tanh, 1e-30, 1.0, 4e-7, 0.0),
        (elementary.sigmoid, special.expit, -30.0, 30.0, 0.0, 2e-7),
    ],
)
def test_elementary_functions_are_as_exact_as_they_say(ours, exact, low, high, relative, absolute):
    spaced = np.geomspace if low > 0 else np.linspace
    values = spaced(low, high, 300_001).astype(np.float32)
    expected = exact(values.astype(np.float64))
    np.testing.assert_allclose(over(ours, values), expected, rtol=relative, atol=absolute)


@pytest.mark.parametrize(
    ("ours", "values", "expected"),
    [
        (elementary.exp, [nan, inf, -inf, 89, -104, 0], [nan, inf, 0, inf, 0, 1]),
        (elementary.log, [nan, inf], [nan, inf]),
        (elementary.tanh, [nan, inf, -inf], [nan, 1, -1]),
        (elementary.sigmoid, [nan, inf, -inf], [nan, 1, 0]),
    ],
)
def test_elementary_functions_at_the_ends(ours, values, expected):
    found = over(ours, np.float32(values).repeat(17))
    np.testing.assert_array_equal(found, np.float32(expected).repeat(17))


@settings(deadline=None, max_examples=80)
@given(
    st.integers(0, 2**32),
    *(st.integers(1, 5), st.integers(1, 400), st.integers(1, 20), st.booleans()),
)
def test_the_nearest_are_found_and_equals_in_order(seed, count_of_queries, total, size, on_a_grid):
    draw = np.random.default_rng(seed)
    points = draw.standard_normal((total, size)).astype(np.float32)
    queries = draw.standard_normal((count_of_queries, size)).astype(np.float32)
    if on_a_grid:  # many at equal distances, some at the same place
        points, queries = points.round(), queries.round()
    count = draw.integers(1, total + 1)
    zero, one = np.zeros(size), np.ones(size)
    squared_distances, indices = Neighbours(points, zero, one).nearest(queries, count)
    differences = queries.astype(np.float64)[:, None] - points
    exact = (differences * differences).sum(axis=2)
    order = np.argsort(exact, axis=1, kind="stable")[:, :count]
    expected = np.take_along_axis(exact, order, axis=1)
    np.testing.assert_allclose(squared_distances, expected, rtol=1e-5, atol=1e-6)
    if on_a_grid:  # so distances are exact
        np.testing.assert_array_equal(indices, order)
    assert all(len(set(row)) == count for row in indices.tolist())
    for n, row in enumerate(indices):
        np.testing.assert_allclose(exact[n, row], squared_distances[n], rtol=1e-5, atol=1e-6)
    single = [Neighbours(points, zero, one).nearest(query[None], count) for query in queries]
    assert np.array_equal(np.concatenate([distances for distances, _ in single]), squared_distances)


@pytest.mark.parametrize(("size", "total"), [(1, 30), (4, 500), (15, 2000)])
@pytest.mark.parametrize("centre", [0, 1000])
def test_the_mean_goes_before_the_scale(size, total, centre):
    """Far from the origin, too, at positions like 1000 ± 0.01. NaN is at no distance from any."""
    rng, spread = np.random.default_rng(0), np.array([0.01, 2, 1] * 5)[:size]
    points = (centre + spread * rng.standard_normal((total + 25, size))).astype(np.float32)
    points, queries = points[25:], np.append(points[:25], [[nan] * size], axis=0)
    mean, std = points.mean(0, dtype=np.float64), points.std(0, dtype=np.float64)
    squares, indices = Neighbours(points, mean, std).nearest(queries.astype(np.float32), 20)
    assert np.isnan(squares[25]).all() and ((indices >= 0) & (indices < total)).all()
    exact = (((queries[:25, None].astype(np.float64) - points[None]) / std) ** 2).sum(2)
    np.testing.assert_allclose(squares[:25], np.sort(exact, axis=1)[:, :20], rtol=1e-4, atol=1e-7)
    of_found = np.take_along_axis(exact, indices[:25], axis=1)
    np.testing.assert_allclose(of_found, squares[:25], rtol=1e-4, atol=1e-7)
    assert all(len(set(row)) == 20 for row in indices.tolist())


def test_what_comes_after_the_candidates_were_cut_down_still_counts():
    """Three blocks have more points than are asked for; the fourth has one just within reach."""
    draw = np.random.default_rng(0)
    places = np.append(draw.permutation(192) + 1.0, [99.5, 1000, 1001])
    points = places.astype(np.float32)[:, None]
    _, indices = Neighbours(points, np.zeros(1), np.ones(1)).nearest(np.zeros((1, 1)), 100)
    assert places[indices[0]].tolist() == [*range(1, 100), 99.5]
