"""The files of a run, and writing files so that neither a crash nor a reader finds half of one."""

import os
from pathlib import Path

EPISODES = "episodes.csv"  # one row per training episode
DIAGNOSTICS = "diagnostics.csv"  # one row per update
AGENT = "agent.pt"  # the final weights
RECORD = "run.json"  # configuration, versions, machine, digests; written last
RESULTS = (EPISODES, DIAGNOSTICS, AGENT)  # what the same run has to give again, to the bit
EVENTS = "events.out.tfevents.mace-rl"  # for TensorBoard, where they are asked for

CHECKPOINT = "checkpoint.pt"  # while it runs: from which it resumes ...
PROGRESS = "progress.json"  # ... and for whoever watches
LOCK = ".lock"  # held by the process that trains here; stays
PLAN = "logs/plan.json"  # of a results folder: its runs, as the workflow began them


def write_atomically(path: str | Path, content: str | bytes) -> None:
    """Replace `path` by `content` (text as UTF-8); a reader or a crash finds all or none of it."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:  # a full disk's does not say of which file
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
