"""The benchmark: `python -m benchmarks [PART ...] [--quick]`; `make bench` does it all."""

import argparse
import time
from importlib import import_module

from benchmarks.settings import FULL, QUICK

PARTS = ("speed", "breakdown", "growth", "workflow", "start", "wrapper", "purejaxrl", "arithmetic")
PARTS += ("update", "report")


def main() -> None:
    """Carry out the parts that are asked for, each by the function `measure_all` of its module."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        epilog="example: python -m benchmarks speed --quick",
    )
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
        import_module(f"benchmarks.{part}").measure_all(scale)
        print(f"{part}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
