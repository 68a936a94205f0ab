"""The content of the source files that a result depends on, as one digest.

Snakemake 9.27.1 looks into scripts but not into what they import, and records of an input what it
contained when the job *ended*. So the workflow gives each job the digest at planning.
"""

import ast
import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
# A training depends on this package, what is made of its runs on `mace_study`, too.
PACKAGES = {"training": ["mace_rl"], "everything": ["mace_rl", "mace_study"]}
# The folders that compiled code comes from.
KERNELS = ("agent", "beta", "bonus", "environments", "numerics", "training")
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def digest(part: str, *own: Path) -> str:
    """SHA-256 of the names and the `meaning` of `files(part)` and of `own`.

    own: files outside these packages that count too, such as the user's, without their imports.
    """
    return _together([*_lines(part), *(_line(file, meaning(file)) for file in own)])


@cache
def kernels() -> str:
    """SHA-256 of all that compiled code comes from, byte by byte, in a tenth of `digest`'s time."""
    found = sorted(file for name in KERNELS for file in (PACKAGE / name).rglob("*.py"))
    return _together([_line(file, file.read_bytes()) for file in found])


def files(part: str) -> list[Path]:
    """The source files of `PACKAGES[part]`."""
    folders = [PACKAGE.parent / name for name in PACKAGES[part]]
    return sorted(file for folder in folders for file in folder.rglob("*.py"))


def meaning(file: Path) -> bytes:
    """The syntax tree of a Python file without docstrings, comments and blank lines; else bytes."""
    content = file.read_bytes()
    if file.suffix != ".py":
        return content
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError):  # of the user's own; whoever imports it says so
        return content
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return ast.dump(tree).encode()


@cache  # the code in this process is what it was when it was imported
def _lines(part: str) -> list[str]:
    return [_own_line(file) for file in files(part)]


@cache  # both parts have it
def _own_line(file: Path) -> str:
    return _line(file, meaning(file))


def _line(file: Path, content: bytes) -> str:
    # The label is the same wherever the packages lie.
    inside = any(file.is_relative_to(PACKAGE.parent / name) for name in PACKAGES["everything"])
    label = file.relative_to(PACKAGE.parent) if inside else f"{file.parent.name}/{file.name}"
    return f"{label} {hashlib.sha256(content).hexdigest()}\n"


def _together(lines: list[str]) -> str:
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()
