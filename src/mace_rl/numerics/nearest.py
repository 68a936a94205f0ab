"""Exact nearest neighbours among a few thousand points, by brute force in compiled code.

Trees are slower here: the points change every few episodes, and in Hopper's 15 dimensions a tree
prunes next to nothing. The points are dealt into 64 groups. The k-th smallest of the groups' least
distances bounds the distance of the k nearest points, and few others are within it.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import bits_of, float_of, unary
from mace_rl.numerics.matmul import LANES, VECTOR, address, everywhere, fused

VECTORS = 4
BLOCK = VECTORS * LANES  # points whose distances are computed at once
RANKED = 32  # numbers that are compared at once
FAR = 1e18  # what fills up the last block


class Neighbours:
    """An index of points, to search for their nearest neighbours.

    points: float32 [M, size], finite; mean, std: [size]. Distances are Euclidean between
    (x - mean) / std of query and point. A `mean` near the points keeps rounding errors small.
    """

    def __init__(self, points: np.ndarray, mean: np.ndarray, std: np.ndarray) -> None:
        self.count = len(points)
        self.mean, self.std = mean.astype(np.float32), std.astype(np.float32)
        self.blocks = in_blocks(points, self.mean, self.std)

    def __len__(self) -> int:
        return self.count

    def nearest(self, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The `count` ≤ M nearest points to each query, nearest first, in units of `std`.

        queries: float32 [N, size]. Returns squared distances, float32 [N, count], and the points'
        indices, int64 [N, count]. Equally distant points come in their own order.
        """
        if not 0 < count <= len(self):
            raise ValueError(f"{count} neighbours of {len(self)} points")
        return nearest_in_blocks(queries, self.blocks, self.mean, self.std, self.count, count)


@kernel
def aligned_buffer(count):
    """`count` floats from the beginning of a cache line, where vectors load fastest."""
    memory = np.empty(count + LANES, np.float32)
    first = -memory.ctypes.data % (4 * LANES) // 4
    return memory[first : first + count]


