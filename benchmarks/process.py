"""Measuring in processes of their own: one thread each, nothing left over from the last one."""

import csv
import json
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from benchmarks.settings import ROOT

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
PACKAGES = (
    "torch",
    "numpy",
    "numba",
    "gymnasium",
    "pybullet",
    "pybullet-envs-gymnasium",
    "stable-baselines3",
)


def measured(module: str, *arguments: Any) -> Any:
    """The JSON that `python -m benchmarks.module arguments` prints in its last line."""
    run = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{module}", *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | ONE_THREAD,
        capture_output=True,
        text=True,
    )
    if run.returncode:
        sys.exit(f"benchmarks.{module} {' '.join(map(str, arguments))} failed:\n{run.stderr}")
    return json.loads(run.stdout.splitlines()[-1])


def one_thread() -> None:
    """What a measuring process begins with: no library uses more than one thread."""
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)


def report(result: Any) -> None:
    """What a measuring process ends with; see `measured`."""
    print(json.dumps(result), flush=True)


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """A CSV file with the keys of the first row as its header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def memory_mb(which: str) -> float:
    """Resident memory of this process in MiB: "VmRSS" now, "VmHWM" at its highest.

    Not `ru_maxrss`, which starts at the peak of the process that started this one.
    """
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(which + ":"):
            return int(line.split()[1]) / 1024
    raise LookupError(f"/proc/self/status has no {which}")


def versions() -> str:
    """Python and the packages that are measured, in one line."""
    found = [f"{name} {metadata.version(name)}" for name in PACKAGES]
    return ", ".join([f"python {platform.python_version()}", *found])
