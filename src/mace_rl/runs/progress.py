"""How far trainings are and when they will be done: for `mace-rl train` and for the workflow.

A run tells now and then how far it is, in the values that `mace_rl.runs.run.how_far` makes. This
module imports nothing large; what it draws with, rich, only when it draws.
"""

import heapq
import json
import math
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from mace_rl import files

if TYPE_CHECKING:
    from rich.console import RenderableType

# From this share of its episodes on a run's own speed says when it ends. Before, and in a short run
# later too, its episodes still become longer or shorter as the policy learns.
OWN_SHARE = 0.3
SMOOTHING_SECONDS = 10.0  # in which a time left moves to a new estimate
FIRST_SECONDS, FILE_SECONDS = 5.0, 30.0  # into a file: until the first report, then between them


class Run(NamedTuple):
    """One training run of a study."""

    env: str
    variant: str
    seed: str
    episodes: int
    work: float  # how long it may take, compared with other runs of its environment
    folder: str

    def read(self, name: str) -> Any:
        """What is in the JSON file `name` of the run; None if there is none, or none yet."""
        try:
            return json.loads(Path(self.folder, name).read_bytes())
        except (OSError, ValueError):
            return None

    def seconds(self) -> float | None:
        """How long it took without its start, when last finished with as many episodes."""
        record = self.read(files.RECORD)
        try:
            seconds = record["seconds"] - record["start_seconds"]
            return seconds if record["config"]["episodes"] == self.episodes else None
        except (KeyError, TypeError):
            return None


class Pace:
    """The speed of one run, from the last quarter of its episodes so far."""

    def __init__(self, stale: Any = None) -> None:
        self.begun = time.monotonic()
        self.now = stale  # the newest reading; `stale` is one of an earlier attempt
        self.readings: deque[Mapping[str, Any]] = deque()

    def add(self, reading: Mapping[str, Any] | None) -> None:
        """Take in how far the run is."""
        if reading is None or reading == self.now:
            return
        if self.readings and reading["episode"] < self.now["episode"]:
            self.readings.clear()  # it began again from its checkpoint
        self.now = reading
        self.readings.append(reading)
        while len(self.readings) > 2 and 4 * self.readings[1]["episode"] <= 3 * reading["episode"]:
            self.readings.popleft()

    @property
    def seconds(self) -> float:
        """Of training, without its start."""
        return self.now["seconds"] - self.now["start_seconds"]

    def speed(self, what: str) -> float:
        """How many "episode"s or "env_steps" a second; NaN while nobody knows."""
        seconds = self.now["seconds"] - self.readings[0]["seconds"]
        return (self.now[what] - self.readings[0][what]) / seconds if seconds else math.nan

    def left(self) -> float:
        """Seconds to the last episode; NaN while that would be a guess."""
        known = self.now["episode"] >= OWN_SHARE * self.now["episodes"] and self.speed("episode")
        return (self.now["episodes"] - self.now["episode"]) / known if known else math.nan

    def cells(self) -> dict[str, str]:
        """What there is to show, by what it is called."""
        steps = self.speed("env_steps")
        return {
            "episode": f"{self.now['episode']}/{self.now['episodes']}",
            "return": f"{self.now['recent_return']:.1f}",
            "β": f"{self.now['beta']:.2f}",
            "steps/s": "" if math.isnan(steps) else f"{steps:.0f}",
            "left": duration(self.left()),
        }


class Countdown:
    """A time left that runs like a clock and moves to other estimates without a jump."""

    def __init__(self) -> None:
        self.shown = math.nan
        self.time = 0.0

    def show(self, estimate: float, now: float) -> float:
        """The seconds to show at `now`; NaN if the `estimate` is."""
        passed, self.time = now - self.time, now
        if math.isnan(self.shown) or math.isnan(estimate):
            self.shown = estimate
        else:
            ticked = max(1.0, self.shown - passed)
            weight = 1 - math.exp(-passed / max(SMOOTHING_SECONDS, ticked / 30))
            self.shown = ticked * (max(1.0, estimate) / ticked) ** weight
        return self.shown


