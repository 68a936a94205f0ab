"""The benchmark: `python -m benchmarks [SECTION ...] [--quick]`; `make bench` does it all."""

import mace_rl.base.cpu_features  # noqa: F401  isort: skip  (pins NumPy before it is imported)

import argparse
import time
from importlib import import_module

from benchmarks import page
from benchmarks.measuring import FULL, QUICK, replace_section

SECTIONS = ("speed", "purejaxrl", "breakdown")


def main() -> None:
    """Measure the sections that are asked for, and write the page of all that is there."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        epilog="example: python -m benchmarks speed --quick",
    )
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, "page", "all"], default="all")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="minutes, to see it work; writes into benchmarks/quick/",
    )
    arguments = parser.parse_args()
    scale = QUICK if arguments.quick else FULL
    for section in SECTIONS if "all" in arguments.sections else arguments.sections:
        if section != "page":
            began = time.monotonic()
            rows = import_module(f"benchmarks.{section}").measure(scale)
            replace_section(scale.folder, section, rows)
            print(f"{section}: {time.monotonic() - began:.0f} s", flush=True)
    print(page.write(scale.folder))


if __name__ == "__main__":
    main()
