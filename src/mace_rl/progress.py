"""What the trainings are doing, for whoever looks at the terminal.

    [12:03:10] 12 of 45 runs done, 2 running, 31 waiting; about 3 h 20 min left
      HopperBulletEnv-v0  mace_full  seed 3   episode 1204/6000   return   612.3    1830 steps/s
      CartPole-v1         ppo        seed 0   episode  804/2000   return   480.1   11230 steps/s

The workflow starts this module as a process of its own, which reads what the runs leave in their
folders: `progress.json` while one runs, `run.json` when it is done. It imports nothing large.
"""

import heapq
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, TextIO

SILENCE = 120.0  # seconds without news after which a run no longer counts as running
START_SECONDS = 5.0  # that a run takes before its training begins: imports, compiled code
TERMINAL_SECONDS = 10.0  # between reports on a terminal
FILE_SECONDS = 30.0  # between reports into a file or pipe


@dataclass(frozen=True)
class Run:
    """One training run of the study."""

    env: str
    variant: str
    seed: int
    episodes: int
    directory: str
    due: bool  # this workflow is to carry it out; otherwise it only tells how long others take

    @property
    def group(self) -> tuple[str, str]:
        """Runs of one group differ by their seed only and take about the same time."""
        return self.env, self.variant


@dataclass(frozen=True)
class Progress:
    """A run's `progress.json`."""

    episode: int
    episodes: int
    recent_return: float  # mean extrinsic return of the last episodes, 50 at most
    steps_per_second: float
    seconds: float  # of training so far
    time: float  # of writing, seconds since 1970
    pid: int


@dataclass(frozen=True)
class Status:
    """The runs that are due, by what they are doing."""

    done: Sequence[Run]
    running: Mapping[Run, Progress]
    stopped: Sequence[Run]  # before their time: failed, killed or interrupted
    waiting: Sequence[Run]


class Watch:
    """Reads the state of `runs` from their folders.

    `local` says that they run on this machine, so that a process number tells whether one is alive.
    """

    def __init__(
        self, runs: Iterable[Run], local: bool, started: float, alive: Callable[[int], bool]
    ) -> None:
        self.runs = list(runs)
        self.local = local
        self.started = started  # seconds since 1970
        self.alive = alive
        # Records of due runs are of an earlier training, which Snakemake deletes when it begins the
        # new one. They tell how long a run takes, but not that it is done.
        self.earlier = {run: _modified(run) for run in self.runs if run.due}
        self._records: dict[Run, tuple[int, float | None]] = {}

    def status(self, now: float) -> Status:
        """What the due runs are doing `now` (seconds since 1970)."""
        done, running, stopped, waiting = [], {}, [], []
        for run in self.runs:
            if not run.due:
                continue
            progress = read_progress(run)
            if _modified(run) not in (None, self.earlier[run]):
                done.append(run)
            elif progress is None:
                waiting.append(run)
            elif self.local and not self.alive(progress.pid):
                # Left behind by a training that ended before its time: now, or before the start.
                (stopped if progress.time >= self.started else waiting).append(run)
            elif now - progress.time > SILENCE:
                waiting.append(run)
            else:
                running[run] = progress
        return Status(done, running, stopped, waiting)

    def rates(self) -> dict[tuple[str, str], float]:
        """Seconds per episode in each group with finished runs."""
        rates: dict[tuple[str, str], list[float]] = {}
        for run in self.runs:
            modified = _modified(run)
            if modified is None:
                continue
            if self._records.get(run, (None, None))[0] != modified:
                self._records[run] = modified, _seconds_per_episode(run)
            rate = self._records[run][1]
            if rate is not None:
                rates.setdefault(run.group, []).append(rate)
        return {group: fmean(values) for group, values in rates.items()}


def read_progress(run: Run) -> Progress | None:
    """The run's `progress.json`; None if there is none or it is not (yet) readable."""
    values = _read_json(Path(run.directory, "progress.json"))
    try:
        return Progress(**{name: values[name] for name in Progress.__dataclass_fields__})
    except (KeyError, TypeError):
        return None


