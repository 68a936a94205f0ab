"""Matrix products and sums whose bits depend on no processor.

Every element of a product is one chain of fused multiply-adds over k, in order:

    C[i, j] = fma(A[i, K-1], B[K-1, j], … fma(A[i, 1], B[1, j], fma(A[i, 0], B[0, j], start[i, j])))

A fused multiply-add rounds once, as IEEE 754 says. So it does not matter how many elements a
processor computes at once, nor where a chain is cut and continued. Libraries split the chains,
differently on each processor, so their last bits differ.

A *tile* is a block of C that stays in registers while k runs: LLVM code with vectors of 16 floats,
one register of AVX-512 or two of AVX2.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from mace_rl.numerics.compiling import njit
from mace_rl.numerics.elementary import fma

LANES = 16  # columns of B and C come in multiples of this, filled up with zeros
WIDE = "+avx512f" in cpu_target.target_context.codegen().magic_tuple()[2].split(",")
F32, I64 = ir.FloatType(), ir.IntType(64)
VECTOR = ir.VectorType(F32, LANES)


def fused(module: ir.Module) -> ir.Function:
    """LLVM's fused multiply-add of vectors."""
    return module.declare_intrinsic(
        f"llvm.fma.v{LANES}f32", (), ir.FunctionType(VECTOR, [VECTOR] * 3)
    )


def everywhere(builder: ir.IRBuilder, scalar: ir.Value, lanes: int = LANES) -> ir.Value:
    """A vector of one number."""
    undefined = ir.Constant(ir.VectorType(scalar.type, lanes), ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.IntType(32)(0))
    places = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    return builder.shuffle_vector(first, undefined, places)


class Matrix(NamedTuple):
    """A float32 matrix in memory: its address, and its strides in elements."""

    address: int
    row: int
    column: int  # 1 in B, C and `start`


def tile(rows: int, vectors: int) -> Any:
    """The compiled tile of `rows` × 16 `vectors`: C = start + Σ_k A[i, k] B[k, j], k < count."""

    @intrinsic
    def multiply(context, a, b, start, c, first_row, first_column, count):
        kinds = a, b, start, c

        def codegen(context, builder, signature, arguments):
            *matrices, first_row, first_column, count = arguments

            def bytes_of(matrix):
                address, *distances = (builder.extract_value(matrix, part) for part in range(3))
                return [address, *(builder.mul(distance, I64(4)) for distance in distances)]

            def place(base, row, distance, offset, kind):
                address = builder.add(builder.add(base, builder.mul(row, distance)), offset)
                return builder.inttoptr(address, kind.as_pointer())

            def load(base, row, distance, offset, kind):
                return builder.load(place(base, row, distance, offset, kind), align=4)

            (a, a_row, a_k), *others = map(bytes_of, matrices)
            a = builder.add(a, builder.mul(first_row, a_row))
            right = builder.mul(first_column, I64(4))
            (b, b_row), (start, start_row), (c, c_row) = (
                (builder.add(address, right), row) for address, row, _ in others
            )
            start = builder.add(start, builder.mul(first_row, start_row))
            c = builder.add(c, builder.mul(first_row, c_row))
            multiply_add = fused(builder.module)
            parts = [(i, v) for i in range(rows) for v in range(vectors)]
            begin = [load(start, I64(i), start_row, I64(4 * v * LANES), VECTOR) for i, v in parts]
            before = builder.block
            test, body, after = (builder.append_basic_block(name) for name in ("k", "add", "end"))
            builder.branch(test)
            builder.position_at_end(test)
            k = builder.phi(I64)
            sums = [builder.phi(VECTOR) for _ in parts]
            builder.cbranch(builder.icmp_signed("<", k, count), body, after)
            builder.position_at_end(body)
            row = [load(b, k, b_row, I64(4 * v * LANES), VECTOR) for v in range(vectors)]
            column = [
                everywhere(builder, load(a, k, a_k, builder.mul(a_row, I64(i)), F32))
                for i in range(rows)
            ]
            added = [
                builder.call(multiply_add, [column[i], row[v], value])
                for (i, v), value in zip(parts, sums, strict=True)
            ]
            following = builder.add(k, I64(1))
            builder.branch(test)
            for phi, first, later in zip(
                [k, *sums], [I64(0), *begin], [following, *added], strict=True
            ):
                phi.add_incoming(first, before)
                phi.add_incoming(later, body)
            builder.position_at_end(after)
            for (i, v), value in zip(parts, sums, strict=True):
                builder.store(value, place(c, I64(i), c_row, I64(4 * v * LANES), VECTOR), align=4)
            return context.get_dummy_value()

        return types.void(*kinds, *[types.int64] * 3), codegen

    return multiply


