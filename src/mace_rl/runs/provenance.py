"""Where a result comes from: code, versions, machine."""

import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

from mace_rl import sources
from mace_rl.config.plugins import source_file
from mace_rl.config.run import RunConfig
from mace_rl.refusal import Refusal

# The packages whose version can change a result.
PACKAGES = (
    "torch",
    "numpy",
    "scipy",
    "numba",
    "llvmlite",
    "gymnasium",
    "pybullet",
    "pybullet-envs-gymnasium",
)
# What every run.json has.
KEYS = {"config", "versions", "sources", "machine", "outputs"}


class ProvenanceError(Refusal, ValueError):
    """A `run.json` that cannot be trusted; the message names it."""


def sources_of(config: RunConfig) -> str:
    """The digest of all code that a run depends on, the user's own included."""
    own = (source_file(reference, key) for key, reference in config.references().items())
    return sources.digest("training", *own)


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def versions() -> dict[str, str]:
    """Python's version and those of `PACKAGES` that are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def git_state() -> dict[str, Any]:
    """Commit and whether tracked files differ from it; both None outside a git checkout."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(sources.PACKAGE), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return {
            "commit": git("rev-parse", "HEAD"),
            "dirty": bool(git("status", "--porcelain", "--untracked-files=no")),
        }
    except (FileNotFoundError, subprocess.CalledProcessError):  # no git, or no repository
        return {"commit": None, "dirty": None}


def peak_memory_mb() -> float:
    """The most resident memory, in MiB, that this process has had.

    Not `ru_maxrss`, which begins at the peak of the process that started this one.
    """
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return next(
        int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM:")
    )


def cpu_model() -> str:
    """The processor's name as the system gives it."""
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    names = [line.partition(":")[2].strip() for line in info.splitlines() if "model name" in line]
    return names[0] if names else platform.machine()


def machine() -> dict[str, Any]:
    """Processor, its number of cores, system and C library."""
    system = " ".join([platform.system(), *platform.libc_ver()])
    return {"cpu": cpu_model(), "cores": os.cpu_count(), "system": system}


def read_record(path: Path) -> dict[str, Any]:
    """A `run.json`; `ProvenanceError` if it is not whole."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        missing = KEYS - set(record)
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, TypeError) as error:
        raise ProvenanceError(f"{path}: not readable: {error}") from None
    if missing:
        raise ProvenanceError(f"{path}: the key {min(missing)!r} is missing")
    return record