def seconds_left(
    status: Status, finished_rates: Mapping[tuple[str, str], float], cores: int
) -> float | None:
    """Seconds until the last due run is done; None without anything to judge by.

    A run is expected to take as long per episode as the finished runs of its group did. Groups
    without one go by their running runs, then by the same environment, then by all environments. A
    running run counts its own speed the more, the further it has come. The runs that wait are
    handed to whichever of the `cores` is free first, the longest first, as Snakemake does.
    """
    own = {
        run: progress.seconds / progress.episode
        for run, progress in status.running.items()
        if progress.episode > 0
    }
    of_group = {group: [rate] for group, rate in finished_rates.items()}
    for run, rate in own.items():
        if run.group not in finished_rates:
            of_group.setdefault(run.group, []).append(rate)
    if not of_group:
        return None if status.running or status.waiting else 0.0

    def expected(run: Run) -> float:
        """Seconds per episode."""
        return fmean(
            of_group.get(run.group)
            or [rate for (env, _), found in of_group.items() if env == run.env for rate in found]
            or [rate for found in of_group.values() for rate in found]
        )

    ends = []
    for run, progress in status.running.items():
        share = progress.episode / progress.episodes
        rate = share * own.get(run, 0.0) + (1 - share) * expected(run)
        ends.append(max(0.0, rate * progress.episodes - progress.seconds))
    ends += [0.0] * (cores - len(ends))
    heapq.heapify(ends)
    for seconds in sorted((expected(run) * run.episodes for run in status.waiting), reverse=True):
        heapq.heapreplace(ends, ends[0] + START_SECONDS + seconds)
    return max(ends)


def summary(status: Status, now: float) -> str:
    """How many runs are done and how many left at `now` (seconds since 1970)."""
    counts = {
        "running": len(status.running),
        "stopped": len(status.stopped),
        "waiting": len(status.waiting),
    }
    due = len(status.done) + sum(counts.values())
    parts = [f"{number} {what}" for what, number in counts.items() if number]
    clock = time.strftime("%H:%M:%S", time.localtime(now))
    return ", ".join([f"[{clock}] {len(status.done)} of {due} runs done", *parts])


def report(status: Status, left: float | None, now: float) -> str:
    """`summary`, the time `left` in seconds (None: not known yet) and a line for each run."""
    time_left = f"{duration(left)} left" if left is not None else "time left not known yet"
    env_width, variant_width = (
        max((len(getattr(run, name)) for run in status.running), default=0)
        for name in ("env", "variant")
    )
    lines = [
        f"  {run.env:{env_width}}  {run.variant:{variant_width}}  seed {run.seed:<3}"
        f"  episode {progress.episode:>5}/{progress.episodes:<5}"
        f"  return {progress.recent_return:>8.1f}  {progress.steps_per_second:>6.0f} steps/s"
        for run, progress in status.running.items()
    ]
    return "\n".join([f"{summary(status, now)}; {time_left}", *lines])


def duration(seconds: float) -> str:
    """`seconds` in words."""
    if seconds < 60:
        return "less than a minute"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"about {minutes} min"
    if minutes < 24 * 60:
        return f"about {minutes // 60} h {minutes % 60:02} min"
    hours = round(seconds / 3600)
    return f"about {hours // 24} d {hours % 24} h"


def start(runs: Iterable[Run], cores: int, local: bool) -> "subprocess.Popen[str]":
    """Start a process that reports on `runs` until `stop`, or until this process ends."""
    monitor = subprocess.Popen(
        [f"{sys.prefix}/bin/python", "-m", "mace_rl.progress"], stdin=subprocess.PIPE, text=True
    )
    assert monitor.stdin is not None
    task = {"runs": [asdict(run) for run in runs], "cores": cores, "local": local}
    monitor.stdin.write(json.dumps(task) + "\n")
    monitor.stdin.flush()
    return monitor


def stop(monitor: "subprocess.Popen[str]") -> None:
    """Let the process give its last report and wait for its end."""
    monitor.communicate()


def main() -> None:
    """Report on the runs named on standard input until that is closed or all are done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for Snakemake, whose end is ours
    watch, cores = _task(sys.stdin)
    seconds = TERMINAL_SECONDS if sys.stderr.isatty() else FILE_SECONDS
    pause = min(5.0, seconds)  # a first report soon
    while not select.select([sys.stdin], [], [], pause)[0]:
        pause = seconds
        now = time.time()
        status = watch.status(now)
        if not (status.running or status.waiting):
            break
        cores_in_use = cores if watch.local else max(1, len(status.running))
        left = seconds_left(status, watch.rates(), cores_in_use)
        _show(report(status, left, now))
    now = time.time()
    _show(summary(watch.status(now), now))


def _show(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def _task(stdin: TextIO) -> tuple[Watch, int]:
    task = json.loads(stdin.readline())
    runs = [Run(**run) for run in task["runs"]]
    return Watch(runs, task["local"], time.time(), _alive), task["cores"]


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # another user's
    return True


def _modified(run: Run) -> int | None:
    """When `run.json` was written, ns since 1970; None if there is none."""
    try:
        return Path(run.directory, "run.json").stat().st_mtime_ns
    except FileNotFoundError:
        return None


def _seconds_per_episode(run: Run) -> float | None:
    record = _read_json(Path(run.directory, "run.json"))
    try:
        return float(record["seconds"]) / int(record["config"]["episodes"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


def _read_json(path: Path) -> Any:
    """What is in `path`; None if it is missing or no JSON, which a later look may change."""
    try:
        return json.loads(path.read_bytes())
    except (FileNotFoundError, ValueError):
        return None


if __name__ == "__main__":
    main()
