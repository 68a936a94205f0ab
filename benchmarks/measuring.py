"""What all measurements share: how long they take, a process of their own, and where they are kept.

A row of measurements.csv is one reading, in the columns `COLUMNS`; what a section has no use for
is empty.
"""

import multiprocessing
import os
import platform
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FILE = "measurements.csv"
COLUMNS = ("section", "env", "contestant", "repeat", "part", "steps", "seconds", "cpu_seconds")
COLUMNS += ("memory_mb", "note", "machine")

ENVIRONMENTS = CARTPOLE, ACROBOT, HOPPER = "CartPole-v1", "Acrobot-v1", "HopperBulletEnv-v0"
FIRST_SEED = 1000  # of the measurements; the study reports others
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
PACKAGES = "torch numpy numba gymnasium minigrid pybullet stable-baselines3"


@dataclass(frozen=True)
class Scale:
    """How long everything takes. Dictionaries are by environment, numbers of steps."""

    folder: Path
    repeats: int
    steps: dict[str, int]  # of one training: multiples of 2048, whole rollouts of everybody
    peer_steps: dict[str, int]  # of stable-baselines3's, and of environments without an agent


FULL = Scale(
    folder=ROOT / "benchmarks",
    repeats=5,
    steps={CARTPOLE: 204800, ACROBOT: 204800, HOPPER: 65536},
    peer_steps={CARTPOLE: 30720, ACROBOT: 30720, HOPPER: 16384},
)
QUICK = Scale(
    folder=ROOT / "benchmarks" / "quick",
    repeats=1,
    steps=dict.fromkeys(ENVIRONMENTS, 6144),
    peer_steps=dict.fromkeys(ENVIRONMENTS, 2048),
)


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """What `function(*arguments)` returns in a new process with one thread."""
    os.environ |= dict.fromkeys(THREADS, "1")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _prepare) as pool:
        return pool.submit(function, *arguments).result()


def _prepare() -> None:
    """From now on no library uses more than one thread, and what Bullet prints goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)


def memory_mb(which: str) -> float:
    """Resident memory of this process in MiB: "VmRSS" now, "VmHWM" at its highest.

    Not `ru_maxrss`, which starts at the peak of the process that started this one.
    """
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(which + ":"):
            return int(line.split()[1]) / 1024
    raise LookupError(f"/proc/self/status has no {which}")


def replace_section(folder: Path, section: str, rows: list[dict[str, Any]]) -> None:
    """Let these be all rows of the section in the folder's file; other sections stay."""
    import pandas as pd  # not in the measuring processes, whose memory counts

    from mace_rl.base.files import write_atomically
    from mace_rl.runs.provenance import cpu_model, git_state

    folder.mkdir(exist_ok=True)
    commit, python = git_state()["commit"] or "unknown", platform.python_version()
    versions = [f"{name} {metadata.version(name)}" for name in PACKAGES.split()]
    machine = f"{cpu_model()}; python {python}, {', '.join(versions)}; commit {commit[:7]}"
    table = pd.DataFrame(rows, columns=COLUMNS).assign(section=section, machine=machine)
    file = folder / FILE
    if file.exists():
        before = pd.read_csv(file)
        table = pd.concat([before[before["section"] != section], table])
    write_atomically(file, table.to_csv(index=False))
