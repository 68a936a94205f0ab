"""The files of a run, and how files are written and found."""

import errno
import itertools
import os
import stat
from collections.abc import Collection, Iterable
from pathlib import Path

from mace_rl.base.errors import Refusal

EPISODES = "episodes.csv"  # one row per training episode
DIAGNOSTICS = "diagnostics.csv"  # one row per update
AGENT = "agent.pt"  # the final weights
RECORD = "run.json"  # configuration, versions, machine, digests; written last
RESULTS = (EPISODES, DIAGNOSTICS, AGENT)  # equal to the bit if the run is repeated
EVENTS = "events.out.tfevents.mace-rl"  # for TensorBoard

CHECKPOINT = "checkpoint.pt"  # while the run trains: it resumes from this
PROGRESS = "progress.json"  # while it trains: for `mace-rl status`
LOCK = ".lock"  # held by the process that trains here; stays
OF_A_RUN = (*RESULTS, PROGRESS, RECORD, CHECKPOINT)
ASIDE = "_aside"  # and a number: folders in a run's, with earlier runs; no variant is named so
PLAN = "logs/plan.json"  # in a results folder: the runs that the workflow planned


def write_atomically(path: str | Path, content: str | bytes) -> None:
    """Replace `path` by `content` (text as UTF-8): readers and crashes find all or none of it."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:  # that of a full disk does not name the file
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def content(path: str | Path) -> bytes:
    """The bytes of a file; `OSError` for a pipe or a device, whose reader might wait for ever."""
    with open(path, "rb", opener=lambda name, how: os.open(name, how | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no ordinary file", str(path))
        return file.read()


def newer(path: Path, other: Path) -> bool:
    """Whether both files are there, and `path` was written last."""
    try:
        return path.stat().st_mtime_ns > other.stat().st_mtime_ns
    except FileNotFoundError:
        return False


def folder_of(environment: str) -> str:
    """What the folder of an environment's runs is called; no id has the '+' that stands for '/'."""
    return environment.replace("/", "+")


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

    Links are followed, also in loops; folders that `set_aside` made are left out. Raises `OSError`
    for a folder that cannot be read.
    """

    def unreadable(error: OSError) -> None:
        raise error

    found, seen, roots = [], set(), [folder]
    for root in roots:  # the list grows: links come last
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
    """`Refusal` if there is something at `out` that does not begin with these bytes."""
    if out.is_dir() or (out.exists() and content(out)[: len(begins)] != begins):
        raise Refusal(f"{out}: there already, and not written by this command; choose another name")
