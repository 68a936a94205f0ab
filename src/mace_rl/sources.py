"""The content of the source files that a result depends on, as one digest.

What Snakemake lacks (9.27.1): it looks into scripts but not into what they import, so after an edit
of `src/mace_rl/agent/ppo.py` it has "Nothing to be done". Of a declared input it records the
content when the job *ended*. So the workflow gives each job the digest at planning.
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
    """SHA-256 of the names and contents of `files(part)` and of `own`.

    own: files outside this package that count too, such as the user's, without their imports.
    """
    lines = sorted([*_lines(part), *map(_line, own)])
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def files(part: str) -> list[Path]:
    """The source files of this package: "everything", or what a "training" depends on."""
    left_out = {PACKAGE / name for name in NO_PART} if part == "training" else set()
    found = [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.npz")]  # the meta network's weights
    return sorted(file for file in found if left_out.isdisjoint({file, *file.parents}))


@cache  # the code in this process is what it was when it was imported
def _lines(part: str) -> list[str]:
    return [_line(file) for file in files(part)]


def _line(file: Path) -> str:
    inside = file.is_relative_to(PACKAGE)  # its label is the same wherever the package lies
    label = file.relative_to(PACKAGE.parent) if inside else f"{file.parent.name}/{file.name}"
    return f"{label} {hashlib.sha256(file.read_bytes()).hexdigest()}\n"
