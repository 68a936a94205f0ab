"""What a job does around its work: all output goes to its log, the reason of a failure also to the
terminal."""

import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PATIENCE = 1.0  # seconds between looks at whether Snakemake is alive

logger = logging.getLogger("job")


@contextmanager
def job(title: str, log: str) -> Iterator[None]:
    """Carry out the body as the job `title`.

    Standard output and error, those of compiled libraries too, are appended to the file `log`. If
    the body raises, the traceback goes there, a line to the terminal, and the process exits with 1.
    """
    _end_with_snakemake()
    terminal = os.dup(2)
    with open(log, "a", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    logging.basicConfig(
        stream=sys.stderr, level=logging.INFO, format="%(asctime)s %(message)s", force=True
    )
    logger.info("%s: started as process %d", title, os.getpid())
    start = time.monotonic()
    try:
        yield
    except KeyboardInterrupt:
        logger.info("%s: interrupted", title)
        sys.exit(130)
    except Exception as error:
        logger.exception("%s: failed", title)
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        os.write(terminal, f"{title} failed: {reason} (more in {log})\n".encode())
        sys.exit(1)
    logger.info("%s: done in %.1f s", title, time.monotonic() - start)


def _end_with_snakemake() -> None:
    """Let this process end with the Snakemake that started it.

    Without this a training goes on unseen when Snakemake is killed, and is in the way of the next.
    """
    snakemake_pid = os.environ.get("MACE_RL_SNAKEMAKE_PID")
    if snakemake_pid:
        watch = threading.Thread(target=_watch, args=(int(snakemake_pid),), daemon=True)
        watch.start()


def _watch(pid: int) -> None:
    while True:
        time.sleep(PATIENCE)
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            logger.info("Snakemake (process %d) is gone, so this job ends", pid)
            os._exit(1)
