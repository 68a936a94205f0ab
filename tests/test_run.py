"""One run on disk: interrupted and resumed to the bit, what it refuses, what it leaves behind."""

import ast
import fcntl
import hashlib
import itertools
import json
import logging
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from shared import LAYER_NORM, VARIANTS, Bonanza, finish

from mace_rl import sources
from mace_rl.config.reading import merge, merge_layers
from mace_rl.config.run import RunConfig
from mace_rl.environments import hopper
from mace_rl.finite import NonFiniteError
from mace_rl.runs import checkpoint, provenance, run
from mace_rl.runs.agent import load_agent
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.finished import read_runs
from mace_rl.train import Trainer

ENVIRONMENTS = ["CartPole-v1", "Acrobot-v1", "HopperBulletEnv-v0"]
OUTCOME = ["agent.pt", "diagnostics.csv", "episodes.csv"]
RESULTS = [*OUTCOME, "run.json"]
UNFINISHED = ["checkpoint.pt", "progress.json"]


class Killed(BaseException):
    """Ends a run as a signal would: nothing in the program catches it."""


@pytest.fixture
def kill(monkeypatch):
    """`kill(update, config, directory)`: carry out a run that dies in this update."""
    improve = Trainer.improve

    def start(number: int, config: RunConfig, directory: Path) -> None:
        def improve_or_die(self, rollout):
            if len(self.diagnostics) == number - 1:
                raise Killed
            return improve(self, rollout)

        with monkeypatch.context() as patched:
            patched.setattr(Trainer, "improve", improve_or_die)
            with pytest.raises(Killed):
                run.run(config, directory)

    return start


@pytest.fixture
def checkpoint_every(monkeypatch):
    """`checkpoint_every(n)`: a checkpoint after every n-th round instead of by time."""

    def arrange(rounds: int) -> None:
        asked = itertools.count(1)
        monkeypatch.setattr(run.Clock, "checkpoint_due", lambda self: next(asked) % rounds == 0)

    return arrange


def files(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


@pytest.fixture
def completes(tmp_path):
    """`completes(config, directory)`: carry it to its end, which is that of a run never disturbed.

    Bytes are compared of all that must not depend on interruptions. Returns what run.json tells.
    """

    def carry_on(config: RunConfig, directory: Path) -> dict:
        outcomes = []
        for folder in (directory, tmp_path / "whole"):
            run.run(config, folder)
            assert files(folder) == RESULTS
            outcomes.append([(folder / name).read_bytes() for name in OUTCOME])
        assert outcomes[0] == outcomes[1]
        return provenance_of(directory)

    return carry_on


def provenance_of(directory: Path) -> dict:
    return json.loads((directory / "run.json").read_text(encoding="utf-8"))


# --- Interrupted and resumed --------------------------------------------------------------------


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


def test_a_dying_predecessor_is_waited_for(tmp_path):
    """It holds the folder's lock for a moment after whoever started it is gone."""
    holder = os.open(tmp_path, os.O_RDONLY)
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


# --- Checkpoints that are not continued ---------------------------------------------------------


@pytest.fixture
def interrupted(run_config, tmp_path, kill, checkpoint_every):
    """A run of CartPole-v1, killed after a checkpoint: its configuration and folder."""
    config = run_config("CartPole-v1", "mace_full", 0, episodes=6)
    checkpoint_every(1)
    kill(5, config, tmp_path / "run")
    return SimpleNamespace(config=config, directory=tmp_path / "run")


def flip_a_byte(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGES = {
    "altered at the start": lambda content: flip_a_byte(content, 0),
    "altered in the middle": lambda content: flip_a_byte(content, len(content) // 2),
    "altered at the end": lambda content: flip_a_byte(content, len(content) - 1),
    "cut off": lambda content: content[:-1],
    "cut off early": lambda content: content[:40],
    "empty": lambda content: b"",
    "something else": lambda content: b"never a checkpoint\n",
    "too long": lambda content: content + b"\0",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_checkpoint_is_not_continued(interrupted, completes, caplog, damage):
    path = interrupted.directory / "checkpoint.pt"
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert completes(interrupted.config, interrupted.directory)["interruptions"] == []
    assert f"starting afresh: {path}: cut off or altered" in caplog.text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1}, "config.seed was 0 and is 1"),
        ({"variant": "mace_fixed"}, "config.variant was 'mace_full' and is 'mace_fixed'"),
        ({"environment": "Acrobot-v1"}, "config.environment was 'CartPole-v1' and is 'Acrobot-v1'"),
        ({"episodes": 5}, "config.episodes was 6 and is 5"),
        ({"ppo": {"clip": 0.3}}, "config.ppo.clip was 0.2 and is 0.3"),
        ({"beta": {"kind": "none"}}, "config.beta.kind was 'meta' and is 'none'"),
        ({"meta": {"max_sequence": None}}, "config.meta.max_sequence was 32 and is None"),
    ],
)
def test_checkpoint_of_another_configuration_is_not_continued(
    interrupted, completes, caplog, changes, message
):
    settings = merge_layers(interrupted.config.settings(), changes)
    completes(RunConfig.model_validate(settings), interrupted.directory)
    assert f"of another run: {message}" in caplog.text


