"""Did a change make training slower? CPU time a step, in pairs with another commit.

    make bench BENCH=quick            the working tree against the last commit, or, if nothing is
                                      changed, the last commit against the one before
    python -m benchmarks.guard REV    against another one, with as many pairs as --pairs says
    python -m benchmarks.guard --count    instructions a step, by valgrind: a quarter of an hour

Each reading is a process of its own, and the two of a pair follow each other, now one first, now
the other: what slows the machine down for a while hits both. Beside other work that can still be a
tenth. Instructions do not feel it.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.measuring import ACROBOT, CARTPOLE, FIRST_SEED, ROOT, THREADS
from benchmarks.speed import WARM_UP_STEPS

TRAININGS = [(env, who) for env in (CARTPOLE, ACROBOT) for who in ("ppo", "mace_full")]
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

# The same training without a clock; it prints its steps.
COUNTED = """
import sys
import tools
import torch
from benchmarks.speed import start
torch.set_num_threads(1)
who, env, seed, steps = *sys.argv[1:3], *map(int, sys.argv[3:])
print(next(done for done in start(who, env, seed, steps) if done >= steps))
"""
FEW, MANY = 4500, 18_000  # steps: the difference leaves out imports and the first updates
VALGRIND = ["valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null"]
# It knows no AVX-512.
AVX2 = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}


def microseconds(tree: Path, who: str, env: str, seed: int, steps: int) -> float:
    """CPU time a step of a training by the code in `tree`, in a process of its own."""
    numbers = map(str, (seed, steps, WARM_UP_STEPS))
    command = [sys.executable, "-c", READ, who, env, *numbers]
    return float(run_in(tree, command).stdout.split()[-1])


def instructions(tree: Path, who: str, env: str, few: int = FEW, many: int = MANY) -> float:
    """Instructions a step of a training by the code in `tree`, between two numbers of steps."""

    def command(steps: int) -> list[str]:
        return [sys.executable, "-c", COUNTED, who, env, str(FIRST_SEED), str(steps)]

    run_in(tree, command(many), **AVX2)  # compiles what the others load
    found = []
    for steps in (few, many):
        run = run_in(tree, [*VALGRIND, *command(steps)], **AVX2)
        count = re.search(r"I\s+refs:\s+([\d,]+)", run.stderr)
        if count is None:
            sys.exit(f"guard: valgrind ended with {run.stderr.strip()[-300:]}")
        found.append((int(run.stdout.split()[-1]), int(count[1].replace(",", ""))))
    (first, before), (last, after) = found
    return (after - before) / (last - first)


def run_in(tree: Path, command: list[str], **more: str) -> subprocess.CompletedProcess[str]:
    """A finished process that imports the code in `tree`; ends everything if it failed."""
    changes = dict.fromkeys(THREADS, "1") | {"PYTHONPATH": f"{tree / 'src'}:{tree}"} | more
    environment = os.environ | changes
    run = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    if run.returncode:
        sys.exit(f"guard: {tree}: {' '.join(command[-4:])} ended with {run.stderr.strip()[-300:]}")
    return run


def compare(
    before: Path, now: Path, env: str, who: str, pairs: int, steps: int
) -> list[tuple[float, float]]:
    """Of each pair the readings of both trees, in microseconds a step.

    One of each comes before and is thrown away: it compiles what the others load.
    """
    for tree in (before, now):
        microseconds(tree, who, env, FIRST_SEED + pairs, steps)
    found = []
    for pair in range(pairs):
        order = (before, now) if pair % 2 == 0 else (now, before)
        one = {tree: microseconds(tree, who, env, FIRST_SEED + pair, steps) for tree in order}
        found.append((one[before], one[now]))
    return found


def row(env: str, who: str, found: list[tuple[float, float]]) -> str:
    """A line of the table; above 1 it is slower now."""
    ratios = sorted(after / earlier for earlier, after in found)
    earlier, after = (median(pair[side] for pair in found) for side in (0, 1))
    spread = f"{ratios[0]:.2f} to {ratios[-1]:.2f}"
    return f"| {env} `{who}` | {earlier:.1f} | {after:.1f} | {median(ratios):.2f} ({spread}) |"


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
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--pairs", type=int, default=PAIRS, help="default: %(default)s")
    how.add_argument("--count", action="store_true", help="instructions, by valgrind")
    arguments = parser.parse_args()
    if arguments.count and not shutil.which("valgrind"):
        parser.error("--count needs valgrind (Debian, Ubuntu: apt install valgrind)")
    if arguments.pairs < 1:
        parser.error(f"--pairs is {arguments.pairs}, but should be at least 1")
    changed = git("status", "--porcelain", "--untracked-files=no", "--", "src").strip()
    revision = arguments.revision or ("HEAD" if changed else "HEAD^")
    with tempfile.TemporaryDirectory() as folder:
        archive = git("archive", revision)
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        name = git("log", "-1", "--format=%h %s", revision).decode().strip()
        what = "instructions" if arguments.count else "µs of CPU time"
        print(f"{what} a step, before: {name}\n", flush=True)
        which = "now ÷ before" + ("" if arguments.count else ", median of pairs (least to most)")
        print(f"| | before | now | {which} |")
        print("|---|--:|--:|--:|")
        for env, who in TRAININGS:
            if arguments.count:
                earlier, after = (instructions(tree, who, env) for tree in (Path(folder), ROOT))
                cells = f"{earlier:,.0f} | {after:,.0f} | {after / earlier:.3f}"
                print(f"| {env} `{who}` | {cells} |", flush=True)
            else:
                found = compare(Path(folder), ROOT, env, who, arguments.pairs, STEPS)
                print(row(env, who, found), flush=True)


if __name__ == "__main__":
    main()