# Eight chains keep a processor busy: each of its two units starts one a cycle and has the result
# four cycles later. A tile of 4 × 64 keeps 16 of AVX-512's 32 registers in C; 6 × 16 fills 12 of
# AVX2's 16, which are half as large. Rows and stripes of 16 columns left over have their own tiles.
broad, broad_pair, broad_row, long_row = tile(4, 4), tile(2, 4), tile(1, 4), tile(1, 16)
slim, slim_row = tile(8 if WIDE else 6, 1), tile(1, 1)
SLIM_ROWS = 8 if WIDE else 6


@njit(cache=True)
def address(array):
    """Where its elements begin, as int64."""
    return np.int64(array.ctypes.data)


@njit(cache=True)
def matrix(array):
    """An array of two dimensions as a `Matrix`."""
    return Matrix(address(array), array.strides[0] // 4, array.strides[1] // 4)


@njit(cache=True)
def by_tiles(a, b, start, c, rows, columns, count):
    """C = start + A · B for `rows` × `columns` elements and K = `count`, of four `Matrix`."""
    j = 0
    while j < columns:
        i = 0
        if WIDE and rows == 1 and j + 16 * LANES <= columns:
            long_row(a, b, start, c, i, j, count)
            j += 16 * LANES
        elif j + 4 * LANES <= columns and (WIDE or rows == 1):
            while i + 4 <= rows:
                broad(a, b, start, c, i, j, count)
                i += 4
            while i + 2 <= rows:
                broad_pair(a, b, start, c, i, j, count)
                i += 2
            if i < rows:
                broad_row(a, b, start, c, i, j, count)
            j += 4 * LANES
        else:
            while i + SLIM_ROWS <= rows:
                slim(a, b, start, c, i, j, count)
                i += SLIM_ROWS
            while i < rows:
                slim_row(a, b, start, c, i, j, count)
                i += 1
            j += LANES


@njit(cache=True)
def product(a, b, start, c):
    """C = start + A · B, every row begun with the same `start`, [n].

    a: [M, ≥ K] with any strides, so also a transposed matrix; b: [K, n], c: [M, n], their rows
    contiguous and n a multiple of 16; all float32.
    """
    row = Matrix(address(start), 0, 1)
    by_tiles(matrix(a), matrix(b), row, matrix(c), len(c), c.shape[1], len(b))


@njit(cache=True)
def add_product(a, b, c):
    """C = C + A · B: every chain continues from C; arguments as in `product`."""
    by_tiles(matrix(a), matrix(b), matrix(c), matrix(c), len(c), c.shape[1], len(b))


@njit(cache=True)
def padded(columns):
    """`columns` rounded up to a multiple of 16."""
    return (columns + LANES - 1) // LANES * LANES


@njit(cache=True)
def dot(a, b):
    """Σ a b of two vectors of one length, float32 or float64: 64 chains, added up in order."""
    size = 4 * LANES
    sums = np.zeros(size, a.dtype)
    for start in range(0, len(a), size):
        left, right = a[start : start + size], b[start : start + size]
        if len(left) == size:
            for j in range(size):
                sums[j] = fma(left[j], right[j], sums[j])
        else:
            for j in range(len(left)):
                sums[j] = fma(left[j], right[j], sums[j])
    total = sums[0]
    for j in range(1, size):
        total += sums[j]
    return total
