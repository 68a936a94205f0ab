"""How far trainings are and when they will be done: `mace-rl train`, and `mace-rl status`.

Snakemake 9.27.1 counts jobs, not the episodes within them, and estimates no time left.
"""

import fcntl
import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, TextIO

from pydantic import BaseModel, ConfigDict

from mace_rl.base import files
from mace_rl.config.section import ConfigError, check

FILE_SECONDS = 30.0  # between the lines of `line` in a file
EARLY = 0.1  # the share of its episodes before which a run's own estimate would be a guess


class Planned(BaseModel):
    """A run of the workflow's plan."""

    env: str
    variant: str
    seed: int
    work: float  # relative duration among runs of its environment
    due: bool = False


class Plan(BaseModel):
    """The workflow's plan."""

    cores: int | None
    runs: list[Planned]


class Record(BaseModel):
    """What is needed of a run.json."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    seconds: float
    start_seconds: float


class Named(BaseModel):
    """What is needed of a run's configuration."""

    environment: str
    variant: str
    seed: int


class Finished(Record):
    """The same of a run of which no plan tells."""

    config: Named


class Progress(Record):
    """What is needed of a run's progress."""

    episode: int
    episodes: int
    recent_return: float
    beta: float
    steps_per_second: float
    left: float


def cells(progress: Mapping[str, Any]) -> dict[str, str]:
    """The columns for a run that trains; progress: by `mace_rl.runs.run.progress_of`."""
    early = progress["seconds"] - progress["start_seconds"] < 1
    return {
        "episode": f"{progress['episode']}/{progress['episodes']}",
        "return": f"{progress['recent_return']:.1f}",
        "β": f"{progress['beta']:.2f}",
        "steps/s": "" if early else f"{progress['steps_per_second']:.0f}",
        "left": duration(own_estimate(progress)),
    }


def own_estimate(progress: Mapping[str, Any]) -> float:
    """Seconds to a run's end from its speed so far; NaN early, when episodes' lengths change."""
    return progress["left"] if progress["episode"] >= EARLY * progress["episodes"] else math.nan


def duration(seconds: float) -> str:
    """`seconds` in words; "" for NaN."""
    if math.isnan(seconds):
        return ""
    minutes = math.ceil(seconds / 60)
    if seconds <= 100:
        return f"{max(10, math.ceil(seconds / 10) * 10)} s"
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"


@contextmanager
def line(file: TextIO) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """A function that shows a run's progress: in place on a terminal, now and then in a file."""
    in_place = file.isatty()
    before, after, pause = ("\x1b[2K", "\r", 0.0) if in_place else ("", "\n", FILE_SECONDS)
    due = time.monotonic() + pause
    if in_place:
        file.write("starting: the first episode waits for its code to be compiled\r")

    def show(progress: Mapping[str, Any]) -> None:
        nonlocal due
        if time.monotonic() >= due:
            due = time.monotonic() + pause
            text = "   ".join(f"{name} {text}" for name, text in cells(progress).items() if text)
            file.write(f"{before}{text}{after}")
            file.flush()

    try:
        yield show
    finally:
        file.write(before)
        file.flush()


def status(results: Path) -> list[str]:
    """The lines of `mace-rl status`: the runs that a workflow in `results` planned, or else all."""
    path, cores = results / files.PLAN, None
    if path.exists():
        if (found := read(path, 0.0, Plan)) is None:
            raise ConfigError(f"{path}: cut off or altered; the workflow's next start writes it")
        plan = Plan(**found)
        cores = plan.cores
        began = path.stat().st_mtime
        runs = [
            Run(run, results / "runs" / run.env / run.variant / f"seed{run.seed}", began)
            for run in plan.runs
        ]
    elif not (runs := [*unplanned(results)]):
        reason = "no run in it or below it is finished or has told its progress"
        raise ConfigError(f"{results}: {reason}, and there is no {files.PLAN} of a workflow")
    states = Counter(run.state for run in runs)
    counts = [f"{states[state]} {state}" for state in ("running", "waiting", "stopped")]
    shown = [f"{states['done']} of {len(runs)} runs done", *(c for c in counts if c[:2] != "0 ")]
    left, unknown = seconds_left(runs, cores or states["running"])
    heading = ", ".join(shown)
    if states["running"]:
        heading += f"; about {duration(left)} left" if left else "; time left not known yet"
        heading += f", without {' and '.join(unknown)}" if left and unknown else ""
    rows = [run.row() for run in runs if run.state in ("running", "stopped")]
    table = [list(rows[0]), *(list(row.values()) for row in rows)] if rows else []
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [heading, *("  ".join(map(str.rjust, row, widths)) for row in table)]


