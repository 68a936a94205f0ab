"""One run on disk: what it leaves behind, what it says, and which code makes it what it is."""

import ast
import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from shared import ENVIRONMENTS, LAYER_NORM, OUTCOME, RESULTS, files, finish, provenance_of

from mace_rl import sources
from mace_rl.config.reading import merge
from mace_rl.environments import hopper
from mace_rl.runs import checkpoint, provenance, run
from mace_rl.runs.agent import load_agent
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.finished import read_runs


@pytest.fixture(scope="module")
def finished(run_config, tmp_path_factory):
    """A finished run: its configuration and folder, where only the results are left."""
    config = run_config("CartPole-v1", "mace_full", 0, episodes=5)
    directory = tmp_path_factory.mktemp("runs") / "deep" / "er"
    run.run(config, directory)
    assert files(directory) == RESULTS
    return SimpleNamespace(config=config, directory=directory)


def test_the_tables_hold_the_records_to_the_bit(finished):
    trainer = finish(finished.config)
    record = str(finished.directory / "run.json")
    frames = read_runs([record], [("CartPole-v1", "mace_full", 0, 5)])
    frame = frames["CartPole-v1", "mace_full", 0]
    assert frame.to_dict("records") == [vars(record) for record in trainer.records]
    frame = pd.read_csv(finished.directory / "diagnostics.csv")
    expected = [vars(record) for record in trainer.diagnostics]
    np.testing.assert_equal(frame.to_dict("records"), expected)


@pytest.mark.parametrize(
    "changes",
    [{}, {"engine": "torch"}, {"ppo": {"network": LAYER_NORM}}],
    ids=["compiled", "torch", "LayerNorm"],
)
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_agent_is_torch_modules_that_act_as_the_trainer_does(
    run_config, tmp_path, environment, changes
):
    """From observations as they are; Pendulum's are normalised, and what the critics get."""
    box = environment == "Pendulum-v1"
    changes = merge(changes, {"episodes": 3, "ppo": {"normalise_observations": box}})
    config = run_config(environment, "mace_full", 0, **changes)
    run.run(config, tmp_path)
    agent, trainer, rng = load_agent(tmp_path), finish(config), np.random.default_rng(0)
    space = trainer.environment.observation_space
    space.seed(0)
    rows = np.stack([trainer.environment.encode(space.sample()) for _ in range(50)])
    noise = rng.standard_normal((50, 1)) if box else rng.random(50)
    acting, policy = trainer.ppo.acting_policy(), agent.policy(rows)
    drawn = [acting.act(*pair) for pair in zip(rows, noise, strict=True)]
    actions, log_probs = (np.array(parts) for parts in zip(*drawn, strict=True))
    found = policy.log_prob(torch.from_numpy(actions)).detach()
    np.testing.assert_allclose(found, log_probs, rtol=1e-4, atol=1e-4)
    if box:
        expected = policy.mean + policy.stddev * torch.from_numpy(noise)
        np.testing.assert_allclose(actions, expected.detach(), rtol=1e-4, atol=1e-5)
    else:
        expected = (torch.from_numpy(noise)[:, None] >= policy.probs.cumsum(1)).sum(1)
        assert (actions == expected.numpy()).all()
    one = agent.policy(rows[0]).log_prob(torch.from_numpy(actions)[0])
    torch.testing.assert_close(one, policy.log_prob(torch.from_numpy(actions))[0])
    assert (agent.policy.mean != 0).any() == box
    for kind, critic in trainer.ppo.critics.items():
        values = agent.critics[kind](torch.from_numpy(rows)).detach()
        np.testing.assert_allclose(values[:, 0], critic.values(rows), rtol=1e-4, atol=1e-5)
    assert np.isfinite(evaluate(tmp_path, 2, 0)).all()


