"""One run on disk: interrupted, it ends as one never disturbed."""

import fcntl
import itertools
import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from shared import (
    OUTCOME,
    RESULTS,
    RULE,
    UNFINISHED,
    Killed,
    content_of,
    files,
    finish,
    pretrained,
    provenance_of,
    refused,
)

from mace_rl.base import code_digest
from mace_rl.base.files import LOCK
from mace_rl.config.section import ConfigError
from mace_rl.runs import checkpoint, provenance, run
from mace_rl.training.trainer import Trainer


def test_an_interrupted_run_says_how_far_it_is_and_its_seconds_count(interrupted):
    progress = json.loads((interrupted.directory / "progress.json").read_text())
    assert (progress["episode"], progress["episodes"]) == (1, 6)
    assert progress["env_steps"] == progress["recent_return"]  # CartPole pays 1 a step
    path = interrupted.directory / "checkpoint.pt"
    state = checkpoint.read(path)["state"] | {"seconds": 1000.0, "checkpoint_seconds": 100.0}
    checkpoint.save(path, provenance.identity(interrupted.config), state)
    run.run(interrupted.config, interrupted.directory)
    found = provenance_of(interrupted.directory)
    assert len(found["interruptions"]) == 1
    assert 1000 < found["seconds"] < 1600 and 100 <= found["checkpoint_seconds"] < 200


SEVERAL = {"rollout_steps": 80, "minibatch_size": 16, "normalise_observations": True}


@pytest.mark.parametrize(
    ("environment", "variant", "changes"),
    [
        ("CartPole-v1", "ppo", {}),
        ("CartPole-v1", "mace_full", {"ppo": SEVERAL, "engine": "torch"}),
        ("HopperBulletEnv-v0", "mace_full", {}),
    ],
)
def test_resumed_run_equals_uninterrupted_run(
    run_config, tmp_path, kill, checkpoint_every, completes, environment, changes, variant
):
    """Killed twice, between checkpoints, so that lost rounds are played again."""
    changes = {"episodes": 30 if changes else 8, "novelty": {"refresh_every": 40}} | changes
    config = run_config(environment, variant, 4, **changes)
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
import json, sys, time
from pathlib import Path
from threadpoolctl import threadpool_info
from mace_rl.runs import run
from mace_rl.config.run import RunConfig

def observe(progress):
    if progress["episode"] < 5:
        return
    threads = {library["filepath"]: library["num_threads"] for library in threadpool_info()}
    own = [m.__file__ for name, m in sys.modules.items() if name.split(".")[0] == "mace_rl"]
    print(json.dumps([threads, own, progress["episode"]]), flush=True)
    time.sleep(600)