def seconds_left(
    finished: Mapping[Run, float],
    running: Mapping[Run, Pace],
    waiting: Sequence[Run],
    cores: int,
    start: float,
) -> tuple[float, list[str]]:
    """Seconds to the end of the last run, and the environments left out, not known well enough yet.

    A run is expected to take as long, for its work, as the `finished` ones (seconds) of its
    environment, and of its variant if there are any. The more of that time is over, the more counts
    its own pace. Those that wait take `start` seconds more and are handed to whichever of the
    `cores` is free first, the longest first, as Snakemake does.
    """
    rates = defaultdict(list)  # seconds per work in an environment, and of a variant there
    for run, seconds in finished.items():
        for kind in (run[:1], run[:2]):
            rates[kind].append(seconds / run.work)
    means = {kind: fmean(found) for kind, found in rates.items()}

    def expected(run: Run) -> float:
        return run.work * means.get(run[:2], means.get(run[:1], math.nan))

    left = {run: start + expected(run) for run in waiting}
    for run, pace in running.items():
        own, others = pace.left(), expected(run) - pace.seconds
        share = min(1.0, pace.seconds / expected(run))
        mixed = share * own + (1 - share) * others
        left[run] = next((s for s in (mixed, own, others) if not math.isnan(s)), math.nan)
    unknown = {run.env for run, seconds in left.items() if math.isnan(seconds)}
    ends = [max(0.0, left[run]) for run in running if run.env not in unknown]
    queue = [left[run] for run in waiting if run.env not in unknown]
    if not ends and not queue:
        return math.nan, sorted(unknown)
    ends += [0.0] * max(cores - len(running), not ends)
    heapq.heapify(ends)
    for seconds in sorted(queue, reverse=True):
        heapq.heapreplace(ends, ends[0] + seconds)
    return max(ends), sorted(unknown)


def duration(seconds: float) -> str:
    """`seconds` in words; nothing if they are not known."""
    if math.isnan(seconds):
        return ""
    tens, minutes = math.ceil(seconds / 10), round(seconds / 60)
    if tens < 60:
        return f"{tens // 6} min {tens % 6}0 s" if tens >= 6 else f"{max(tens, 1)}0 s"
    return f"{minutes // 60} h {minutes % 60:02} min" if minutes >= 60 else f"{minutes} min"


class Display:
    """Shows the newest of what it is given: in place on a terminal, else as lines now and then."""

    def __init__(self, file: TextIO, no_color: bool = False) -> None:
        from rich.console import Console
        from rich.live import Live

        # A file is as wide as the lines are.
        width = None if file.isatty() else 120
        self.console = Console(file=file, highlight=False, width=width, no_color=no_color or None)
        self.in_place = file.isatty() and not self.console.is_dumb_terminal
        self.live = Live(console=self.console, auto_refresh=False, transient=True)
        self.next = time.monotonic() + FIRST_SECONDS

    def show(self, content: "RenderableType") -> None:
        """Show `content` instead of what was shown before."""
        if self.in_place:
            self.live.start()
            self.console.show_cursor()  # a killed process could not bring it back
            self.live.update(content, refresh=True)
        elif time.monotonic() >= self.next:
            self.next = time.monotonic() + FILE_SECONDS
            self.console.print(content)

    def print(self, text: str, style: str | None = None) -> None:
        """Write lines that stay."""
        self.console.print(text, style=style, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Take away what is shown in place."""
        self.live.stop()


@contextmanager
def line(file: TextIO) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Gives the function that shows one run's line, to be called with how far it is."""
    display, pace, countdown = Display(file), Pace(), Countdown()
    display.show("starting: the first episode waits for its code to be compiled")

    def show(reading: Mapping[str, Any]) -> None:
        pace.add(reading)
        left = duration(countdown.show(pace.left(), time.monotonic()))
        cells = pace.cells() | {"left": left}
        display.show("   ".join(f"{name} {text}" for name, text in cells.items() if text))

    try:
        yield show
    finally:
        display.close()
