"""The price of portable arithmetic: our own trainings with it and without, in turn: arithmetic.csv.

The two do not compute the same: their bits differ, and so do their episodes before long. What is
compared are steps per second of CPU time over the same number of steps.
"""

import os
from typing import Any

from benchmarks import speed
from benchmarks.process import in_fresh_process, write_rows
from benchmarks.settings import ENVIRONMENTS, FIRST_SEED, Scale
from mace_rl import arithmetic

CONTESTANTS = ("ppo", "mace_full")
KINDS = ("portable", "native")
LIBRARIES = ("blas", "numpy", "numba", "torch")  # of `arithmetic.in_use`


def measure_all(scale: Scale) -> None:
    """Measure everything `scale.repeats` times, every other time the other kind first."""
    rows: list[dict[str, Any]] = []
    for repeat in range(scale.repeats):
        for environment in ENVIRONMENTS:
            for contestant in CONTESTANTS:
                for kind in KINDS if repeat % 2 else reversed(KINDS):
                    what = (contestant, environment, FIRST_SEED + repeat)
                    rows.append(with_arithmetic(kind, *what, scale.later_steps[environment]))
                    print(*rows[-1].values(), flush=True)
                    write_rows(scale.data / "arithmetic.csv", rows)


def with_arithmetic(
    kind: str, contestant: str, environment: str, seed: int, steps: int
) -> dict[str, Any]:
    """A row of the table, of a training in a process that computes as `kind` says."""
    before = os.environ.get(arithmetic.VARIABLE)
    os.environ[arithmetic.VARIABLE] = kind
    arithmetic.prepare()  # what the process inherits
    try:
        return in_fresh_process(measure, contestant, environment, seed, steps)
    finally:
        del os.environ[arithmetic.VARIABLE]
        if before is not None:
            os.environ[arithmetic.VARIABLE] = before
        arithmetic.prepare()


def measure(contestant: str, environment: str, seed: int, steps: int) -> dict[str, Any]:
    """Steps per CPU second of one training, and the arithmetic that was in use."""
    [reading] = speed.measure(contestant, environment, seed, [steps])
    row = {"env": environment, "contestant": contestant, "seed": seed}
    row |= {"steps_per_cpu_second": reading["steps"] / reading["cpu_seconds"]}
    return row | arithmetic.in_use()
