"""Nearest neighbours against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mace_rl.numerics.nearest import Neighbours


@settings(deadline=None, max_examples=80)
@given(
    st.integers(0, 2**32),
    *(st.integers(1, 5), st.integers(1, 400), st.integers(1, 20), st.booleans()),
)
def test_the_nearest_are_found_and_equals_in_order(seed, count_of_queries, total, size, on_a_grid):
    draw = np.random.default_rng(seed)
    points, queries = (
        draw.standard_normal((count, size)).astype(np.float32)
        for count in (total, count_of_queries)
    )
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


def test_what_comes_after_the_candidates_were_cut_down_still_counts():
    """Three blocks have more points than are asked for; the fourth has one just within reach."""
    draw = np.random.default_rng(0)
    places = np.append(draw.permutation(192) + 1.0, [99.5, 1000, 1001])
    points = places.astype(np.float32)[:, None]
    _, indices = Neighbours(points, np.zeros(1), np.ones(1)).nearest(np.zeros((1, 1)), 100)
    assert places[indices[0]].tolist() == [*range(1, 100), 99.5]


def test_distances_are_in_the_units_given():
    points = np.array([[3.0, 10.0], [1.0, 20.0]], np.float32)
    near = Neighbours(points, np.array([1.0, 5.0]), np.array([2.0, 5.0]))
    squared_distances, indices = near.nearest(np.array([[1.0, 10.0]], np.float32), 2)
    assert indices.tolist() == [[0, 1]]  # (2 / 2)² = 1 and (10 / 5)² = 4
    np.testing.assert_allclose(squared_distances, [[1, 4]])


@pytest.mark.parametrize("total", [3, 200])
def test_a_query_that_is_not_a_number_has_no_distance(total):
    points = np.ones((total, 2), np.float32)
    squared_distances, _ = Neighbours(points, np.zeros(2), np.ones(2)).nearest(
        np.array([[np.nan, 0]], np.float32), 3
    )
    assert np.isnan(squared_distances).all()
