"""One run on disk: what it leaves and says, and what it keeps out of its folder."""

import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from shared import (
    OUTCOME,
    RESULTS,
    ROOT,
    files,
    finish,
    provenance_of,
)

from mace_rl.base import code_digest
from mace_rl.base.files import CHECKPOINT, LOCK, RECORD
from mace_rl.base.tables import RecordError
from mace_rl.environments import hopper
from mace_rl.runs import provenance, run
from mace_rl.runs.finished import in_the_way, read_runs


def test_tables_hold_the_records_and_run_json_their_origin(run_config, trained, tmp_path):
    settings = {"variant": "mace_full", "episodes": 5}
    config, directory = run_config(**settings), trained(**settings)
    assert files(directory) == RESULTS
    trainer = finish(config)
    record, run = [str(directory / "run.json")], ("CartPole-v1", "mace_full", 0)
    of_study = {run[:2]: config.settings() | {"seed": 7}}
    frame = read_runs(record, [(*run, 5)], of_study)[run]
    assert frame.to_dict("records") == [vars(record) for record in trainer.records]
    sharp = config.settings() | {"ppo": config.settings()["ppo"] | {"clip": 0.3}}
    for seed, settings_, said in [
        (1, config.settings(), "seed was 0 and is 1"),
        (0, sharp, "ppo.clip was 0.2 and is 0.3"),
    ]:
        with pytest.raises(RecordError, match=rf"run\.json is of another run: {said}"):
            read_runs(record, [(*run[:2], seed, 5)], {run[:2]: settings_})
    # A record of before a setting was there is of the same settings, with its default.
    older = config.settings()
    del older["ppo"]["clip_actions"]
    found = provenance_of(directory) | {"config": older}
    (tmp_path / "run.json").write_text(json.dumps(found))
    assert in_the_way([(tmp_path, config.settings())]) == {tmp_path: ""}
    assert in_the_way([(tmp_path, sharp)]) == {tmp_path: "ppo.clip was 0.2 and is 0.3"}
    frame = pd.read_csv(directory / "diagnostics.csv")
    expected = [vars(record) for record in trainer.diagnostics]
    np.testing.assert_equal(frame.to_dict("records"), expected)
    found = provenance_of(directory)
    assert found["config"] == config.settings()
    for module in (torch, np, gymnasium):
        assert found["versions"][module.__name__] == module.__version__
    assert found["sources"] == code_digest.digest("training")
    assert found["machine"]["cores"] == os.cpu_count() and found["machine"]["cpu"]
    assert found["threads"] == 1 and found["interruptions"] == []
    assert 0 <= found["checkpoint_seconds"] <= found["seconds"] < 600
    assert 50 < found["peak_memory_mb"] < 5000
    for name in OUTCOME:
        digest = hashlib.sha256((directory / name).read_bytes()).hexdigest()
        assert found["outputs"].pop(name) == digest
    assert found["outputs"] == {}


