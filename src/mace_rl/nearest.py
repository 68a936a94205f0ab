"""Exact nearest neighbours among a few thousand points, by brute force in compiled code.

Trees lose in this setting: the points change every episode, so a tree serves a few hundred
queries, and in Hopper's 15 dimensions it prunes next to nothing.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def nearest(queries, points, count):
    """The `count` nearest points to each query, nearest first.

    queries: float32 [N, size]; points: float32 [M, size], M ≥ count. Returns squared Euclidean
    distances, float32 [N, count], and the points' indices, int64 [N, count]; of equally distant
    points the first in `points` come first.
    """
    columns = points.T.copy()  # so that the inner loop below runs along contiguous memory
    size, total = columns.shape
    squares = np.empty((len(queries), count), np.float32)
    indices = np.empty((len(queries), count), np.int64)
    distances = np.empty(total, np.float32)
    for n in range(len(queries)):
        distances[:] = 0
        for dimension in range(size):
            value = queries[n, dimension]
            column = columns[dimension]
            for m in range(total):
                difference = value - column[m]
                distances[m] += difference * difference
        best, places = squares[n], indices[n]
        found = 0
        for m in range(total):
            distance = distances[m]
            if found == count and distance >= best[count - 1]:
                continue
            # Insertion into the sorted list of the best so far.
            place = min(found, count - 1)
            while place > 0 and best[place - 1] > distance:
                best[place], places[place] = best[place - 1], places[place - 1]
                place -= 1
            best[place], places[place] = distance, m
            found = min(found + 1, count)
    return squares, indices
