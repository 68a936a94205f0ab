"""A run interrupted, stopped or deleted: resumed, it ends as one never disturbed, to the bit."""

import fcntl
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from shared import (
    ENVIRONMENTS,
    LAYER_NORM,
    OUTCOME,
    RESULTS,
    UNFINISHED,
    VARIANTS,
    Bonanza,
    Killed,
    files,
    finish,
)

from mace_rl.files import LOCK
from mace_rl.finite import NonFiniteError
from mace_rl.runs import provenance, run
from mace_rl.train import Trainer

SEVERAL = {"rollout_steps": 80, "minibatch_size": 16, "normalise_observations": True}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("environment", "changes"),
    [
        ("CartPole-v1", {}),
        ("Acrobot-v1", {}),
        ("HopperBulletEnv-v0", {}),
        ("CartPole-v1", {"ppo": SEVERAL}),
        pytest.param("CartPole-v1", {"ppo": SEVERAL, "engine": "torch"}, marks=pytest.mark.slow),
        pytest.param(
            "CartPole-v1", {"ppo": SEVERAL | {"network": LAYER_NORM}}, marks=pytest.mark.slow
        ),
    ],
    ids=[*ENVIRONMENTS, "several", "torch", "LayerNorm"],
)
def test_resumed_run_equals_uninterrupted_run(
    run_config, tmp_path, kill, checkpoint_every, completes, environment, changes, variant
):
    """Killed twice, between checkpoints, so that lost rounds are played again."""
    config = run_config(environment, variant, 4, episodes=30 if changes else 8, **changes)
    checkpoint_every(2)
    for update in (4, 7):
        kill(update, config, tmp_path / "killed")
        assert files(tmp_path / "killed") == UNFINISHED
    interruptions = completes(config, tmp_path / "killed")["interruptions"]
    # Resumed where the last checkpoint before the kill was.
    updates = finish(config).diagnostics
    found = [item["after_episode"] for item in interruptions]
    assert found == [updates[1].episode, updates[4].episode]
    assert all(item["machine"]["cpu"] for item in interruptions)


CHILD = """
import sys, time
from pathlib import Path
from mace_rl.runs import run
from mace_rl.config.run import RunConfig
from mace_rl.train import Trainer

run.CHECKPOINT_COST = float("inf")
improve = Trainer.improve

def improve_until_12(self, rollout):
    update = improve(self, rollout)
    if len(self.records) == 12:
        print("ready", flush=True)
        time.sleep(600)
    return update

Trainer.improve = improve_until_12
run.run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.mark.slow
def test_a_process_killed_by_sigkill_is_resumed_by_another(
    run_config, tmp_path, monkeypatch, caplog, completes
):
    """And while it lives, a second process in its folder is refused."""
    monkeypatch.setattr(run, "LOCK_SECONDS", 0.3)
    config = run_config("HopperBulletEnv-v0", "mace_full", 5, episodes=20)
    directory = tmp_path / "Läufe mit Leerzeichen"
    command = [sys.executable, "-c", CHILD, config.model_dump_json(), str(directory)]
    often = {**os.environ, "MACE_RL_CHECKPOINT_SECONDS": "0"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=often) as process:
        try:
            assert any(line == "ready\n" for line in process.stdout)
            before = {name: (directory / name).read_bytes() for name in files(directory)}
            assert list(before) == UNFINISHED
            with pytest.raises(run.RunError, match="another process is training in this folder"):
                run.run(config, directory)
            assert before == {name: (directory / name).read_bytes() for name in files(directory)}
        finally:
            process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    with caplog.at_level(logging.INFO):
        assert len(completes(config, directory)["interruptions"]) == 1
    assert "resuming after episode 11" in caplog.text


def test_a_dying_predecessor_is_waited_for(tmp_path):
    """It holds the folder's lock for a moment after whoever started it is gone."""
    holder = os.open(tmp_path / LOCK, os.O_RDWR | os.O_CREAT)
    fcntl.flock(holder, fcntl.LOCK_EX)
    timer = threading.Timer(0.5, os.close, [holder])
    started = time.monotonic()
    timer.start()
    with run.exclusive(tmp_path):
        assert time.monotonic() - started >= 0.4
    timer.join()


