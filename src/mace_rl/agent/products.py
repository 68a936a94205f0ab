"""Matrix products and sums whose bits depend on no processor.

Every element of a product is one chain of fused multiply-adds over k, in order:

    C[i, j] = fma(A[i, K-1], B[K-1, j], … fma(A[i, 1], B[1, j], fma(A[i, 0], B[0, j], start[i, j])))

A fused multiply-add rounds once, and IEEE 754 says how, so it does not matter how many elements a
processor computes at once, nor in which order. It also does not matter where a chain is cut: what
came out so far is the next part's start. Libraries split the chains to gain speed, each processor's
kernel in another way, which is why their last bits differ.

A *tile* is a block of C that stays in the processor's registers while k runs. It is LLVM's code
with vectors of 16 floats: one register of AVX-512 or two of AVX2, as LLVM sees fit. For each k it
loads a row of B once, whatever the number of rows of A.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from mace_rl.agent.elementary import fma
from mace_rl.compiling import njit

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


def tile(rows: int, vectors: int) -> Any:
    """The compiled tile of `rows` × 16 `vectors`: C = start + Σ_k A[i, k] B[k, j].

    Its arguments are addresses (a, b, start, c) and distances: between rows of each and, for A,
    between the elements of a row; all in bytes. The last one is K.
    """

    @intrinsic
    def multiply(context, a, a_row, a_k, b, b_row, start, start_row, c, c_row, count):
        def codegen(context, builder, signature, arguments):
            a, a_row, a_k, b, b_row, start, start_row, c, c_row, count = arguments

            def place(base, row, distance, offset, kind):
                address = builder.add(builder.add(base, builder.mul(row, distance)), offset)
                return builder.inttoptr(address, kind.as_pointer())

            def load(base, row, distance, offset, kind):
                return builder.load(place(base, row, distance, offset, kind), align=4)

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

        return types.void(*[types.intp] * 10), codegen

    return multiply


# Eight chains have to be under way for a processor to be busy: each of its two units starts one a
# cycle and has the result four cycles later. With the 32 registers of AVX-512, 4 × 64 keeps sixteen
# in C and loads little; with AVX2's 16 of half the size, 6 × 16 fills twelve. What is left over, a
# row or a stripe of 16 columns, has tiles of its own.
broad, broad_pair, broad_row, long_row = tile(4, 4), tile(2, 4), tile(1, 4), tile(1, 16)
slim, slim_row = tile(8 if WIDE else 6, 1), tile(1, 1)
SLIM_ROWS = 8 if WIDE else 6


@njit(cache=True)
def address(array):
    """Where its elements begin, as int64: compiled code then has one kind of addresses."""
    return np.int64(array.ctypes.data)


@njit(cache=True)
def by_tiles(a, a_row, a_k, b, b_row, start, start_row, c, c_row, rows, columns, count):
    """C = start + A · B for `rows` × `columns` elements and K = `count`; arguments as in `tile`."""
    a_row, a_k, b_row, start_row, c_row = 4 * a_row, 4 * a_k, 4 * b_row, 4 * start_row, 4 * c_row
    j = 0
    while j < columns:
        b_j, start_j, c_j = b + 4 * j, start + 4 * j, c + 4 * j
        i = 0
        if WIDE and rows == 1 and j + 16 * LANES <= columns:
            long_row(a, a_row, a_k, b_j, b_row, start_j, start_row, c_j, c_row, count)
            j += 16 * LANES
        elif j + 4 * LANES <= columns and (WIDE or rows == 1):
            while i + 4 <= rows:
                broad(
                    *(a + i * a_row, a_row, a_k, b_j, b_row),
                    *(start_j + i * start_row, start_row, c_j + i * c_row, c_row, count),
                )
                i += 4
            while i + 2 <= rows:
                broad_pair(
                    *(a + i * a_row, a_row, a_k, b_j, b_row),
                    *(start_j + i * start_row, start_row, c_j + i * c_row, c_row, count),
                )
                i += 2
            if i < rows:
                broad_row(
                    *(a + i * a_row, a_row, a_k, b_j, b_row),
                    *(start_j + i * start_row, start_row, c_j + i * c_row, c_row, count),
                )
            j += 4 * LANES
        else:
            while i + SLIM_ROWS <= rows:
                slim(
                    *(a + i * a_row, a_row, a_k, b_j, b_row),
                    *(start_j + i * start_row, start_row, c_j + i * c_row, c_row, count),
                )
                i += SLIM_ROWS
            while i < rows:
                slim_row(
                    *(a + i * a_row, a_row, a_k, b_j, b_row),
                    *(start_j + i * start_row, start_row, c_j + i * c_row, c_row, count),
                )
                i += 1
            j += LANES


@njit(cache=True)
def product(a, b, start, c):
    """C = start + A · B, every row begun with the same `start`, [n].

    a: [M, ≥ K] with any strides, so also a transposed matrix; b: [K, n], c: [M, n], their rows
    contiguous and n a multiple of 16; all float32.
    """
    by_tiles(
        *(address(a), a.strides[0] // 4, a.strides[1] // 4, address(b), b.shape[1]),
        *(address(start), 0, address(c), c.shape[1], len(c), c.shape[1], len(b)),
    )


@njit(cache=True)
def add_product(a, b, c):
    """C = C + A · B: every chain goes on from what C has; arguments as in `product`."""
    by_tiles(
        *(address(a), a.strides[0] // 4, a.strides[1] // 4, address(b), b.shape[1]),
        *(address(c), c.shape[1], address(c), c.shape[1], len(c), c.shape[1], len(b)),
    )


@njit(cache=True)
def padded(columns):
    """The multiple of 16 that `columns` are filled up to."""
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
