"""Which instructions compute: by default those that every x86-64 processor with AVX2 and FMA has.

NumPy, OpenBLAS, numba and PyTorch look at the processor when they are loaded and take the widest
instructions that it has. Sums are then taken in another order, the last bit differs, and training
amplifies it. They can be told otherwise, by variables that each reads once, when it is loaded;
importing `mace_rl` sets these. What counts is what is in use in the end: `in_use` asks the
libraries themselves, and `require` refuses to go on if that is not what was chosen.
"""

import os
import sys

from llvmlite import binding
from threadpoolctl import threadpool_info

from mace_rl.refusal import Refusal

VARIABLE = "MACE_RL_ARITHMETIC"  # portable (default) or native

# What the libraries read, and `in_use` finds, when arithmetic is portable.
PORTABLE = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "NUMBA_CPU_NAME": "haswell",
    "NUMBA_CPU_FEATURES": "+avx2,+fma,+bmi,+bmi2,+f16c,+lzcnt,+popcnt,+movbe,+sse4.2",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",  # matrix products of PyTorch, which has MKL in it
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # and its other products
}
EXPECTED = {"blas": "Haswell", "numpy": "X86_V3", "numba": "haswell", "torch": "AVX2"}
NEEDED = ("avx2", "fma")


class UnfitArithmeticError(Refusal):
    """What computes is not what was chosen, or cannot be; the message says why."""


def chosen() -> str:
    """`portable` or `native`, as `MACE_RL_ARITHMETIC` says; `UnfitArithmeticError` for all else."""
    choice = os.environ.get(VARIABLE, "portable")
    if choice not in ("portable", "native"):
        raise UnfitArithmeticError(f"{VARIABLE} is {choice!r}, but should be portable or native")
    return choice


def processor_suffices() -> bool:
    """Whether this processor has what portable arithmetic needs."""
    try:
        features = binding.get_host_cpu_features()
    except RuntimeError:  # LLVM does not know this kind of processor
        return False
    return all(features.get(name, False) for name in NEEDED)


def prepare() -> None:
    """Set what the libraries read when they are loaded; to be called before any of them is.

    Not where portable arithmetic is impossible: a library told to use what a processor does not
    have would end the process. `require` says so later, and of a mistake in the variable too.
    """
    if os.environ.get(VARIABLE) != "native" and processor_suffices():
        os.environ.update(PORTABLE)
    else:  # what a process with portable arithmetic left to this one
        for name, _ in PORTABLE.items() & os.environ.items():
            del os.environ[name]


def in_use() -> dict[str, str]:
    """For each of the libraries that is loaded, which instructions it computes with.

    `blas`: OpenBLAS's kernels (NumPy's and SciPy's: joined by + if they differ); `numpy`: the
    widest group of instructions it may choose; `numba`: LLVM's processor; `torch`: PyTorch's.
    """
    found = {"arithmetic": chosen()}
    kernels = {
        library["architecture"]
        for library in threadpool_info()
        if library["internal_api"] == "openblas"
    }
    if kernels:
        found["blas"] = "+".join(sorted(kernels))
    if "numpy" in sys.modules:
        features = sys.modules["numpy"]._core._multiarray_umath.__cpu_features__
        groups = ("X86_V4", "X86_V3", "X86_V2")
        found["numpy"] = next((group for group in groups if features.get(group)), "baseline")
        extra = [name for name in ("AVX512_ICL", "AVX512_SPR") if features.get(name)]
        found["numpy"] = "+".join([found["numpy"], *extra])
    if "numba.core.registry" in sys.modules:
        target = sys.modules["numba.core.registry"].cpu_target.target_context.codegen()
        found["numba"] = target.magic_tuple()[1]
    if "torch" in sys.modules:
        found["torch"] = sys.modules["torch"].backends.cpu.get_cpu_capability()
    return found


def require() -> None:
    """Raise `UnfitArithmeticError` if arithmetic should be portable, and what is in use is not."""
    if chosen() == "native":
        return
    way_out = f"{VARIABLE}=native trains with whatever there is; its results are its own"
    if not processor_suffices():
        raise UnfitArithmeticError(
            "portable arithmetic needs an x86-64 processor with AVX2 and FMA, which this is not; "
            + way_out
        )
    for library, found in in_use().items():
        if found != EXPECTED.get(library, found):
            raise UnfitArithmeticError(
                f"arithmetic is not portable: {library} computes with {found}, not "
                f"{EXPECTED[library]}, because it was loaded before mace_rl; import mace_rl "
                f"first. {way_out}"
            )