def test_killed_before_the_results_are_complete(
    run_config, tmp_path, monkeypatch, checkpoint_every, completes
):
    """All episodes played, some results written: what is missing is made from the checkpoint."""
    config = run_config("CartPole-v1", "mace_full", 0, episodes=6)
    checkpoint_every(1)

    def die(*_) -> None:
        raise Killed

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(provenance, "git_state", die)
        run.run(config, tmp_path / "killed")
    assert files(tmp_path / "killed") == sorted([*UNFINISHED, *OUTCOME])
    (tmp_path / "killed" / "agent.pt").unlink()  # as Snakemake does with outputs
    completes(config, tmp_path / "killed")


def test_killed_while_writing_a_checkpoint(
    run_config, tmp_path, monkeypatch, checkpoint_every, completes
):
    """The one before is whole, and is what the run continues from."""
    config = run_config("CartPole-v1", "mace_fixed", 0, episodes=9)
    checkpoint_every(1)
    replaced, replace = itertools.count(1), os.replace

    def replace_or_die(source, target) -> None:
        if Path(target).name == "checkpoint.pt" and next(replaced) == 5:
            raise Killed
        replace(source, target)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(os, "replace", replace_or_die)
        run.run(config, tmp_path / "killed")
    assert files(tmp_path / "killed") == UNFINISHED
    (interruption,) = completes(config, tmp_path / "killed")["interruptions"]
    assert interruption["after_episode"] == 4


def test_what_a_killed_process_had_half_written_goes(run_config, tmp_path):
    """SIGKILL leaves no time to clean up; whoever resumes does."""
    (tmp_path / ".checkpoint.pt.12345.tmp").write_bytes(b"half a check")
    run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path)
    assert files(tmp_path) == RESULTS


def test_nan_stops_the_run_and_keeps_the_last_checkpoint(
    run_config, register, tmp_path, checkpoint_every, completes, caplog
):
    name = register("Bonanza-v0", Bonanza, 6, where="reward", value=np.nan)
    config = run_config(name, "mace_full", 3, episodes=9)
    checkpoint_every(1)
    place = "^Bonanza-v0 mace_full seed 3, episode 4: the reward is nan after step 3$"
    with pytest.raises(NonFiniteError, match=place):
        run.run(config, tmp_path / "run")
    assert files(tmp_path / "run") == UNFINISHED
    register("Bonanza-v0", Bonanza, 6, where="reward", value=0.0)  # whatever it was is repaired
    (interruption,) = completes(config, tmp_path / "run")["interruptions"]
    assert interruption["after_episode"] == 3


@pytest.mark.parametrize("left", [[], RESULTS[:2], RESULTS])
def test_deleted_results_come_back_from_the_last_checkpoint(
    run_config, tmp_path, monkeypatch, left
):
    config, directory = run_config("CartPole-v1", "mace_full", 0, episodes=4), tmp_path / "run"
    run.run(config, directory, keep_checkpoint=True)
    assert files(directory) == sorted([*RESULTS, "checkpoint.pt"])
    contents = {name: (directory / name).read_bytes() for name in OUTCOME}
    for name in RESULTS:
        (directory / name).unlink()
    for name in left:  # of a job that was killed while it wrote them
        (directory / name).write_text("stale")
    monkeypatch.delattr(Trainer, "improve")
    run.run(config, directory, keep_checkpoint=True)
    assert {name: (directory / name).read_bytes() for name in OUTCOME} == contents
    [interruption] = json.loads((directory / "run.json").read_text())["interruptions"]
    assert interruption["after_episode"] == 4
