"""How far trainings are and when they will be done: `mace-rl train`, and `mace-rl status`.

A run tells now and then how far it is (`mace_rl.runs.run.how_far`). What Snakemake lacks (9.27.1;
snakemake-logger-plugin-rich 0.5.1 too): it counts jobs, knows nothing of the episodes within them,
and has no time left, which would have to know that Hopper takes longer than CartPole.
"""

import fcntl
import heapq
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, TextIO

from mace_rl import files
from mace_rl.refusal import Refusal

FILE_SECONDS = 30.0  # between the lines of `line` in a file
EARLY = 0.1  # the share of its episodes before which a run alone does not say when it ends


class NoPlanError(Refusal, ValueError):
    """A folder in which no workflow has begun."""


def cells(told: Mapping[str, Any]) -> dict[str, str]:
    """What there is to show of a run that trains, by what it is called."""
    early = told["seconds"] - told["start_seconds"] < 1
    return {
        "episode": f"{told['episode']}/{told['episodes']}",
        "return": f"{told['recent_return']:.1f}",
        "β": f"{told['beta']:.2f}",
        "steps/s": "" if early else f"{told['steps_per_second']:.0f}",
        "left": duration(left_alone(told)),
    }


def left_alone(told: Mapping[str, Any]) -> float:
    """Seconds to a run's end by what it tells itself; NaN while that would be a guess.

    Its episodes become longer or shorter as the policy learns.
    """
    return told["left"] if told["episode"] >= EARLY * told["episodes"] else math.nan


def duration(seconds: float) -> str:
    """`seconds` in words; nothing if they are not known."""
    if math.isnan(seconds):
        return ""
    minutes = math.ceil(seconds / 60)
    if seconds <= 100:
        return f"{max(10, math.ceil(seconds / 10) * 10)} s"
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"


@contextmanager
def line(file: TextIO) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Gives the function that shows one run's line, in place or in a file now and then."""
    due = time.monotonic() + FILE_SECONDS / 6
    in_place = file.isatty()
    if in_place:
        file.write("starting: the first episode waits for its code to be compiled\r")

    def show(told: Mapping[str, Any]) -> None:
        nonlocal due
        text = "   ".join(f"{name} {text}" for name, text in cells(told).items() if text)
        if in_place:
            file.write(f"\x1b[2K{text}\r")
        elif time.monotonic() >= due:
            due = time.monotonic() + FILE_SECONDS
            file.write(f"{text}\n")
        file.flush()

    try:
        yield show
    finally:
        if in_place:
            file.write("\x1b[2K")
            file.flush()


def status(results: Path) -> list[str]:
    """The table of `mace-rl status`, by what the workflow planned in `results` when it began."""
    try:
        plan = json.loads((results / files.PLAN).read_bytes())
    except FileNotFoundError:
        raise NoPlanError(f"{results}: no workflow has begun here: no {files.PLAN}") from None
    began = (results / files.PLAN).stat().st_mtime
    runs = [Run(run, results, began) for run in plan["runs"]]
    states = Counter(run.state for run in runs)
    counts = [f"{states[state]} {state}" for state in ("running", "waiting", "stopped")]
    shown = [f"{states['done']} of {len(runs)} runs done", *(c for c in counts if c[:2] != "0 ")]
    left, unknown = seconds_left(runs, plan["cores"] or states["running"])
    heading = ", ".join(shown)
    if states["running"]:
        heading += f"; about {duration(left)} left" if left else "; time left not known yet"
        heading += f", without {' and '.join(unknown)}" if left and unknown else ""
    rows = [run.row() for run in runs if run.state in ("running", "stopped")]
    table = [list(rows[0]), *(list(row.values()) for row in rows)] if rows else []
    return [heading, *aligned(table)]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of text as lines with columns, the first two to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            text.ljust(width) if place < 2 else text.rjust(width)
            for place, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


class Run:
    """One training run of a plan, as its folder shows it now."""

    def __init__(self, planned: Mapping[str, Any], results: Path, began: float) -> None:
        self.env, self.variant, self.seed = planned["env"], planned["variant"], planned["seed"]
        self.work = planned["work"]  # how long it may take, compared with others of its environment
        folder = results / "runs" / self.env / self.variant / f"seed{self.seed}"
        since = began if planned["due"] else 0.0  # what is older is of an earlier attempt
        record, told = (read(folder / name, since) for name in (files.RECORD, files.PROGRESS))
        self.told = told or {}
        self.seconds = math.nan  # of the whole training, as far as that is known
        if record:
            self.state, self.seconds = "done", record["seconds"] - record["start_seconds"]
        elif held(folder / files.LOCK):
            self.state = "running"
        else:
            self.state = "stopped" if told else "waiting"
        if self.state == "running" and told:
            self.seconds = told["seconds"] - told["start_seconds"] + left_alone(told)

    def left(self, expected: float) -> float:
        """Seconds to its end, if one like it takes `expected`; its own tell more and more."""
        if not self.told:
            return expected
        share = self.told["episode"] / self.told["episodes"]
        spent = self.told["seconds"] - self.told["start_seconds"]
        known = [(1 - share, expected - spent), (share, left_alone(self.told))]
        known = [(weight, seconds) for weight, seconds in known if not math.isnan(seconds)]
        weights = sum(weight for weight, _ in known)
        return max(0.0, sum(w * s for w, s in known) / weights) if weights else math.nan

    def row(self) -> dict[str, str]:
        """What there is to show of it."""
        blank = dict.fromkeys(("episode", "return", "β", "steps/s", "left"), "")
        shown = cells(self.told) if self.told else blank | {"episode": "starting"}
        shown |= {"left": "stopped"} if self.state == "stopped" else {}
        return {"environment": self.env, "variant": self.variant, "seed": str(self.seed)} | shown


def read(path: Path, since: float) -> Any:
    """What is in a JSON file that was written `since` then; None if there is none, or not whole."""
    try:
        return json.loads(path.read_bytes()) if path.stat().st_mtime >= since else None
    except (FileNotFoundError, json.JSONDecodeError):
        return None


def held(lock: Path) -> bool:
    """Whether a process, on whichever machine, has locked this file."""
    try:
        with lock.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def seconds_left(runs: Sequence[Run], cores: int) -> tuple[float, list[str]]:
    """Seconds to the end of the last run, and the environments left out, of which none is known.

    A run is expected to take as long, for its work, as those of its environment that are done or
    far enough, and as those of its variant if there are any. Those that wait are handed to the one
    of the `cores` that is free first, the longest first, as Snakemake does.
    """
    known = [run for run in runs if not math.isnan(run.seconds)]
    ends: list[float] = []
    queue: list[float] = []
    unknown = set()
    for run in runs:
        if run.state in ("done", "stopped"):
            continue
        alike = [one for one in known if one.env == run.env and one is not run]
        alike = [one for one in alike if one.variant == run.variant] or alike
        expected = run.work * fmean(one.seconds / one.work for one in alike) if alike else math.nan
        left = run.left(expected)
        if math.isnan(left):
            unknown.add(run.env)
        else:
            (ends if run.state == "running" else queue).append(left)
    ends += [0.0] * max(cores - len(ends), not ends)
    heapq.heapify(ends)
    for seconds in sorted(queue, reverse=True):
        heapq.heapreplace(ends, ends[0] + seconds)
    return max(ends), sorted(unknown)