@kernel
def in_blocks(points, mean, std):
    """`points` as `nearest_in_blocks` takes them: standardised, float32 [⌈M / 64⌉, size, 64]."""
    total, size = points.shape
    count = (total + BLOCK - 1) // BLOCK
    blocks = aligned_buffer(count * size * BLOCK).reshape(count, size, BLOCK)
    blocks[:] = np.float32(FAR)
    for i in range(size):
        scale = np.float32(1) / std[i]
        for m in range(total):
            blocks[m // BLOCK, i, m % BLOCK] = (points[m, i] - mean[i]) * scale
    return blocks


@intrinsic
def measure(
    context: Any, blocks: Any, count: Any, query: Any, size: Any, distances: Any, least: Any
) -> Any:
    """Fill in the squared distances of a query to all points of `count` blocks, and the least.

    All but count and size are addresses; `least` is [64], over the same place in each block.
    """

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        blocks, count, query, size, distances, least = arguments
        number, width = ir.IntType(64), 4 * BLOCK

        def place(base: Any, offset: Any, kind: Any) -> Any:
            return builder.inttoptr(builder.add(base, offset), kind.as_pointer())

        def constant(value: float) -> Any:
            return [ir.Constant(VECTOR, [value] * LANES)] * VECTORS

        before = builder.block
        names = ("block", "dimension", "summed", "end")
        block, dimension, summed, end = (builder.append_basic_block(name) for name in names)
        builder.branch(block)
        builder.position_at_end(block)
        b = builder.phi(number)
        minima = [builder.phi(VECTOR) for _ in range(VECTORS)]
        here = builder.add(blocks, builder.mul(b, builder.mul(size, number(width))))
        builder.branch(dimension)
        builder.position_at_end(dimension)
        i = builder.phi(number)
        sums = [builder.phi(VECTOR) for _ in range(VECTORS)]
        coordinate = builder.load(place(query, builder.mul(i, number(4)), ir.FloatType()), align=4)
        coordinate, added = everywhere(builder, coordinate), []
        for v, value in enumerate(sums):
            offset = builder.add(builder.mul(i, number(width)), number(4 * LANES * v))
            apart = builder.fsub(coordinate, builder.load(place(here, offset, VECTOR), align=4))
            added.append(builder.call(fused(builder.module), [apart, apart, value]))
        next_dimension = builder.add(i, number(1))
        builder.cbranch(builder.icmp_signed("<", next_dimension, size), dimension, summed)
        builder.position_at_end(summed)
        smaller = []
        for v, (value, minimum) in enumerate(zip(added, minima, strict=True)):
            offset = builder.add(builder.mul(b, number(width)), number(4 * LANES * v))
            builder.store(value, place(distances, offset, VECTOR), align=4)
            less = builder.fcmp_ordered("<", value, minimum)
            smaller.append(builder.select(less, value, minimum))
        next_block = builder.add(b, number(1))
        builder.cbranch(builder.icmp_signed("<", next_block, count), block, end)
        for phis, first, entering, later, leaving in (
            ([b, *minima], [number(0), *constant(np.inf)], before, [next_block, *smaller], summed),
            ([i, *sums], [number(0), *constant(0.0)], block, [next_dimension, *added], dimension),
        ):
            for phi, value, following in zip(phis, first, later, strict=True):
                phi.add_incoming(value, entering)
                phi.add_incoming(following, leaving)
        builder.position_at_end(end)
        for v, value in enumerate(smaller):
            builder.store(value, place(least, number(4 * LANES * v), VECTOR), align=4)
        return context.get_dummy_value()

    return types.void(*[types.intp] * 6), codegen


@intrinsic
def within(context: Any, distances: Any, bound: Any) -> Any:
    """A bit for each of the 64 distances at this address: whether it is ≤ `bound` or NaN."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.VectorType(ir.FloatType(), BLOCK)
        values = builder.load(builder.inttoptr(arguments[0], kind.as_pointer()), align=4)
        bounds = everywhere(builder, arguments[1], BLOCK)
        return builder.bitcast(builder.fcmp_unordered("<=", values, bounds), ir.IntType(BLOCK))

    return types.uint64(types.intp, types.float32), codegen


@intrinsic
def smaller(context: Any, numbers: Any, number: Any) -> Any:
    """A bit for each of the 32 int64 at this address: whether it is smaller than `number`."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.VectorType(ir.IntType(64), RANKED)
        values = builder.load(builder.inttoptr(arguments[0], kind.as_pointer()), align=8)
        bounds = everywhere(builder, arguments[1], RANKED)
        found = builder.bitcast(builder.icmp_signed("<", values, bounds), ir.IntType(RANKED))
        return builder.zext(found, ir.IntType(64))

    return types.uint64(types.intp, types.int64), codegen


# The place of the lowest bit that is set, 64 if none is; and the number of bits that are set.
lowest = unary(types.int64, types.uint64, lambda builder, x: builder.cttz(x, ir.IntType(1)(0)))
how_many = unary(types.int64, types.uint64, lambda builder, x: builder.ctpop(x))


# A point is one number: the bits of its squared distance, which sort as it does, then its place. So
# the nearest are the smallest numbers, and of equally distant ones the first.
PLACE = 2**32 - 1
INFINITE = np.int32(0x7F800000)  # the bits of float32's Inf
ALWAYS_WRITTEN = 4  # points of a block that are written down whether they are near or not
LARGEST = 2**63 - 1


@kernel
def distance_in(number):
    """The squared distance in such a number."""
    return float_of(np.int32(number >> 32))


@kernel
def nearest_in_blocks(queries, blocks, mean, std, total, count):
    """See `Neighbours`; blocks: of `total` points, by `in_blocks`, for `mean` and `std`."""
    size, block_count = len(mean), len(blocks)
    query, least = np.empty(size, np.float32), aligned_buffer(BLOCK)
    distances = aligned_buffer((block_count + 1) * BLOCK)  # the last are never near
    place = address(distances)
    numbers = np.empty(count + 2 * BLOCK + RANKED, np.int64)
    ranked = np.empty_like(numbers)
    squared_distances = np.empty((len(queries), count), np.float32)
    indices = np.empty((len(queries), count), np.int64)
    for n in range(len(queries)):
        for i in range(size):
            query[i] = (queries[n, i] - mean[i]) * (np.float32(1) / std[i])
        measure(address(blocks), block_count, address(query), size, place, address(least))
        bound, found = distance_bound(least, count), 0
        for b in range(block_count):
            bits = within(place + 4 * BLOCK * b, bound)
            if b == block_count - 1:
                bits &= ~np.uint64(0) >> np.uint64(block_count * BLOCK - total)
            # Always writing four, and overwriting what is too many, is faster than a branch.
            end = found + how_many(bits)
            for k in range(ALWAYS_WRITTEN):
                m = BLOCK * b + lowest(bits)
                numbers[found + k] = np.int64(bits_of(distances[m])) << 32 | m
                bits &= bits - np.uint64(1)
            for k in range(found + ALWAYS_WRITTEN, end):
                m = BLOCK * b + lowest(bits)
                numbers[k] = np.int64(bits_of(distances[m])) << 32 | m
                bits &= bits - np.uint64(1)
            found = end
            if found > count + BLOCK:
                sort(numbers, found, ranked)
                numbers[:count] = ranked[:count]
                found, bound = count, distance_in(numbers[count - 1])
        sort(numbers, found, ranked)
        for k in range(count):
            squared_distances[n, k] = distance_in(ranked[k])
            indices[n, k] = ranked[k] & PLACE
    return squared_distances, indices


@kernel
def distance_bound(least, count):
    """A bound for at least `count` of 64 distances, up to 1.6 % too large; Inf if `count` > 64."""
    low, high = np.int32(0), INFINITE
    if count > BLOCK:
        return float_of(high)
    while high - low > 2**17:  # of a float32's bits
        middle = np.int32((low + high) // 2)
        if how_many(within(address(least), float_of(middle))) < count:
            low = middle
        else:
            high = middle
    return float_of(high)


@kernel
def sort(numbers, found, ranked):
    """Sort the first `found` of different numbers into `ranked`, by how many are smaller."""
    for k in range(found, found + RANKED):
        numbers[k] = LARGEST
    for k in range(found):
        rank = 0
        for first in range(0, found, RANKED):
            rank += how_many(smaller(address(numbers) + 8 * first, numbers[k]))
        ranked[rank] = numbers[k]
