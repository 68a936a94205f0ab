"""Exact nearest neighbours among a few thousand points, by brute force in compiled code.

Trees lose in this setting: the points change every episode, so a tree serves a few hundred
queries, and in Hopper's 15 dimensions it prunes next to nothing.
"""

import numpy as np
from numba import njit


class Neighbours:
    """Points among which the nearest are searched for: laid out once, then asked for one or many.

    points: float32 [M, size], finite; mean, std: [size]. Distances are Euclidean between
    (x - mean) / std of query and point. `mean` cancels but for rounding, which is least if it is
    near the points.
    """

    def __init__(self, points: np.ndarray, mean: np.ndarray, std: np.ndarray) -> None:
        self.mean, self.std = mean.astype(np.float32), std.astype(np.float32)
        self.columns = in_columns(points, self.mean, self.std)

    def __len__(self) -> int:
        return self.columns.shape[1]

    def nearest(self, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The `count` ≤ M nearest points to each query, nearest first, in units of `std`.

        queries: float32 [N, size]. Returns squared distances, float32 [N, count], and the points'
        indices, int64 [N, count]; of equally distant points the first come first.
        """
        return nearest_in_columns(queries, self.columns, self.mean, self.std, count)


def nearest(
    queries: np.ndarray, points: np.ndarray, mean: np.ndarray, std: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """`Neighbours.nearest` for points that are searched once."""
    return Neighbours(points, mean, std).nearest(queries, count)


@njit(cache=True, error_model="numpy")
def in_columns(points: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """`points` as `nearest_in_columns` takes them, float32."""
    # Points on columns, so that inner loops run along contiguous memory; dimensions four at a time,
    # to load and store the sums less often, filled up with zeros.
    total, size = points.shape
    columns = np.zeros(((size + 3) // 4 * 4, total), np.float32)
    for i in range(size):
        scale = np.float32(1) / std[i]
        for m in range(total):
            columns[i, m] = (points[m, i] - mean[i]) * scale
    return columns


@njit(cache=True, error_model="numpy")
def nearest_in_columns(
    queries: np.ndarray, columns: np.ndarray, mean: np.ndarray, std: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """See `Neighbours`; columns: the points as `in_columns` lays them out, for `mean` and `std`."""
    padded, total = columns.shape
    rows = np.zeros((len(queries), padded), np.float32)
    for i in range(len(mean)):
        scale = np.float32(1) / std[i]
        for n in range(len(queries)):
            rows[n, i] = (queries[n, i] - mean[i]) * scale
    squared_distances = np.empty((len(queries), count), np.float32)
    indices = np.empty((len(queries), count), np.int64)
    distances = np.empty(total, np.float32)
    minima = np.empty(total, np.float32)
    near = np.zeros((total + 7) // 8 * 8, np.bool_)
    eights = near.view(np.uint64)
    for n in range(len(queries)):
        distances[:] = 0
        for i in range(0, padded, 4):
            q0, q1, q2, q3 = rows[n, i], rows[n, i + 1], rows[n, i + 2], rows[n, i + 3]
            p0, p1, p2, p3 = columns[i], columns[i + 1], columns[i + 2], columns[i + 3]
            for m in range(total):
                d0, d1, d2, d3 = q0 - p0[m], q1 - p1[m], q2 - p2[m], q3 - p3[m]
                distances[m] = distances[m] + d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3

        # A limit that few points but the nearest are within: fold the array on itself until it is
        # the minima of at least `count` groups of points. The `count`-th smallest of these minima
        # has `count` points within it, one in each group.
        for m in range(total):  # several times faster than minima[:] = distances
            minima[m] = distances[m]
        width = total
        while width > 2 * count:
            half = (width + 1) // 2
            left, right = minima[: width - half], minima[half:width]
            for j in range(width - half):
                left[j] = min(left[j], right[j])
            width = half
        limit = np.float32(0)
        for j in range(width):
            smaller = 0
            for other in range(width):
                smaller += minima[other] < minima[j]
            if smaller < count:
                limit = max(limit, minima[j])
        for m in range(total):
            near[m] = not distances[m] > limit  # so written, NaN is near

        best, chosen = squared_distances[n], indices[n]
        found = 0
        for eight in range(len(eights)):
            if eights[eight] == 0:
                continue
            for m in range(8 * eight, min(8 * eight + 8, total)):
                distance = distances[m]
                if not near[m] or (found == count and distance >= best[count - 1]):
                    continue
                # Insertion into the sorted list of the best so far.
                place = min(found, count - 1)
                while place > 0 and best[place - 1] > distance:
                    best[place], chosen[place] = best[place - 1], chosen[place - 1]
                    place -= 1
                best[place], chosen[place] = distance, m
                found = min(found + 1, count)
    return squared_distances, indices
