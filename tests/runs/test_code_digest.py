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


def digests(source: Path, *own: Path) -> list[str]:
    """Of a copy of the packages: each part's, with files of a user's own, and the kernels'."""
    spec = spec_from_file_location("of_a_copy", source / "mace_rl" / "base" / "code_digest.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return [*(module.digest(part, *own) for part in PARTS), module.kernels()]


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy of the packages, which tests leave as they find it."""
    copy, unwanted = tmp_path_factory.mktemp("source"), shutil.ignore_patterns("__pycache__")
    for package in code_digest.PACKAGES["everything"]:
        shutil.copytree(code_digest.PACKAGE.parent / package, copy / package, ignore=unwanted)
    return copy


@pytest.fixture(scope="module")
def before(source) -> list[str]:
    found = digests(source)
    assert found[:2] == [code_digest.digest(part) for part in PARTS]
    return found


@pytest.mark.parametrize(("name", "added", "training", "everything", "kernels"), CHANGES)
def test_what_an_edit_changes(source, before, name, added, training, everything, kernels):
    file = source / name
    content = file.read_bytes() if file.exists() else b""
    file.write_bytes(content + f"\n{added}\n".encode())
    changed = [one != other for one, other in zip(digests(source), before, strict=True)]
    if content:
        file.write_bytes(content)
    else:
        file.unlink()
    assert changed == [training, everything, kernels]


def test_code_of_the_users_own_counts(source, tmp_path):
    own = tmp_path / "own.py"
    own.write_text('"""Words."""\n')
    first = digests(source, own)
    own.write_text("x = 1\n")
    same = [one == other for one, other in zip(first, digests(source, own), strict=True)]
    assert same == [False, False, True]


def test_kernels_come_from_the_folders_that_their_cache_looks_at():
    compiling = code_digest.PACKAGE / "numerics" / "compiling.py"
    found = {
        file.relative_to(code_digest.PACKAGE).parts[0]
        for file in code_digest.PACKAGE.rglob("*.py")
        if "numerics.compiling import" in file.read_text("utf-8") and file != compiling
    }
    assert found == {*code_digest.KERNELS}
