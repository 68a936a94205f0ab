"""exp, log and tanh of float32 as written-out arithmetic, and the fused multiply-add.

The functions of the C library, NumPy and LLVM depend on the processor in their last bits. These are
sums and products in a fixed order, the same bits everywhere. They have no branches, so loops over
them become vector operations. NaN stays NaN, by the order of the arguments to min and max.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mace_rl.numerics.compiling import kernel

HALF_LOG_TAU = 0.9189385332046727  # log √(2π)
f32 = np.float32


@intrinsic
def fma(context: Any, a: Any, b: Any, c: Any) -> Any:
    """a · b + c rounded once, of three float32 or three float64."""
    if not a == b == c or a not in (types.float32, types.float64):
        return None
    return a(a, b, c), lambda context, builder, signature, given: builder.fma(*given)


def unary(result: Any, kind: Any, code: Callable[[Any, Any], Any]) -> Any:
    """A compiled function kind → result by LLVM's `code`, of a builder and the argument."""

    @intrinsic
    def function(context: Any, x: Any) -> Any:
        return result(kind), lambda context, builder, signature, given: code(builder, given[0])

    return function


# The bits of a float32 as int32, and back.
bits_of = unary(types.int32, types.float32, lambda builder, x: builder.bitcast(x, ir.IntType(32)))
float_of = unary(types.float32, types.int32, lambda builder, x: builder.bitcast(x, ir.FloatType()))


@kernel
def tanh(x):
    """Hyperbolic tangent, to 2e-7.

    tanh 2y = 2t / (1 + t²) with t = tanh y ≈ y p(y²) / q(y²), Lambert's continued fraction to its
    seventh term. Its error is 1e-8; rounding can make the result exceed 1. From x = 9.2 on it is 1.
    """
    y = min(max(x * f32(0.5), f32(-4.6)), f32(4.6))
    s = y * y
    p = y * fma(fma(s + f32(378), s, f32(17325)), s, f32(135135))
    q = fma(fma(fma(f32(28), s, f32(3150)), s, f32(62370)), s, f32(135135))
    return f32(2) * p * q / fma(q, q, p * p)


ROUNDING = f32(1.5 * 2**23)  # added to a small number, it leaves no digits after the point


@kernel
def exp(x):
    """eˣ, to 1 unit in the last place; Inf above 88.72, 0 below -103.97.

    eˣ = 2ⁿ eʳ with n the nearest integer to x / ln 2, and a polynomial for |r| ≤ ln 2 / 2
    (coefficients: Cephes, expf).
    """
    x = min(max(x, f32(-105)), f32(90))
    shifted = fma(x, f32(1 / math.log(2)), ROUNDING)
    n = shifted - ROUNDING
    r = fma(n, f32(2.12194440e-4), fma(n, f32(-0.693359375), x))  # ln 2 in two parts
    y = fma(fma(f32(1.9875691500e-4), r, f32(1.3981999507e-3)), r, f32(8.3334519073e-3))
    y = fma(fma(fma(y, r, f32(4.1665795894e-2)), r, f32(1.6666665459e-1)), r, f32(5.0000001201e-1))
    y = fma(y, r * r, r) + f32(1)
    power = bits_of(shifted) - bits_of(ROUNDING)
    half = power >> np.int32(1)  # 2ⁿ itself may not be a float32
    rest = power - half
    one = np.int32(127)
    return y * float_of((half + one) << np.int32(23)) * float_of((rest + one) << np.int32(23))


@kernel
def log(x):
    """Natural logarithm of a normal positive number, to 1 unit in the last place; Inf of Inf."""
    # x = 2ⁿ m, and a polynomial for m between √½ and √2 (coefficients: Cephes, logf).
    bits = bits_of(x) - np.int32(0x3F3504F3)  # of √½
    n = f32(bits >> np.int32(23))
    f = float_of((bits & np.int32(0x007FFFFF)) + np.int32(0x3F3504F3)) - f32(1)
    y = fma(fma(f32(7.0376836292e-2), f, f32(-1.1514610310e-1)), f, f32(1.1676998740e-1))
    y = fma(
        fma(fma(y, f, f32(-1.2420140846e-1)), f, f32(1.4249322787e-1)), f, f32(-1.6668057665e-1)
    )
    y = fma(fma(fma(y, f, f32(2.0000714765e-1)), f, f32(-2.4999993993e-1)), f, f32(3.3333331174e-1))
    s = f * f
    y = fma(n, f32(-2.12194440e-4), y * f * s)
    y = fma(f32(-0.5), s, y) + f
    y = fma(n, f32(0.693359375), y)
    return y if x < f32(math.inf) else x


@kernel
def sigmoid(x):
    """The logistic function, to 2e-7."""
    return f32(0.5) + f32(0.5) * tanh(f32(0.5) * x)