def test_checkpoint_of_other_versions_or_code_is_not_continued(
    interrupted, monkeypatch, caplog, kill
):
    found = provenance.versions()
    for place, name, replaced, message in (
        (provenance, "versions", lambda: found | {"torch": "9.9"}, "versions.torch was "),
        (sources, "digest", lambda *paths: "0" * 64, "sources was "),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, replaced)
            # Before the first checkpoint, so the old one stays.
            kill(1, interrupted.config, interrupted.directory)
        assert message in caplog.text
    caplog.clear()
    run.run(interrupted.config, interrupted.directory)
    assert "afresh" not in caplog.text


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


class Payload:
    """Creates a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.slow
@pytest.mark.parametrize("writer", ["pickle", "torch"])
def test_loading_executes_nothing(interrupted, tmp_path, caplog, writer):
    """Even with the right digest in front."""
    mark = tmp_path / "executed"
    if writer == "pickle":
        data = pickle.dumps(Payload(mark), protocol=2)
    else:
        data = checkpoint.archive({"identity": Payload(mark)})
    path = interrupted.directory / "checkpoint.pt"
    path.write_bytes(hashlib.sha256(data).hexdigest().encode() + b"\n" + data)
    with pytest.raises(checkpoint.CheckpointError, match="not a readable archive"):
        checkpoint.load(path, {})
    run.run(interrupted.config, interrupted.directory)
    assert "starting afresh" in caplog.text and not mark.exists()


# --- Numbers that go bad ------------------------------------------------------------------------


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


# --- Finished, deleted with the rest of its job, and asked for again ------------------------------


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


# --- What a run leaves behind -------------------------------------------------------------------


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
    assert found["sources"] == sources.digest(sources.PACKAGE / "runs" / "run.py")
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
    assert (progress["episode"], progress["episodes"]) == (1, 6)  # then not for two seconds
    assert progress["env_steps"] == progress["recent_return"]  # CartPole pays 1 a step
    assert progress["pid"] == os.getpid()


# --- When a checkpoint is due -------------------------------------------------------------------


@pytest.mark.parametrize("said", ["often", "-1", "nan", "inf", ""])
def test_a_time_between_checkpoints_that_cannot_be(run_config, tmp_path, monkeypatch, said):
    monkeypatch.setenv("MACE_RL_CHECKPOINT_SECONDS", said)
    refusal = f"MACE_RL_CHECKPOINT_SECONDS is {said!r}, but should be a number of seconds"
    with pytest.raises(run.RunError, match=re.escape(refusal)):
        run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path)


@pytest.mark.parametrize(("cost", "wait"), [(0.01, 10.0), (0.1, 10.0), (0.5, 50.0), (3.0, 300.0)])
def test_checkpoints_cost_at_most_one_percent(monkeypatch, cost, wait):
    """Every 10 s, or as seldom as their cost demands; the clock is set by hand."""
    now = [1000.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    clock = run.Clock(900.0, 2.0, 0.7)  # 100 s before an interruption, 0.7 of them on checkpoints
    assert clock.elapsed() == 100 and not clock.checkpoint_due()
    now[0] += 10
    assert clock.checkpoint_due()
    with clock.saving():
        now[0] += cost
    assert clock.checkpoint_seconds == pytest.approx(0.7 + cost)
    now[0] = 1010 + wait - 0.001
    assert not clock.checkpoint_due()
    now[0] += 0.002
    assert clock.checkpoint_due()
