"""Measuring in processes of their own: one thread each, nothing left over from the last one."""

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def in_fresh_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """What `function(*arguments)` returns in a new process with one thread."""
    os.environ |= dict.fromkeys(THREADS, "1")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), prepare) as pool:
        return pool.submit(function, *arguments).result()


def prepare() -> None:
    """From now on no library uses more than one thread, and what Bullet prints goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)


def write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """A CSV file with the keys of the rows as its header."""
    import pandas as pd  # not in the measuring processes, whose memory counts

    pd.DataFrame(rows).to_csv(path, index=False)


def memory_mb(which: str) -> float:
    """Resident memory of this process in MiB: "VmRSS" now, "VmHWM" at its highest.

    Not `ru_maxrss`, which starts at the peak of the process that started this one.
    """
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(which + ":"):
            return int(line.split()[1]) / 1024
    raise LookupError(f"/proc/self/status has no {which}")
