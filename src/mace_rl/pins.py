"""Which instructions libraries compute with: those that every x86-64 processor with AVX2 has.

What trains compiled networks gives the same bits on every processor by construction
(`agent.products`). Beside it stand libraries that look at the processor when they are loaded, and
whose sums differ in the last bit: NumPy and OpenBLAS where tables and figures are made and where
Hopper turns a vector, PyTorch where a network is a torch module of one's own. They can be told
otherwise by variables that each reads once. Importing this module sets them, before any of these
libraries is loaded, and Matplotlib's backend: the commands and the workflow do; `import mace_rl`
alone does not.
"""

import os

from llvmlite import binding

PINS = {
    "OPENBLAS_CORETYPE": "Haswell",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "AVX2",  # matrix products of PyTorch, which has MKL in it
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # and its other products
}


def pin() -> None:
    """Set what the libraries read.

    Not where the processor lacks AVX2: a library told to use it would end the process.
    """
    try:
        features = binding.get_host_cpu_features()
    except RuntimeError:  # LLVM does not know this kind of processor
        return
    if features.get("avx2") and features.get("fma"):
        os.environ.update(PINS)


os.environ["MPLBACKEND"] = "agg"  # pictures go to files; a notebook's backend need not be here
pin()
