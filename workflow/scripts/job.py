"""What a job does around its work: all output goes to its log, which ends with what went wrong."""

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mace_rl.base import stdio

PATIENCE = 1.0  # seconds between looks at whether Snakemake is alive

logger = logging.getLogger("job")


@contextmanager
def job(snakemake: Any) -> Iterator[None]:
    """Carry out the body as the job that Snakemake's object of that name describes.

    All output, that of compiled libraries too, is appended to the job's log. If the body raises,
    the process exits with 1, and the log ends with the reason, which terminal.smk shows.
    """
    title = " ".join([snakemake.rule, *snakemake.wildcards])
    # Without this a training goes on unseen when Snakemake is killed.
    if "MACE_RL_SNAKEMAKE_PID" in os.environ:
        threading.Thread(target=_end_with_snakemake, daemon=True).start()
    stdio.secure()  # or the log gets the number of one that is closed
    with open(snakemake.log[0], "a", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    logging.basicConfig(
        stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(message)s", force=True
    )
    logger.info("%s: started as process %d", title, os.getpid())

    def interrupted(*_: object) -> None:
        os.write(2, f"{title}: interrupted\n".encode())
        os._exit(130)

    # An ordinary KeyboardInterrupt is lost if numba happens to compile; results are written
    # atomically and runs resume, so there is nothing to put in order.
    signal.signal(signal.SIGINT, interrupted)
    start = time.monotonic()
    try:
        yield
    except BaseException as error:  # sys.exit(0) of an environment, too, is no success
        logger.exception("%s failed", title)
        said = "; ".join([str(error), *getattr(error, "__notes__", ())])
        reason = f"{type(error).__name__}: {' '.join(said.split())}"
        logger.info("%s failed: %s", title, reason)
        sys.exit(1)
    logger.info("%s: done in %.1f s", title, time.monotonic() - start)


def _end_with_snakemake() -> None:
    pid = int(os.environ["MACE_RL_SNAKEMAKE_PID"])
    while _lives(pid):
        time.sleep(PATIENCE)
    logger.info("Snakemake (process %d) is gone, so this job ends", pid)
    os._exit(1)


def _lives(pid: int) -> bool:
    """Not if it was killed and nobody asks how it ended, as in a container without an init."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "XZ"
