"""Where a result comes from: code, versions, machine."""

import hashlib
import importlib.metadata
import json
import os
import platform
import re
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from mace_rl.base import code_digest
from mace_rl.base.errors import Refusal
from mace_rl.base.files import content
from mace_rl.config.plugins import source_files
from mace_rl.config.run import RunConfig
from mace_rl.config.section import check, short_repr
from mace_rl.environments import spec_of

# The packages whose version can change a result.
PACKAGES = (
    *("torch", "numpy", "scipy", "numba", "llvmlite"),
    *("gymnasium", "pybullet", "pybullet-envs-gymnasium"),
)


class RecordedConfig(BaseModel):
    """The keys of every configuration in a run.json, also of other versions."""

    model_config = ConfigDict(strict=True)

    environment: str = Field(pattern=r"^[A-Za-z0-9._:/-]+$")  # cells of the table of `export`
    variant: str = Field(pattern=r"^[A-Za-z0-9._-]+$")
    seed: int = Field(ge=0, lt=2**32)
    episodes: PositiveInt


class RunRecord(BaseModel):
    """The keys of every run.json."""

    model_config = ConfigDict(strict=True)

    config: RecordedConfig
    versions: dict[str, str]
    sources: str
    machine: dict[str, Any]
    outputs: dict[str, str]
    seconds: float


class GitError(Refusal, RuntimeError):
    """A failure of git; the message is its reason."""


class ProvenanceError(Refusal, ValueError):
    """A `run.json` that cannot be trusted; the message names it."""


def identity(config: RunConfig) -> dict[str, Any]:
    """Equal identities give equal results, and continue each other's checkpoints."""
    named = config.references().items()
    users_files = (file for key, name in named for file in source_files(name, key))
    return {
        "config": config.settings(),
        "versions": versions(config),
        "sources": code_digest.digest("training", *users_files),
    }


def difference(found: dict[str, Any], wanted: dict[str, Any], prefix: str = "") -> str:
    """The first key in which two nested dictionaries differ, with both values."""
    for key in [*wanted, *(key for key in found if key not in wanted)]:
        name = f"{prefix}{key}"
        old, new = found.get(key), wanted.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            if old != new:
                return difference(old, new, f"{name}.")
        elif old != new:
            return f"{name} was {short_repr(old)} and is {short_repr(new)}"
    return "no difference"


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    return hashlib.sha256(content(path)).hexdigest()


def versions(config: RunConfig) -> dict[str, str]:
    """Python's version and those of `PACKAGES`, and of the environment's, that are installed."""
    found = {"python": platform.python_version()}
    for name in dict.fromkeys([*PACKAGES, *packages_of_environment(config)]):
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def packages_of_environment(config: RunConfig) -> list[str]:
    """The environment's package and those of its wrappers, as if called like their modules."""
    entry = getattr(spec_of(config.environment), "entry_point", None)
    places = [entry if isinstance(entry, str) else "", *(name for name, _ in config.wrappers)]
    modules = (re.split(r"[.:]", place)[0].replace("_", "-") for place in places)
    return [name for name in modules if name not in ("", "mace-rl")]


def git_state() -> dict[str, Any]:
    """Commit of this package's checkout, and whether tracked files differ; None without one."""
    root = code_digest.PACKAGE.resolve().parents[1]
    try:
        git(root, "ls-files", "--error-unmatch", "src/mace_rl/runs/provenance.py")
        return {
            "commit": git(root, "rev-parse", "HEAD").decode().strip(),
            "dirty": bool(git(root, "status", "--porcelain", "--untracked-files=no")),
        }
    except (FileNotFoundError, GitError) as error:  # no git, or none of ours
        return {"commit": None, "dirty": None, "reason": str(error)}


def git(root: Path, *arguments: str) -> bytes:
    """The output of git in the checkout `root`, whoever owns it; `GitError` with git's reason."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    variables |= {"GIT_CEILING_DIRECTORIES": str(root.parent), "LC_ALL": "C"}
    command = ["git", "-C", str(root), "-c", f"safe.directory={root}"]
    command += ["-c", "core.fsmonitor=false"]  # a command that the repository names
    run = subprocess.run([*command, *arguments], capture_output=True, env=variables)
    if run.returncode:
        raise GitError(" ".join(run.stderr.decode(errors="replace").split()))
    return run.stdout


def peak_memory_mb() -> float:
    """The peak resident memory of this process, MiB."""
    # `ru_maxrss` would begin at the peak of the process that started this one.
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def cpu_model() -> str:
    """The processor's name as the system gives it."""
    found = re.search(r"model name\s*:(.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    return found[1].strip() if found else platform.machine()


def machine() -> dict[str, Any]:
    """Processor, its number of cores, system and C library."""
    system = " ".join([platform.system(), *platform.libc_ver()])
    return {"cpu": cpu_model(), "cores": os.cpu_count(), "system": system}


def read_record(path: Path) -> dict[str, Any]:
    """A `run.json`; `ProvenanceError` if there is none, `ConfigError` if it lacks something."""
    try:
        record: dict[str, Any] = json.loads(content(path))
    except (FileNotFoundError, NotADirectoryError):
        raise ProvenanceError(f"no finished run in {path.parent}: it has no {path.name}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ProvenanceError(f"{path}: not readable: {error}") from None
    check(RunRecord, record, str(path))
    return record
