"""The files of a run, and writing files so that neither a crash nor a reader finds half of one."""

import itertools
import os
from collections.abc import Collection, Iterable
from pathlib import Path

from mace_rl.refusal import Refusal

EPISODES = "episodes.csv"  # one row per training episode
DIAGNOSTICS = "diagnostics.csv"  # one row per update
AGENT = "agent.pt"  # the final weights
RECORD = "run.json"  # configuration, versions, machine, digests; written last
RESULTS = (EPISODES, DIAGNOSTICS, AGENT)  # what the same run has to give again, to the bit
EVENTS = "events.out.tfevents.mace-rl"  # for TensorBoard, where they are asked for

CHECKPOINT = "checkpoint.pt"  # while it runs: from which it resumes ...
PROGRESS = "progress.json"  # ... and for whoever watches
LOCK = ".lock"  # held by the process that trains here; stays
OF_A_RUN = (*RESULTS, PROGRESS, RECORD, CHECKPOINT)
ASIDE = "_aside"  # and a number: folders in a run's, with earlier runs; no variant is named so
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


def set_aside(folder: Path, names: Iterable[str]) -> Path:
    """Move files of `folder`, in the order of `names`, into a new folder below it; returns that."""
    places = (folder / f"{ASIDE}{number}" for number in itertools.count(1))
    aside = next(place for place in places if not place.exists())
    aside.mkdir()
    for name in names:
        os.replace(folder / name, aside / name)
    return aside


def runs_below(folder: Path, names: Collection[str]) -> list[Path]:
    """The folders in and below `folder` that have one of the files `names`, sorted; each once.

    Folders behind links too, however they form loops. Not what `set_aside` made. Raises `OSError`
    for a folder that cannot be read.
    """

    def unreadable(error: OSError) -> None:
        raise error

    found, seen, roots = [], set(), [folder]
    for root in roots:  # which grow: what is behind links comes after all else
        for place, below, inside in os.walk(root, onerror=unreadable):
            below[:] = [name for name in below if not name.startswith(ASIDE)]
            if os.path.realpath(place) in seen:
                below.clear()
                continue
            seen.add(os.path.realpath(place))
            roots += [Path(place, name) for name in sorted(below) if Path(place, name).is_symlink()]
            if not set(names).isdisjoint(inside):
                found.append(Path(place))
    return sorted(found)


def require_ours(out: Path, begins: bytes) -> None:
    """`Refusal` if there is something at `out` that does not begin as what is to replace it."""
    if out.is_dir() or (out.exists() and out.read_bytes()[: len(begins)] != begins):
        raise Refusal(f"{out}: there already, and not written by this command; choose another name")