def test_the_commit_and_whether_it_is_what_ran(tmp_path, monkeypatch):
    """Of the package's own checkout, whatever git is told about others, and whoever owns it."""

    def git(folder: Path, *words: str) -> str:
        command = ["git", "-C", str(folder), "-c", "user.name=n", "-c", "user.email=e", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    def committed(folder: Path) -> str:
        for command in ("init", "add .", "commit -m one"):
            git(folder, *command.split())
        return git(folder, "rev-parse", "HEAD")

    project = tmp_path / "outer" / "project"
    code = project / "src" / "mace_rl" / "runs" / "provenance.py"
    code.parent.mkdir(parents=True)
    code.write_text("1\n")
    monkeypatch.setattr(provenance.code_digest, "PACKAGE", project / "src" / "mace_rl")
    unknown = provenance.git_state()
    assert "not a git repository" in unknown.pop("reason")
    assert unknown == {"commit": None, "dirty": None}
    (project.parent / "own.txt").touch()
    committed(project.parent)  # has the package in its folder, and in its commit
    assert "not a git repository" in provenance.git_state()["reason"]
    clean = {"commit": committed(project), "dirty": False}
    (project / "notes").touch()  # not tracked
    assert provenance.git_state() == clean
    code.write_text("2\n")
    for name in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR"):
        monkeypatch.setenv(name, str(project.parent / ".git"))
    assert provenance.git_state() == clean | {"dirty": True}
    if os.geteuid() == 0:
        os.chown(project, 12345, 12345)
        os.chown(project / ".git", 12345, 12345)
        assert provenance.git_state() == clean | {"dirty": True}
    site = shutil.copytree(project / "src", project / "lib" / "site-packages")  # installed there
    monkeypatch.setattr(provenance.code_digest, "PACKAGE", site / "mace_rl")
    assert "not a git repository" in provenance.git_state()["reason"]


@pytest.mark.parametrize(
    ("environment", "changes", "reason"),
    [
        ("HopperBulletEnv-v0", {}, "numpy .* adds numbers in another order"),
        ("CartPole-v1", {"environment_arguments": {"sutton_barto_reward": True}}, "steps are not"),
        ("CartPole-v1", {}, None),
        ("MountainCar-v0", {}, None),
    ],
)
def test_a_fast_path_that_is_not_taken_is_said_once(
    run_config, tmp_path, monkeypatch, caplog, environment, changes, reason
):
    """Of one that is taken, not wanted or not there nothing is said."""
    if reason:
        monkeypatch.setattr(hopper, "numpy_adds_as_assumed", lambda: False)
    config = run_config(environment, "ppo", 0, episodes=2, max_episode_steps=20, **changes)
    run.run(config, tmp_path)
    expected = f"the fast path for {environment} is not taken: .*{reason}"
    assert len(caplog.records) == (reason is not None)
    for record in caplog.records:
        assert record.levelname == "WARNING" and re.match(expected, record.getMessage())


@pytest.mark.slow
def test_the_peak_of_memory_is_this_process_s_and_not_that_of_who_started_it() -> None:
    child = "from mace_rl.runs.provenance import peak_memory_mb; print(peak_memory_mb())"
    parent = "import subprocess, sys; much = bytearray(600 << 20); "
    parent += f"subprocess.run([sys.executable, '-c', {child!r}], check=True)"
    command = [sys.executable, "-c", parent]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert 5 < float(done.stdout) < 400


JOB = """
import sys
sys.path.insert(0, sys.argv[1])
from types import SimpleNamespace
from job import job
with job(SimpleNamespace(rule="it", wildcards=[], log=["log"])):
    raise eval(sys.argv[2])
"""


@pytest.mark.slow
@pytest.mark.parametrize("ends, closed", [("SystemExit(0)", ""), ("GeneratorExit()", ">&- 2>&-")])
def test_a_job_that_code_of_the_users_ends_has_failed(tmp_path, ends, closed):
    scripts = ROOT / "workflow" / "scripts"
    command = shlex.join([sys.executable, "-c", JOB, str(scripts), ends])
    assert subprocess.run(["sh", "-c", f"{command} {closed}"], cwd=tmp_path).returncode == 1
    last = (tmp_path / "log").read_text().splitlines()[-1]
    assert f" it failed: {ends.partition('(')[0]}" in last


def test_what_a_program_has_set_in_pytorch_changes_nothing(run_config, tmp_path):
    config = run_config("CartPole-v1", "ppo", 0, episodes=2, engine="torch")
    run.run(config, tmp_path / "plain")
    with torch.inference_mode(), torch.autocast("cpu"):
        run.run(config, tmp_path / "set")
    one, other = ((tmp_path / name / "agent.pt").read_bytes() for name in ("plain", "set"))
    assert one == other


def test_a_worker_of_the_environment_does_not_hold_the_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "LOCK_SECONDS", 0.3)  # which a fork may take
    asleep, wake = os.pipe()
    with run.exclusive(tmp_path):
        worker = os.fork()
        if not worker:
            os.close(wake)
            os.read(asleep, 1)
            os._exit(0)
        with pytest.raises(run.RunError), run.exclusive(tmp_path):
            pass
    monkeypatch.setattr(run, "LOCK_SECONDS", 5.0)  # a worker takes a moment to close its copy
    with run.exclusive(tmp_path):
        assert os.waitpid(worker, os.WNOHANG) == (0, 0)  # it lives
    os.close(wake)
    os.waitpid(worker, 0)


@pytest.mark.parametrize("name", [RECORD, CHECKPOINT, "episodes.csv", "progress.json", LOCK])
def test_a_pipe_in_a_run_s_place_is_refused(run_config, tmp_path, name):
    config = run_config("CartPole-v1", "ppo", 0, episodes=2)
    if name == "episodes.csv":
        run.run(config, tmp_path)
        (tmp_path / name).unlink()
    os.mkfifo(tmp_path / name)
    with pytest.raises((run.RunError, OSError, ValueError), match=name):
        run.run(config, tmp_path)