def test_run_json_says_where_the_results_come_from(finished):
    found = provenance_of(finished.directory)
    assert found["config"] == finished.config.settings()
    assert found["versions"]["torch"] == torch.__version__
    assert found["versions"]["numpy"] == np.__version__
    assert found["versions"]["gymnasium"] == gymnasium.__version__
    assert found["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert found["sources"] == sources.digest("training")
    assert set(found["code"]) == {"commit", "dirty"}
    assert found["machine"]["cores"] == os.cpu_count() and found["machine"]["cpu"]
    assert found["threads"] == 1
    assert 0 <= found["checkpoint_seconds"] <= found["seconds"] < 600
    assert found["interruptions"] == []
    assert 50 < found["peak_memory_mb"] < 5000
    assert found["outputs"] == {
        name: hashlib.sha256((finished.directory / name).read_bytes()).hexdigest()
        for name in OUTCOME
    }


def test_the_commit_and_whether_it_is_what_ran(tmp_path, monkeypatch):
    def git(*words: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e", *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    monkeypatch.setattr(provenance.sources, "PACKAGE", tmp_path)
    assert provenance.git_state() == {"commit": None, "dirty": None}
    git("init")
    (tmp_path / "code.py").write_text("1\n")
    git("add", "code.py")
    git("commit", "-m", "one")
    (tmp_path / "notes").touch()  # not tracked
    clean = {"commit": git("rev-parse", "HEAD"), "dirty": False}
    assert provenance.git_state() == clean
    (tmp_path / "code.py").write_text("2\n")
    assert provenance.git_state() == clean | {"dirty": True}


def test_seconds_before_an_interruption_count(interrupted):
    path = interrupted.directory / "checkpoint.pt"
    state = checkpoint.read(path)["state"] | {"seconds": 1000.0, "checkpoint_seconds": 100.0}
    checkpoint.save(path, run.run_identity(interrupted.config), state)
    run.run(interrupted.config, interrupted.directory)
    found = provenance_of(interrupted.directory)
    assert len(found["interruptions"]) == 1
    assert 1000 < found["seconds"] < 1600 and 100 <= found["checkpoint_seconds"] < 200


@pytest.mark.parametrize(
    ("environment", "changes", "reason"),
    [
        ("HopperBulletEnv-v0", {}, "numpy .* adds numbers in another order"),
        ("SparseHopper-v0", {}, "numpy .* adds numbers in another order"),
        ("CartPole-v1", {"environment_arguments": {"sutton_barto_reward": True}}, "steps are not"),
    ],
)
def test_a_fast_path_that_is_not_taken_is_said_once(
    run_config, tmp_path, monkeypatch, caplog, environment, changes, reason
):
    monkeypatch.setattr(hopper, "numpy_adds_as_assumed", lambda: False)
    config = run_config(environment, "ppo", 0, episodes=2, max_episode_steps=20, **changes)
    run.run(config, tmp_path)
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    said = f"the fast path for {environment} is not taken: .*{reason}"
    assert re.match(said, record.getMessage())


@pytest.mark.parametrize("environment", [*ENVIRONMENTS, "SparseHopper-v0", "MountainCar-v0"])
@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_of_a_fast_path_that_is_taken_not_wanted_or_not_there_nothing_is_said(
    run_config, tmp_path, caplog, environment, engine
):
    config = run_config(environment, "ppo", 0, episodes=2, max_episode_steps=20, engine=engine)
    run.run(config, tmp_path)
    assert not caplog.records


def test_progress_says_how_far_it_is(interrupted):
    progress = json.loads((interrupted.directory / "progress.json").read_text())
    assert (progress["episode"], progress["episodes"]) == (1, 6)
    assert progress["env_steps"] == progress["recent_return"]  # CartPole pays 1 a step
    assert progress["pid"] == os.getpid()


COUNT_THREADS = """
import sys
from pathlib import Path
from threadpoolctl import threadpool_info
from mace_rl.runs import run
from mace_rl.config.run import RunConfig

def observe(progress):
    print({library["filepath"]: library["num_threads"] for library in threadpool_info()})

run.run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]), observe)
"""


@pytest.mark.slow
def test_a_run_uses_one_thread(run_config, tmp_path):
    """Whatever the environment says, and in every library, NumPy's BLAS and SciPy's among them."""
    config = run_config("CartPole-v1", "mace_full", 0, episodes=3)
    done = subprocess.run(
        [sys.executable, "-c", COUNT_THREADS, config.model_dump_json(), str(tmp_path)],
        env={name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"},
        capture_output=True,
        text=True,
        check=True,
    )
    threads = ast.literal_eval(done.stdout.splitlines()[-1])
    assert any("scipy" in Path(library).parent.name for library in threads)
    assert any("numpy" in Path(library).parent.name for library in threads)
    assert set(threads.values()) == {1}


@pytest.mark.slow
def test_identity_covers_every_module_that_training_imports(run_config, monkeypatch):
    """A change in any of them, or in the user's own, makes the checkpoint one of another code."""
    script = (
        "import sys, mace_rl.runs.run\n"
        "for name, module in sys.modules.items():\n"
        "    if name.partition('.')[0] == 'mace_rl': print(module.__file__)"
    )
    command = [sys.executable, "-c", script]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    imported = {Path(line) for line in listed.split()}
    assert {path.name for path in imported} >= {"train.py", "ppo.py", "run.py", "__init__.py"}
    covered, read = set(), Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: (covered.add(path), read(path))[1])
    run.run_identity(run_config(ppo={"network": LAYER_NORM}))
    assert imported | {Path(__file__).with_name("shared.py")} <= covered


def test_the_peak_of_memory_is_this_process_s_and_not_that_of_who_started_it() -> None:
    child = "from mace_rl.runs.provenance import peak_memory_mb; print(peak_memory_mb())"
    parent = (
        "import subprocess, sys; much = bytearray(600 << 20); print(len(much) >> 20, flush=True);"
        f"subprocess.run([sys.executable, '-c', {child!r}], check=True)"
    )
    done = subprocess.run(
        [sys.executable, "-c", parent], capture_output=True, text=True, check=True
    )
    held, peak = map(float, done.stdout.split())
    assert held == 600 and 5 < peak < 400
