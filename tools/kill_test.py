"""Kill trainings and whole workflows at bad moments, start them again, and compare to the bit.

    python -m tools.kill_test [--repeats N] [--seed S]        (make kill-test)

Every environment and variant of the paper is trained once undisturbed. Then, for each, a training
is killed (SIGKILL) at a random moment, while it writes a checkpoint, and while it writes its
results, and the same command is given again. At last a small workflow gets SIGINT, SIGTERM and
SIGKILL. What had a checkpoint has to be resumed, and what is there in the end has to equal the
undisturbed run byte for byte, with nothing left.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from mace_rl import files
from mace_rl.results.paper import ENVIRONMENTS, VARIANTS
from tools.slurm_test import contents

ROOT = Path(__file__).resolve().parent.parent
EPISODES = {"Acrobot-v1": 60, "CartPole-v1": 300, "HopperBulletEnv-v0": 250}
# Checkpoints as fast as they can be written: the moments to hit are then all through the training.
TRAIN = (
    "import mace_rl.runs.run as r; r.CHECKPOINT_COST = 1.0; from mace_rl.cli import main; main()"
)
ATTEMPTS = 3  # to hit a moment
OFTEN = {"MACE_RL_CHECKPOINT_SECONDS": "0.05"}
RESULTS = {*files.RESULTS, files.RECORD}
CHECKPOINTS = f"runs/*/*/*/{files.CHECKPOINT}"  # of a workflow


def start(environment: str, variant: str, folder: Path) -> subprocess.Popen[bytes]:
    """Begin a training in `folder`, in a process of its own."""
    command = [sys.executable, "-c", TRAIN, "train", "--env", environment, "--variant", variant]
    command += ["--seed", "0", "--episodes", str(EPISODES[environment]), "--out", str(folder)]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=os.environ | OFTEN
    )


def finish(process: subprocess.Popen[bytes]) -> None:
    """Wait for a training; exit with what it said if it failed."""
    _, error = process.communicate()
    if process.returncode != 0:
        said = error.decode().strip().splitlines() or [f"it ended with {process.returncode}"]
        sys.exit(f"kill test: a training failed: {said[-1]}")


def names(folder: Path) -> set[str]:
    """What is in `folder`, if it exists yet."""
    return set(os.listdir(folder)) if folder.exists() else set()


def begun(folder: Path) -> bool:
    """Whether the training in `folder` has saved its first checkpoint."""
    return files.CHECKPOINT in names(folder)


def writing_checkpoint(folder: Path) -> bool:
    """Whether a checkpoint is half written at this moment."""
    found = names(folder)
    half_written = f".{files.CHECKPOINT}."
    return files.CHECKPOINT in found and any(name.startswith(half_written) for name in found)


def writing_results(folder: Path) -> bool:
    """Whether some but not all results are there at this moment."""
    found = names(folder)
    beginnings = tuple(f".{name}." for name in RESULTS)
    half_written = any(name.startswith(beginnings) for name in found)
    return half_written or 0 < len(found & RESULTS) < len(RESULTS)


def kill_when(
    process: subprocess.Popen[bytes], folder: Path, moment: Callable[[Path], bool], delay: float
) -> bool:
    """SIGKILL `process` `delay` seconds after `moment` came; False if it ended before."""
    while process.poll() is None:
        if moment(folder):
            time.sleep(delay)
            process.kill()
            process.communicate()
            return process.returncode == -signal.SIGKILL
    return False


def same(folder: Path, undisturbed: Path) -> bool:
    """Whether `folder` ends with the same records and agent as `undisturbed`, and no leftovers."""
    return names(folder) == RESULTS and all(
        (folder / name).read_bytes() == (undisturbed / name).read_bytes() for name in files.RESULTS
    )


def cut_off(folder: Path) -> bool:
    """Whether what is in `folder` has to be resumed: there is a checkpoint, and no end."""
    return files.CHECKPOINT in names(folder) and files.RECORD not in names(folder)


def resumed(folder: Path) -> bool:
    """Whether the run in `folder` tells of an interruption."""
    record = folder / files.RECORD
    return record.exists() and bool(json.loads(record.read_bytes())["interruptions"])


def outcome(hit: bool, equal: bool, as_it_should: bool) -> str:
    """In a word: equal, or what is wrong, at first whether anything was killed at all."""
    if not hit:
        return "NOT HIT"
    if not equal:
        return "DIFFERENT"
    return "equal" if as_it_should else "NOT RESUMED"


def kill_trainings(scratch: Path, repeats: int, generator: random.Random) -> list[bool]:
    """Kill every environment's and variant's training at every kind of moment."""
    outcomes = []
    for environment, variant in product(ENVIRONMENTS, VARIANTS):
        undisturbed = scratch / f"{environment}-{variant}"
        began = time.monotonic()
        process = start(environment, variant, undisturbed)
        while not begun(undisturbed) and process.poll() is None:
            time.sleep(0.01)
        training = time.monotonic()
        finish(process)
        length = time.monotonic() - training
        moments: dict[str, tuple[Callable[[Path], bool], Callable[[], float]]] = {
            "training": (begun, partial(generator.uniform, 0, 0.8 * length)),
            "writing a checkpoint": (writing_checkpoint, lambda: 0.0),
            "writing the results": (writing_results, lambda: 0.0),
        }
        for repeat, (name, (moment, delay)) in product(range(repeats), moments.items()):
            wait, killed = delay(), False
            for attempt in range(ATTEMPTS):  # a training may be faster than the undisturbed one
                folder = scratch / f"{environment}-{variant}-{name}-{repeat}-{attempt}"
                process = start(environment, variant, folder)
                if killed := kill_when(process, folder, moment, wait / 2**attempt):
                    break
            cut = cut_off(folder)
            finish(start(environment, variant, folder))
            result = outcome(killed, same(folder, undisturbed), resumed(folder) or not cut)
            outcomes.append(result == "equal")
            print(f"{environment} {variant}, killed while {name}: {result}", flush=True)
        print(f"  ({time.monotonic() - began:.0f} s)", flush=True)
    return outcomes


def kill_workflows(scratch: Path) -> list[bool]:
    """Interrupt a small workflow by three signals; each time the same command has to finish it."""
    outcomes = []
    settings = scratch / "small.yaml"
    found: dict[str, dict[str, bytes]] = {}
    for name, sent in [
        ("none", None),
        *((s.name, s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)),
    ]:
        results = scratch / f"workflow-{name}"
        settings.write_text(
            f"results: {results}\nenvironments: [CartPole-v1, Acrobot-v1]\nseeds: [0]\n"
            "training: {episodes: 150}\n",
            encoding="utf-8",
        )
        command = [sys.executable, "-m", "snakemake", "-j2", "all", "--configfile", str(settings)]
        quiet: dict[str, Any] = {
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
            "cwd": ROOT,
            "env": os.environ | OFTEN,
        }
        hit = False
        if sent:
            process = subprocess.Popen(command, start_new_session=True, **quiet)
            while process.poll() is None and not list(results.glob(CHECKPOINTS)):
                time.sleep(0.05)
            hit = process.poll() is None
            if hit and sent == signal.SIGINT:  # Ctrl-C goes to the whole foreground group
                os.killpg(process.pid, sent)
            elif hit:
                process.send_signal(sent)
            process.wait()
            time.sleep(3)  # jobs of a killed Snakemake notice and end
        cut = [path.parent for path in results.glob(CHECKPOINTS) if cut_off(path.parent)]
        again = subprocess.run(command, **quiet | {"stderr": subprocess.PIPE}, check=False)
        if not sent and again.returncode:
            end = again.stderr.decode(errors="replace").strip().splitlines()[-3:]
            sys.exit("kill test: the undisturbed workflow failed: " + " ".join(end))
        found[name] = contents(results)
        if sent:
            equal = again.returncode == 0 and found[name] == found["none"]
            # At SIGTERM Snakemake lets jobs that run come to their end: nothing need be cut off.
            hit = hit and (bool(cut) or sent == signal.SIGTERM)
            result = outcome(hit, equal, all(map(resumed, cut)))
            outcomes.append(result == "equal")
            print(f"workflow, {name}: {result}", flush=True)
    return outcomes


def main() -> None:
    """Run everything; exit with 1 unless every outcome is equal."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.kill_test --repeats 3"
    )
    parser.add_argument("--repeats", type=int, default=1, help="kills of each kind (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments (default: 0)")
    arguments = parser.parse_args()
    if arguments.repeats < 1:
        sys.exit(f"kill test: --repeats is {arguments.repeats}, but should be at least 1")
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        trainings = kill_trainings(scratch, arguments.repeats, random.Random(arguments.seed))
        workflows = kill_workflows(scratch)
    print(
        f"{sum(trainings)} of {len(trainings)} killed trainings and {sum(workflows)} of "
        f"{len(workflows)} interrupted workflows ended with equal bits"
    )
    sys.exit(not all(trainings + workflows))


if __name__ == "__main__":
    main()
