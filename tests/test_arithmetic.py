"""Portable arithmetic: what is in use, and that nothing undoes it unnoticed."""

import json
import os
import subprocess
import sys

import pytest

from mace_rl import arithmetic
from mace_rl.arithmetic import EXPECTED, PORTABLE, VARIABLE, UnfitArithmeticError

REPORT = (
    "import mace_rl, json, numpy, scipy.linalg, numba.core.registry, torch\n"
    "from mace_rl.arithmetic import in_use, require\n"
    "require()\n"
    "print(json.dumps(in_use()))"
)


def python(code: str, **changes: str) -> subprocess.CompletedProcess[str]:
    """What a new process does that inherits nothing of this one's arithmetic."""
    inherited = {name: value for name, value in os.environ.items() if name not in PORTABLE}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={name: v for name, v in inherited.items() if name != VARIABLE} | changes,
        capture_output=True,
        text=True,
    )


def test_this_process_is_portable() -> None:
    import numba.core.registry  # noqa: F401
    import torch  # noqa: F401

    arithmetic.require()
    assert arithmetic.in_use() == {"arithmetic": "portable"} | EXPECTED


@pytest.mark.slow
def test_a_new_process_is_portable_whatever_it_was_given() -> None:
    given = dict.fromkeys(PORTABLE, "")
    assert json.loads(python(REPORT, **given).stdout) == {"arithmetic": "portable"} | EXPECTED


@pytest.mark.slow
def test_native_leaves_the_libraries_alone() -> None:
    inherited = python(REPORT, **PORTABLE, **{VARIABLE: "native"})
    alone = python(REPORT.replace("import mace_rl, json", "import json"), **{VARIABLE: "native"})
    assert json.loads(inherited.stdout)["arithmetic"] == "native"
    assert json.loads(inherited.stdout) == json.loads(alone.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "imported", "variable", "value", "used"),
    [
        ("numpy", "numpy", "NPY_DISABLE_CPU_FEATURES", "X86_V3 X86_V4 AVX512_ICL AVX512_SPR", ""),
        ("blas", "numpy", "OPENBLAS_CORETYPE", "Nehalem", ""),
        ("numba", "numba", "NUMBA_CPU_NAME", "nehalem", "numba.njit(lambda: 0)()"),
        ("torch", "torch", "ATEN_CPU_CAPABILITY", "default", "torch.zeros(9).sum()"),
    ],
)
def test_a_library_that_was_loaded_before_is_noticed(
    library: str, imported: str, variable: str, value: str, used: str
) -> None:
    # All else is portable from the start: the one library alone has to be found.
    code = f"import os; os.environ[{variable!r}] = {value!r}; import {imported}\n{used}\n{REPORT}"
    result = python(code, **{name: v for name, v in PORTABLE.items() if name != variable})
    assert f"not portable: {library} computes with" in result.stderr.splitlines()[-1]
    assert f"not {EXPECTED[library]}, because it was loaded before" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("package", ["tools.tables", "benchmarks.__main__"])
def test_what_a_checkout_runs_chooses_before_numpy_is_loaded(package: str) -> None:
    # A type that every processor has: what reads it before it is chosen computes with it.
    code = f"import {package}\nfrom mace_rl.arithmetic import in_use\nprint(in_use()['blas'])"
    assert python(code, OPENBLAS_CORETYPE="Nehalem").stdout.split() == [EXPECTED["blas"]]


def test_a_processor_without_avx2_gets_one_line_and_a_way_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(arithmetic.binding, "get_host_cpu_features", lambda: {"avx2": False})
    with pytest.raises(UnfitArithmeticError, match=r"AVX2 and FMA.*MACE_RL_ARITHMETIC=native"):
        arithmetic.require()
    for name in PORTABLE:
        monkeypatch.delenv(name, raising=False)
    arithmetic.prepare()
    assert not PORTABLE.keys() & os.environ.keys()


def test_a_mistake_in_the_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "natve")
    with pytest.raises(UnfitArithmeticError, match="is 'natve', but should be portable or native"):
        arithmetic.require()
