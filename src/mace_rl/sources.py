"""The content of the source files that a result depends on, as one digest.

What Snakemake lacks (9.27.1): it looks into scripts but not into what they import, so after an edit
of `src/mace_rl/agent/ppo.py` it has "Nothing to be done". Of a declared input it records the
content when the job *ended*. So the workflow gives each job the digest at planning.
"""

import ast
import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent
DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
# A training depends on all of this package but these: a new file counts until it stands here.
NO_PART = (
    *("study", "wrappers.py", "curiosity_tracker.py", "library.py", "cli.py", "__main__.py"),
    *("config/reading.py", "config/wrappers.py"),
    *("runs/evaluate.py", "runs/events.py", "runs/export.py"),
    *("runs/progress.py", "runs/queueing.py", "runs/verify.py", "runs/watch.py"),
)


def digest(part: str, *own: Path) -> str:
    """SHA-256 of the names and the `meaning` of `files(part)` and of `own`.

    own: files outside this package that count too, such as the user's, without their imports.
    """
    return _together([*_lines(part), *(_line(file, meaning(file)) for file in own)])


@cache
def training_bytes() -> str:
    """SHA-256 of all that a training depends on, byte by byte, in a tenth of `digest`'s time."""
    return _together([_line(file, file.read_bytes()) for file in files("training")])


def files(part: str) -> list[Path]:
    """The source files of this package: "everything", or what a "training" depends on."""
    left_out = {PACKAGE / name for name in NO_PART} if part == "training" else set()
    found = [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.npz")]  # the pretrained LSTM's weights
    return sorted(file for file in found if left_out.isdisjoint({file, *file.parents}))


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
    return [_line(file, meaning(file)) for file in files(part)]


def _line(file: Path, content: bytes) -> str:
    inside = file.is_relative_to(PACKAGE)  # its label is the same wherever the package lies
    label = file.relative_to(PACKAGE.parent) if inside else f"{file.parent.name}/{file.name}"
    return f"{label} {hashlib.sha256(content).hexdigest()}\n"


def _together(lines: list[str]) -> str:
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()
