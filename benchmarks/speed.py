"""Steps per second of everything in `settings.LABELS`, in turn: results.csv.

`python -m benchmarks.speed CONTESTANT ENVIRONMENT SEED STEPS ...` is one measurement.
"""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any

from benchmarks.process import (
    measured,
    memory_mb,
    one_thread,
    report,
    versions,
    write_rows,
)
from benchmarks.settings import ENVIRONMENTS, FIRST_SEED, OURS, WARM_UP_STEPS, Scale, contestants


def schedule(repeats: int) -> Iterator[tuple[int, str, str]]:
    """(repeat, environment, contestant), in turn; every repeat begins with another contestant.

    So whatever slows the machine down for a while, or warms it up, hits everybody.
    """
    for repeat in range(repeats):
        for environment in ENVIRONMENTS:
            names = contestants(environment)
            first = repeat % len(names)
            for contestant in names[first:] + names[:first]:
                yield repeat, environment, contestant


def marks(scale: Scale, environment: str, contestant: str) -> list[int]:
    """The numbers of steps at which the clock is read."""
    if contestant.startswith("environment"):
        return [scale.environment_steps[environment]]
    if contestant in OURS:
        return [scale.steps[environment], scale.later_steps[environment]]
    return [scale.steps[environment]]


def measure_all(scale: Scale) -> None:
    """Carry out all measurements and write results.csv, anew after each."""
    from mace_rl.provenance import cpu_model

    origin = {"cpu": cpu_model(), "versions": versions()}
    rows = []
    for repeat, environment, contestant in schedule(scale.repeats):
        stops = marks(scale, environment, contestant)
        for reading in measured("speed", contestant, environment, FIRST_SEED + repeat, *stops):
            identity = {"env": environment, "contestant": contestant, "repeat": repeat}
            rows.append(identity | reading | origin)
        write_rows(scale.data / "results.csv", rows)
        rate = rows[-1]["steps_per_second"]
        print(f"repeat {repeat + 1}: {environment} {contestant}: {rate:.0f} steps/s", flush=True)


def read_clock(progress: Iterable[int], stops: list[int]) -> list[dict[str, Any]]:
    """Iterate until the last of `stops` steps is reached, reading the clock at each of them.

    `steps`, those actually done, can be a little more: updates follow whole episodes.
    """
    readings = []
    seconds, cpu_seconds = time.perf_counter(), time.process_time()
    for steps in progress:
        while steps >= stops[len(readings)]:
            elapsed = time.perf_counter() - seconds
            readings.append(
                {
                    "target_steps": stops[len(readings)],
                    "steps": steps,
                    "seconds": elapsed,
                    "cpu_seconds": time.process_time() - cpu_seconds,
                    "steps_per_second": steps / elapsed,
                    "peak_memory_mb": memory_mb("VmHWM"),
                }
            )
            if len(readings) == len(stops):
                return readings
    raise RuntimeError(f"ended after {steps} steps, before {stops[-1]}")


def main() -> None:
    """One measurement."""
    contestant, environment, seed, *stops = sys.argv[1:]
    from benchmarks.contestants import start

    one_thread()
    warm_up = start(contestant, environment, int(seed) + 10**6, WARM_UP_STEPS)
    read_clock(warm_up, [WARM_UP_STEPS])
    stops = [int(stop) for stop in stops]
    report(read_clock(start(contestant, environment, int(seed), stops[-1]), stops))


if __name__ == "__main__":
    main()
