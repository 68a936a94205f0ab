"""Did a change make something slower? CPU time, in pairs with another commit.

    make bench BENCH=quick            a training's step, of the working tree against the last
                                      commit, or, if nothing is changed, that against the one before
    python -m benchmarks.guard REV    against another one, with as many pairs as --pairs says
    python -m benchmarks.guard --tables    all that `make tables` does, some minutes a pair

Each reading is a process of its own, and the two of a pair follow each other, now one first, now
the other: what slows the machine down for a while hits both. Beside other work that can still be a
tenth.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median

from benchmarks.measuring import ACROBOT, CARTPOLE, FIRST_SEED, ROOT, THREADS
from benchmarks.speed import WARM_UP_STEPS

STEPS = 61_440  # of a reading, after a warm-up
PAIRS = 5
READ = """
import sys
import tools  # which pins what NumPy and PyTorch compute with, in older commits too
import torch
from benchmarks.speed import read_clock, start
torch.set_num_threads(1)
who, env, seed, steps, warm_up = *sys.argv[1:3], *map(int, sys.argv[3:])
read_clock(start(who, env, seed + 10**6, warm_up), warm_up)
found = read_clock(start(who, env, seed, steps), steps)
print(1e6 * found["cpu_seconds"] / found["steps"])
"""


def microseconds(who: str, env: str, steps: int, tree: Path, seed: int) -> float:
    """CPU time a step of a training by the code in `tree`, in a process of its own."""
    numbers = map(str, (seed, steps, WARM_UP_STEPS))
    command = [sys.executable, "-c", READ, who, env, *numbers]
    run = run_in(tree, command, **dict.fromkeys(THREADS, "1"))
    if run.returncode:
        sys.exit(f"guard: {tree}: {' '.join(command[-4:])} ended with {run.stderr.strip()[-300:]}")
    return float(run.stdout.split()[-1])


def tables(tree: Path, seed: int) -> float:
    """CPU time of all tables and figures, by the code in `tree`, in seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run = run_in(tree, [sys.executable, "-m", "tools.tables"])
    if "tables and figures of" not in run.stdout:  # these may differ from what is kept
        sys.exit(f"guard: {tree}: tools.tables ended with {run.stderr.strip()[-300:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run_in(tree: Path, command: list[str], **more: str) -> subprocess.CompletedProcess[str]:
    """A finished process that imports the code in `tree`."""
    environment = os.environ | {"PYTHONPATH": f"{tree / 'src'}:{tree}"} | more
    return subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)


def compare(
    before: Path, now: Path, read: Callable[[Path, int], float], pairs: int
) -> list[tuple[float, float]]:
    """Of each pair what `read` says of both trees; it gets a seed.

    One of each comes before and is thrown away: it compiles what the others load.
    """
    for tree in (before, now):
        read(tree, FIRST_SEED + pairs)
    found = []
    for pair in range(pairs):
        order = (before, now) if pair % 2 == 0 else (now, before)
        both = {tree: read(tree, FIRST_SEED + pair) for tree in order}
        found.append((both[before], both[now]))
    return found


def row(name: str, found: list[tuple[float, float]]) -> str:
    """A line of the table; above 1 it is slower now."""
    ratios = sorted(after / earlier for earlier, after in found)
    earlier, after = (median(pair[side] for pair in found) for side in (0, 1))
    spread = f"{ratios[0]:.2f} to {ratios[-1]:.2f}"
    return f"| {name} | {earlier:.1f} | {after:.1f} | {median(ratios):.2f} ({spread}) |"


STEPS_OF = {
    f"{env} `{who}`": partial(microseconds, who, env, STEPS)
    for env in (CARTPOLE, ACROBOT)
    for who in ("ppo", "mace_full")
}


def git(*arguments: str) -> bytes:
    """What git says in this repository."""
    run = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True)
    if run.returncode:
        sys.exit(f"guard: {' '.join(run.stderr.decode().split())}")
    return run.stdout


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.guard",
        description=__doc__.splitlines()[0],
        epilog="example: python -m benchmarks.guard HEAD~3 --pairs 10",
    )
    which = "a commit (default: the last, or the one before)"
    parser.add_argument("revision", nargs="?", help=which)
    parser.add_argument("--pairs", type=int, default=PAIRS, help="default: %(default)s")
    parser.add_argument("--tables", action="store_true", help="of `make tables`")
    arguments = parser.parse_args()
    if arguments.pairs < 1:
        parser.error(f"--pairs is {arguments.pairs}, but should be at least 1")
    paths = "src", "tools", "config", "config.yaml"
    changed = git("status", "--porcelain", "--untracked-files=no", "--", *paths).strip()
    revision = arguments.revision or ("HEAD" if changed else "HEAD^")
    with tempfile.TemporaryDirectory() as folder:
        archive = git("archive", revision)
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        name = git("log", "-1", "--format=%h %s", revision).decode().strip()
        what = "s of CPU time" if arguments.tables else "µs of CPU time a step"
        print(f"{what}, before: {name}\n", flush=True)
        print("| | before | now | now ÷ before, median of pairs (least to most) |")
        print("|---|--:|--:|--:|")
        timed = {"`make tables`": tables} if arguments.tables else STEPS_OF
        for name, read in timed.items():
            print(row(name, compare(Path(folder), ROOT, read, arguments.pairs)), flush=True)


if __name__ == "__main__":
    main()
