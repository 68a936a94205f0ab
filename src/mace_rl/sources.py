"""The content of the source files that a result depends on, as one digest.

What Snakemake lacks (9.27.1): edit `src/mace_rl/agent/ppo.py` after a study, and it has "Nothing to
be done", since it looks into scripts but not into what they import; and of a declared input it
records what the file contained when the job *ended*. So the workflow hands each job the digest of
the rooms that it works in, as they are when it is planned.
"""

import hashlib
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent
# A training depends on all of this package but these: a new file counts until it stands here.
NO_PART = (
    *("study", "wrappers.py", "curiosity_tracker.py", "library.py", "cli.py", "__main__.py"),
    *("config/reading.py", "config/wrappers.py"),
    *("runs/evaluate.py", "runs/events.py", "runs/export.py"),
    *("runs/progress.py", "runs/queueing.py", "runs/verify.py", "runs/watch.py"),
)


def digest(part: str, *own: Path) -> str:
    """SHA-256 over names and contents of what "training" depends on, or of "everything".

    own: files beside this package that count too, such as a script or code of the user's own, but
    not what they import in their turn.
    """
    lines = sorted([*_lines(part), *map(_line, own)])
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def files(part: str) -> list[Path]:
    """The source files of this package: "everything", or what a "training" depends on."""
    left_out = [PACKAGE / name for name in NO_PART] if part == "training" else []
    found = [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.npz")]  # the meta network's weights
    return sorted(file for file in found if not {file, *file.parents}.intersection(left_out))


@cache  # of code that is imported, and so stays in this process what it was
def _lines(part: str) -> list[str]:
    return [_line(file) for file in files(part)]


def _line(file: Path) -> str:
    return f"{_label(file)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n"


def _label(file: Path) -> str:
    """The file's place in this package, or its folder and name: the same wherever both lie."""
    inside = file.is_relative_to(PACKAGE)
    return str(file.relative_to(PACKAGE.parent)) if inside else f"{file.parent.name}/{file.name}"
