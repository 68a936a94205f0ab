"""What a run and the compiled kernels depend on: which edits train or compile anew."""

import shutil
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from mace_rl.base import code_digest

PARTS = ("training", "everything")
CHANGES = [  # of a file, what is added, whether a training has other sources, all, the kernels
    ("mace_rl/agent/ppo.py", "ADDED = 1", True, True, True),
    ("mace_rl/config/agent.py", "ADDED = 1", True, True, False),
    ("mace_study/measure/metrics.py", "ADDED = 1", False, True, False),
    ("mace_study/show/sections.py", 'CAPTION = "another"', False, True, False),
    ("mace_rl/a_new_file.py", "ADDED = 1", True, True, False),
    ("mace_rl/base/stdio.py", "", False, False, False),  # a blank line
    ("mace_rl/agent/ppo.py", "# a comment", False, False, True),
    ("mace_rl/agent/ppo.py", '"""Not the docstring."""', True, True, True),  # a statement
]


@pytest.mark.parametrize(("name", "added", "training", "everything", "kernels"), CHANGES)
def test_what_an_edit_changes(tmp_path, name, added, training, everything, kernels):

    def copy():
        spec = spec_from_file_location(
            "of_a_copy", tmp_path / "mace_rl" / "base" / "code_digest.py"
        )
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    def digests(*own: Path) -> dict[str, str]:
        return {part: copy().digest(part, *own) for part in PARTS}

    unwanted = shutil.ignore_patterns("__pycache__")
    for package in code_digest.PACKAGES["everything"]:
        source = code_digest.PACKAGE.parent / package
        shutil.copytree(source, tmp_path / package, ignore=unwanted)
    before, compiled = digests(), copy().kernels()
    assert before == {part: code_digest.digest(part) for part in PARTS}
    file = tmp_path / name
    content = file.read_bytes() if file.exists() else b""
    file.write_bytes(content + f"\n{added}\n".encode())
    changed = {part for part, value in digests().items() if value != before[part]}
    assert changed == {
        part for part, does in zip(PARTS, (training, everything), strict=True) if does
    }
    assert (copy().kernels() != compiled) == kernels
    own = tmp_path / "own.py"
    own.write_text('"""Words."""\n')
    with_own = digests(own)
    own.write_text("x = 1\n")
    assert all(digests(own)[part] != value for part, value in with_own.items())


def test_kernels_come_from_the_folders_that_their_cache_looks_at():
    compiling = code_digest.PACKAGE / "numerics" / "compiling.py"
    for file in code_digest.PACKAGE.rglob("*.py"):
        if "numerics.compiling import" in file.read_text("utf-8") and file != compiling:
            assert file.relative_to(code_digest.PACKAGE).parts[0] in code_digest.KERNELS
