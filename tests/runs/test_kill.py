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
from types import SimpleNamespace

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


MOMENTS = {"training": begun, "checkpoint": writing_checkpoint, "results": writing_results}


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
    return False


@pytest.fixture(scope="module", params=[*product(ENVIRONMENTS, VARIANTS)], ids="-".join)
def undisturbed(request: pytest.FixtureRequest, tmp_path_factory) -> SimpleNamespace:
    """A training of each environment and variant that was let alone, its folder; its seconds from
    the first checkpoint on; and `start`, which begins another one like it in a folder.
    """
    folder, begin = tmp_path_factory.mktemp("undisturbed") / "run", partial(start, *request.param)
    process = begin(folder)
    while not begun(folder) and process.poll() is None:
        time.sleep(0.01)
    began = time.monotonic()
    finish(process)
    seconds = time.monotonic() - began
    return SimpleNamespace(folder=folder, seconds=seconds, start=begin)


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_training_ends_with_the_same_bits(undisturbed, moment, tmp_path) -> None:
    delay = random.uniform(0, 0.8 * undisturbed.seconds) if moment == "training" else 0.0
    for attempt in range(ATTEMPTS):  # a training may be faster than the undisturbed one
        folder = tmp_path / str(attempt)
        if kill_at(MOMENTS[moment], delay / 2**attempt, undisturbed.start(folder), folder):
            break
    else:
        pytest.fail("each training ended before it was hit")
    cut = begun(folder) and files.RECORD not in names(folder)  # has to be resumed
    finish(undisturbed.start(folder))
    assert files_in(folder) == sorted([*RESULTS, files.CHECKPOINT])  # to go on from
    for name in OUTCOME:
        assert (folder / name).read_bytes() == (undisturbed.folder / name).read_bytes(), name
    assert provenance_of(folder)["interruptions"] or not cut, "it started afresh"