class Run:
    """One training run, as its folder shows it now; of a plan that was made when it `began`."""

    def __init__(self, planned: Planned, folder: Path, began: float, name: str = "") -> None:
        self.env, self.variant, self.seed = planned.env, planned.variant, planned.seed
        self.work, self.name = planned.work, name
        since = began if planned.due else 0.0  # older files are of an earlier attempt
        record = read(folder / files.RECORD, since, Record)
        progress = read(folder / files.PROGRESS, since, Progress)
        self.progress = progress or {}
        self.seconds = math.nan  # of the whole training, if known
        if (progress or not record) and held(folder / files.LOCK):  # a finished run may go on
            self.state = "running"
        elif record and not files.newer(folder / files.PROGRESS, folder / files.RECORD):
            self.state, self.seconds = "done", record["seconds"] - record["start_seconds"]
        else:
            self.state = "stopped" if progress else "waiting"
        if self.state == "running" and progress:
            self.seconds = progress["seconds"] - progress["start_seconds"] + own_estimate(progress)

    def left(self, expected: float) -> float:
        """Seconds to its end: its own estimate, or as if it takes `expected` seconds."""
        known = own_estimate(self.progress) if self.progress else math.nan
        spent = self.progress["seconds"] - self.progress["start_seconds"] if self.progress else 0.0
        return expected - spent if math.isnan(known) else known

    def row(self) -> dict[str, str]:
        """Its row in the table."""
        shown = dict.fromkeys(("episode", "return", "β", "steps/s", "left"), "")
        shown |= cells(self.progress) if self.progress else {"episode": "starting"}
        shown |= {"left": "stopped"} if self.state == "stopped" else {}
        what = {"environment": self.env, "variant": self.variant, "seed": str(self.seed)}
        return ({"folder": self.name} if self.name else {}) | what | shown


def unplanned(results: Path) -> Iterator[Run]:
    """The runs in and below a folder, finished or with progress to tell, in the folders' order."""
    for folder in files.runs_below(results, [files.RECORD, files.PROGRESS]):
        record = read(folder / files.RECORD, 0.0, Finished)
        known = record["config"] if record else read(folder / files.PROGRESS, 0.0, Named)
        if known is not None:
            own = Planned(
                env=known["environment"], variant=known["variant"], seed=known["seed"], work=1.0
            )
            yield Run(own, folder, 0.0, folder.relative_to(results).as_posix())


def read(path: Path, since: float, model: type[BaseModel]) -> Any:
    """A JSON file that was written after `since`; None if there is none, or it is incomplete.

    `ConfigError` if it has not what `model` has.
    """
    try:
        content = json.loads(files.content(path)) if path.stat().st_mtime >= since else None
    except (FileNotFoundError, RecursionError, ValueError):  # the last also of what is no text
        return None
    if content is not None:
        check(model, content, str(path))
    return content


def held(lock: Path) -> bool:
    """Whether a process, on any machine, has locked this file."""
    try:
        with open(lock, "rb", opener=lambda name, how: os.open(name, how | os.O_NONBLOCK)) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def seconds_left(runs: Sequence[Run], cores: int) -> tuple[float, list[str]]:
    """Seconds to the end of the last run, and the environments left out since none is known."""
    # A run is expected to take as long, for its work, as the known ones of its environment.
    paces: dict[str, list[float]] = {}
    for run in runs:
        if not math.isnan(run.seconds):
            paces.setdefault(run.env, []).append(run.seconds / run.work)
    open_runs = [run for run in runs if run.state in ("running", "waiting")]
    lefts = [run.left(run.work * fmean(paces.get(run.env, [math.nan]))) for run in open_runs]
    unknown = {run.env for run, left in zip(open_runs, lefts, strict=True) if math.isnan(left)}
    known = [max(0.0, left) for left in lefts if not math.isnan(left)]
    return max([0.0, sum(known) / max(cores, 1), *known]), sorted(unknown)