run.CHECKPOINT_COST, run.PROGRESS_SECONDS = float("inf"), 0.0
run.run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]), observe)
"""


@pytest.mark.slow
def test_a_process_of_its_own_is_killed_and_resumed_by_another(
    run_config, tmp_path, monkeypatch, caplog, completes
):
    """While it lives, a second process in its folder is refused.

    It has one thread in every library. All modules that it imports count as its code.
    """
    monkeypatch.setattr(run, "LOCK_SECONDS", 0.3)
    config = run_config("HopperBulletEnv-v0", "mace_full", 5, episodes=20)
    directory = tmp_path / "Läufe mit Leerzeichen"
    command = [sys.executable, "-c", CHILD, config.model_dump_json(), str(directory)]
    environment = {**os.environ, "MACE_RL_CHECKPOINT_SECONDS": "0"}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    del environment["OMP_NUM_THREADS"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            threads, imported, episode = json.loads(process.stdout.readline())
            before = content_of(directory)
            with pytest.raises(run.RunError, match="another process is training in this folder"):
                run.run(config, directory)
            assert before == content_of(directory)
        finally:
            process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert {"numpy", "scipy"} <= {Path(library).parts[-2].partition(".")[0] for library in threads}
    assert set(threads.values()) == {1}
    assert {*map(Path, imported)} <= {*code_digest.files("training")}
    assert {Path(name).name for name in imported} >= {"trainer.py", "ppo.py", "run.py"}
    with caplog.at_level(logging.INFO):
        assert len(completes(config, directory)["interruptions"]) == 1
    assert 0 < episode < 20 and "resuming after episode" in caplog.text


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


@pytest.mark.parametrize(
    ("file", "time", "left", "after"),
    [("run.json", 1, [*UNFINISHED, *OUTCOME], 6), ("checkpoint.pt", 5, UNFINISHED, 4)],
)
def test_killed_while_writing(
    run_config, tmp_path, monkeypatch, checkpoint_every, completes, file, time, left, after
):
    """What is missing is made from the checkpoint; one half written leaves the one before."""
    config, directory = run_config(variant="mace_full", episodes=6), tmp_path / "killed"
    times, replace = itertools.count(1), os.replace
    checkpoint_every(1)

    def replace_or_die(source, target) -> None:
        if Path(target).name == file and next(times) == time:
            raise Killed
        replace(source, target)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(os, "replace", replace_or_die)
        run.run(config, directory)
    assert files(directory) == sorted(left)
    (directory / "agent.pt").unlink(missing_ok=True)  # as Snakemake does with outputs
    (directory / ".checkpoint.pt.12345.tmp").write_bytes(b"half a check")  # goes
    (interruption,) = completes(config, directory)["interruptions"]
    assert interruption["after_episode"] == after


def test_deleted_results_come_back_from_the_last_checkpoint(run_config, tmp_path, monkeypatch):
    config = run_config("CartPole-v1", "mace_full", 0, episodes=4)
    run.run(config, tmp_path, keep_checkpoint=True)
    assert files(tmp_path) == sorted([*RESULTS, "checkpoint.pt"])
    before = [(tmp_path / name).read_bytes() for name in OUTCOME]
    for name in RESULTS:
        (tmp_path / name).unlink()
    (tmp_path / "agent.pt").write_text("stale")  # of a job that was killed while it wrote
    monkeypatch.delattr(Trainer, "ppo_update")
    run.run(config, tmp_path, keep_checkpoint=True)
    assert [(tmp_path / name).read_bytes() for name in OUTCOME] == before
    (interruption,) = provenance_of(tmp_path)["interruptions"]
    assert interruption["after_episode"] == 4


@pytest.mark.parametrize(("steps", "before"), [(1, 12), (200, 12), (200, 1)])
def test_a_finished_run_goes_on_as_if_it_had_had_more_episodes(
    run_config, tmp_path, monkeypatch, steps, before
):
    """Also if its last rollout was cut short; killed while it goes on, what was there is whole."""

    def run_to(episodes: int, directory: Path) -> list[bytes]:
        settings = {"episodes": episodes, "ppo": {"rollout_steps": steps}}
        run.run(run_config("CartPole-v1", "mace_full", 0, **settings), directory, None, True)
        return [(directory / name).read_bytes() for name in RESULTS]

    monkeypatch.setenv("MACE_RL_CHECKPOINT_SECONDS", "0")
    expected, folder = run_to(30, tmp_path / "whole"), tmp_path / "grown"
    first, update = run_to(before, folder), Trainer.ppo_update

    def update_or_die(trainer, rollout):
        if len(trainer.records) > 25:
            raise Killed
        return update(trainer, rollout)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(Trainer, "ppo_update", update_or_die)
        run_to(30, folder)
    assert [(folder / name).read_bytes() for name in RESULTS] == first
    assert run_to(30, folder)[:-1] == expected[:-1]
    went_on, resumed = provenance_of(folder)["interruptions"]
    whole = before if steps == 1 else 0 if before == 1 else went_on["after_episode"]
    assert went_on["after_episode"] == whole < resumed["after_episode"] <= 25
    assert (steps, before) != (200, 12) or 0 < whole < before


def test_what_cannot_go_on_is_refused_with_the_reason(run_config, tmp_path):
    def run_to(episodes: int, folder: str, keep: bool = True, **changes) -> None:
        config = run_config("CartPole-v1", "mace_full", 0, episodes=episodes, **changes)
        run.run(config, tmp_path / folder, None, keep)

    by_budget = {"beta": pretrained()}
    run_to(3, "without", keep=False)
    run_to(3, "other")
    run_to(3, "budget", **by_budget)
    before = {folder: content_of(tmp_path / folder) for folder in ("without", "other", "budget")}
    for folder, episodes, changes, why in (
        ("without", 4, {}, "config.episodes was 3 and is 4, without a checkpoint to go on from"),
        ("other", 4, {"ppo": {"clip": 0.1}}, "config.ppo.clip was 0.2 and is 0.1"),
        ("budget", 4, by_budget, f"is 4, which beta.rule {RULE!r} needs to know"),
    ):
        with refused(ConfigError, rf"{folder} holds a finished run where .*{re.escape(why)}"):
            run_to(episodes, folder, **changes)
    assert before == {folder: content_of(tmp_path / folder) for folder in before}


def test_an_unfinished_run_that_left_nothing_starts_over_in_words(run_config, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    (tmp_path / LOCK).write_bytes(run.CLAIM)
    run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path)
    said = f"starting over: what was trained in {tmp_path} left no checkpoint"
    assert said in caplog.text
    (tmp_path / "checkpoint.pt").write_bytes(b"cut off")
    (tmp_path / "run.json").unlink()
    caplog.clear()
    run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path, aside="all")
    assert "set aside in" in caplog.text and said not in caplog.text
