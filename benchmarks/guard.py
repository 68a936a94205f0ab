"""Did a change make training slower? CPU time a step, in pairs with another commit.

    make bench BENCH=quick            the working tree against the last commit, or, if nothing is
                                      changed, the last commit against the one before
    python -m benchmarks.guard REV    against another one, with as many pairs as --pairs says

Each reading is a process of its own, and the two of a pair follow each other, now one first, now
the other: what slows the machine down for a while hits both.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.measuring import ACROBOT, CARTPOLE, FIRST_SEED, ROOT, THREADS

TRAININGS = [(env, who) for env in (CARTPOLE, ACROBOT) for who in ("ppo", "mace_full")]
STEPS = 61_440  # of a reading, after a warm-up
PAIRS = 5
READ = """
import sys
import tools  # which pins what NumPy and PyTorch compute with, in older commits too
import torch
from benchmarks.speed import read_clock, start, warm_up
torch.set_num_threads(1)
who, env, seed, steps = *sys.argv[1:3], *map(int, sys.argv[3:])
warm_up(who, env, seed)
found = read_clock(start(who, env, seed, steps), steps)
print(1e6 * found["cpu_seconds"] / found["steps"])
"""


def microseconds(tree: Path, who: str, env: str, seed: int, steps: int) -> float:
    """CPU time a step of a training by the code in `tree`, in a process of its own."""
    changes = dict.fromkeys(THREADS, "1") | {"PYTHONPATH": f"{tree / 'src'}:{tree}"}
    command = [sys.executable, "-c", READ, who, env, str(seed), str(steps)]
    environment = os.environ | changes
    run = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    if run.returncode:
        sys.exit(f"guard: {tree}: {who} in {env} ended with {run.stderr.strip()[-300:]}")
    return float(run.stdout.split()[-1])


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
    parser.add_argument("--pairs", type=int, default=PAIRS, help="default: %(default)s")
    arguments = parser.parse_args()
    if arguments.pairs < 1:
        parser.error(f"--pairs is {arguments.pairs}, but should be at least 1")
    changed = git("status", "--porcelain", "--untracked-files=no", "--", "src").strip()
    revision = arguments.revision or ("HEAD" if changed else "HEAD^")
    with tempfile.TemporaryDirectory() as folder:
        archive = git("archive", revision)
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        name = git("log", "-1", "--format=%h %s", revision).decode().strip()
        print(f"µs of CPU time a step, before: {name}\n", flush=True)
        print("| | before | now | now ÷ before, median of pairs (least to most) |")
        print("|---|--:|--:|--:|")
        for env, who in TRAININGS:
            found = compare(Path(folder), ROOT, env, who, arguments.pairs, STEPS)
            print(row(env, who, found), flush=True)


if __name__ == "__main__":
    main()
