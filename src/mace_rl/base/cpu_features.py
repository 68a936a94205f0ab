"""Make libraries use only the instructions that every x86-64 processor with AVX2 has.

Compiled training gives the same bits on every processor by construction (`numerics.matmul`).
NumPy, OpenBLAS and PyTorch, used for tables, figures, Hopper and torch modules of one's own, choose
instructions by the processor, and their last bits differ. Importing this module before them sets
the variables that restrict them, and Matplotlib's backend: the commands and the workflow do that,
`import mace_rl` alone does not.
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
    """Set the variables, unless the processor lacks AVX2: the libraries would end the process."""
    try:
        features = binding.get_host_cpu_features()
    except RuntimeError:  # LLVM does not know this kind of processor
        return
    if features.get("avx2") and features.get("fma"):
        os.environ.update(PINS)


os.environ["MPLBACKEND"] = "agg"  # draws files; a notebook's backend may not be installed here
pin()
