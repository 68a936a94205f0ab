"""The benchmark: `python -m benchmarks [PART ...] [--quick]`; `make bench` does it all."""

import argparse
import time

import pandas as pd

from benchmarks import aggregate, breakdown, document, growth, plots, speed, workflow
from benchmarks.settings import FULL, QUICK, Scale


def draw(scale: Scale) -> None:
    """Pictures and tables from the data."""
    results = pd.read_csv(scale.data / "results.csv")
    plots.speed(aggregate.speed_summary(results), scale.pictures)
    plots.breakdown(pd.read_csv(scale.data / "breakdown.csv"), scale.pictures)
    plots.growth(pd.read_csv(scale.data / "growth.csv"), scale.pictures)
    document.write(scale)


PARTS = {
    "speed": speed.measure_all,
    "breakdown": breakdown.measure_all,
    "growth": growth.measure_all,
    "workflow": workflow.measure_all,
    "report": draw,
}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, "all"], default="all")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="minutes, to see it work; writes into benchmarks/quick/",
    )
    arguments = parser.parse_args()
    scale = QUICK if arguments.quick else FULL
    scale.data.mkdir(exist_ok=True)
    for part in PARTS if "all" in arguments.parts else arguments.parts:
        start = time.monotonic()
        PARTS[part](scale)
        print(f"{part}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
