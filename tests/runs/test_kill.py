"""Trainings that are killed at bad moments end as if they had not: make kill-test.

Each environment and variant of the paper is trained undisturbed; then a training is killed
(SIGKILL) at a random moment, while it writes a checkpoint, and while it writes its results, and the
same command is given again. tests/workflow/test_workflow.py does it to a workflow.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import pytest
from shared import ENVIRONMENTS, OUTCOME, RESULTS, VARIANTS, provenance_of
from shared import files as files_in

from mace_rl.base import files

pytestmark = [pytest.mark.slow, pytest.mark.kill]

EPISODES = {"Acrobot-v1": 60, "CartPole-v1": 300, "HopperBulletEnv-v0": 250}
# Checkpoints as fast as they can be written: the moments to hit are then all through the training.
OFTEN = os.environ | {"MACE_RL_CHECKPOINT_SECONDS": "0.05"}
TRAIN = "import mace_rl.runs.run as r; r.CHECKPOINT_COST = 1.0; "
TRAIN += "from mace_rl.cli import main; main()"
ATTEMPTS = 3  # to hit a moment
LOOK = 0.0005  # seconds between looks for it: writing a file takes longer


def start(environment: str, variant: str, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", TRAIN, "train", "--env", environment, "--variant", variant]
    command += ["--seed", "0", "--episodes", str(EPISODES[environment]), "--out", str(folder)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=OFTEN)


def finish(process: subprocess.Popen[bytes]) -> None:
    _, error = process.communicate()
    assert process.returncode == 0, error.decode()


def names(folder: Path) -> set[str]:
    return set(os.listdir(folder)) if folder.exists() else set()


def begun(folder: Path) -> bool:
    return files.CHECKPOINT in names(folder)


def writing_checkpoint(folder: Path) -> bool:
    half = f".{files.CHECKPOINT}."
    return begun(folder) and any(name.startswith(half) for name in names(folder))


def writing_results(folder: Path) -> bool:
    found, half = names(folder), tuple(f".{name}." for name in RESULTS)
    some = 0 < len(found & {*RESULTS}) < len(RESULTS)
    return some or any(name.startswith(half) for name in found)


def training(folder: Path) -> bool:
    """From the end of its first episodes on, before which it may compile for many seconds."""
    return files.PROGRESS in names(folder)


MOMENTS = {"training": training, "checkpoint": writing_checkpoint, "results": writing_results}


def kill_at(
    moment: Callable[[Path], bool], delay: float, process: subprocess.Popen[bytes], folder: Path
) -> bool:
    """SIGKILL `process` `delay` seconds after `moment` came; False if it ended before."""
    while process.poll() is None:
        if moment(folder):
            time.sleep(delay)
            process.kill()
            process.communicate()
            return process.returncode == -signal.SIGKILL
        time.sleep(LOOK)
    return False


@pytest.mark.parametrize(("environment", "variant"), [*product(ENVIRONMENTS, VARIANTS)])
def test_a_killed_training_ends_with_the_same_bits(environment, variant, tmp_path) -> None:
    begin = partial(start, environment, variant)
    undisturbed = tmp_path / "undisturbed"
    process = begin(undisturbed)
    while not training(undisturbed) and process.poll() is None:
        time.sleep(0.01)
    began = time.monotonic()
    finish(process)
    seconds = time.monotonic() - began
    for moment, has_come in MOMENTS.items():
        delay = random.uniform(0, 0.8 * seconds) if moment == "training" else 0.0
        for attempt in range(ATTEMPTS):  # a training may be faster than the undisturbed one
            folder = tmp_path / f"{moment}-{attempt}"
            if kill_at(has_come, delay / 2**attempt, begin(folder), folder):
                break
        else:
            pytest.fail(f"{moment}: each training ended before it was hit")
        cut = begun(folder) and files.RECORD not in names(folder)  # has to be resumed
        finish(begin(folder))
        assert files_in(folder) == sorted([*RESULTS, files.CHECKPOINT])  # to go on from
        for name in OUTCOME:
            made, expected = (its / name for its in (folder, undisturbed))
            assert made.read_bytes() == expected.read_bytes(), made
        assert provenance_of(folder)["interruptions"] or not cut, f"{moment}: it started afresh"
