"""One run on disk: interrupted and resumed to the bit, what it refuses, what it leaves behind."""

import ast
import fcntl
import hashlib
import json
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl import checkpoint, provenance, run, sources
from mace_rl.finite import NonFiniteError
from mace_rl.hyperparameters import RunConfig
from mace_rl.records import read_episodes
from mace_rl.study import merge
from mace_rl.train import Trainer

ENVIRONMENTS = ["CartPole-v1", "Acrobot-v1", "HopperBulletEnv-v0"]
VARIANTS = ["ppo", "mace_fixed", "mace_full"]
RESULTS = ["agent.pt", "episodes.csv", "run.json"]
UNFINISHED = ["checkpoint.pt", "progress.json"]


class Killed(BaseException):
    """Ends a run as a signal would: nothing in the program catches it."""


@pytest.fixture
def kill(monkeypatch):
    """`kill(episode)`: the next run dies in the update after this episode; None: it does not."""
    improve = Trainer.improve

    def arm(episode: int | None) -> None:
        def improve_or_die(self, rollout) -> None:
            if len(self.records) == episode:
                raise Killed
            improve(self, rollout)

        monkeypatch.setattr(Trainer, "improve", improve_or_die)

    return arm


@pytest.fixture
def checkpoint_every(monkeypatch):
    """`checkpoint_every(n)`: a checkpoint after every n-th round instead of by time."""

    def arrange(rounds: int) -> None:
        asked = [0]

        def due(self) -> bool:
            asked[0] += 1
            return asked[0] % rounds == 0

        monkeypatch.setattr(run.Clock, "checkpoint_due", due)

    return arrange


def files(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def outcome(directory: Path) -> tuple[bytes, bytes]:
    """The bytes that must not depend on interruptions."""
    assert files(directory) == RESULTS
    return (directory / "episodes.csv").read_bytes(), (directory / "agent.pt").read_bytes()


def provenance_of(directory: Path) -> dict:
    return json.loads((directory / "run.json").read_text(encoding="utf-8"))


# --- Interrupted and resumed --------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_resumed_run_equals_uninterrupted_run(
    run_config, tmp_path, kill, checkpoint_every, environment, variant
):
    """Killed twice, between checkpoints, so that lost rounds are played again."""
    config = run_config(environment, variant, 4, episodes=11)
    run.run(config, tmp_path / "whole")
    checkpoint_every(3)
    for episode in (5, 10):
        kill(episode)
        with pytest.raises(Killed):
            run.run(config, tmp_path / "killed")
        assert files(tmp_path / "killed") == UNFINISHED
    kill(None)
    run.run(config, tmp_path / "killed")
    assert outcome(tmp_path / "killed") == outcome(tmp_path / "whole")
    interruptions = provenance_of(tmp_path / "killed")["interruptions"]
    # Resumed where the last checkpoint before the kill was.
    assert [item["after_episode"] for item in interruptions] == [3, 8]
    assert all(item["machine"]["cpu"] for item in interruptions)


@pytest.mark.parametrize("variant", VARIANTS)
def test_resumed_run_with_rollouts_of_several_episodes(
    run_config, tmp_path, kill, checkpoint_every, variant
):
    settings = {"rollout_steps": 80, "minibatch_size": 16, "normalise_observations": True}
    config = run_config("CartPole-v1", variant, 4, episodes=20, ppo=settings)
    run.run(config, tmp_path / "whole")
    checkpoint_every(1)
    rounds = [records[-1].episode for records in Trainer(config).run()]
    assert len(rounds) < 10
    kill(rounds[3])
    with pytest.raises(Killed):
        run.run(config, tmp_path / "killed")
    kill(None)
    run.run(config, tmp_path / "killed")
    assert outcome(tmp_path / "killed") == outcome(tmp_path / "whole")


CHILD = """
import sys, time
from pathlib import Path
from mace_rl import run
from mace_rl.hyperparameters import RunConfig
from mace_rl.train import Trainer

run.CHECKPOINT_SECONDS, run.CHECKPOINT_COST = 0, float("inf")
improve = Trainer.improve

def improve_until_12(self, rollout):
    improve(self, rollout)
    if len(self.records) == 12:
        print("ready", flush=True)
        time.sleep(600)

Trainer.improve = improve_until_12
run.run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.mark.slow
def test_a_process_killed_by_sigkill_is_resumed_by_another(
    run_config, tmp_path, monkeypatch, caplog
):
    """And while it lives, a second process in its folder is refused."""
    monkeypatch.setattr(run, "LOCK_SECONDS", 0.3)
    config = run_config("HopperBulletEnv-v0", "mace_full", 5, episodes=20)
    directory = tmp_path / "Läufe mit Leerzeichen"
    command = [sys.executable, "-c", CHILD, config.model_dump_json(), str(directory)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
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
        run.run(config, directory)
    assert "resuming after episode 11" in caplog.text
    run.run(config, tmp_path / "whole")
    assert outcome(directory) == outcome(tmp_path / "whole")
    assert len(provenance_of(directory)["interruptions"]) == 1


COUNT_THREADS = """
import sys
from pathlib import Path
from threadpoolctl import threadpool_info
from mace_rl import run
from mace_rl.hyperparameters import RunConfig
from mace_rl.train import Trainer

class Watched(Trainer):
    def run(self):
        yield from super().run()
        print({library["filepath"]: library["num_threads"] for library in threadpool_info()})

run.Trainer = Watched
run.run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]))
"""


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
    threads = ast.literal_eval(done.stdout)
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


def test_killed_before_the_results_are_complete(run_config, tmp_path, monkeypatch):
    """All episodes played, one result written: what is missing is made from the checkpoint."""
    config = run_config("CartPole-v1", "mace_full", 0, episodes=6)
    run.run(config, tmp_path / "whole")
    monkeypatch.setattr(run.Clock, "checkpoint_due", lambda self: True)

    def die(*_) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(provenance, "git_state", die)
        with pytest.raises(Killed):
            run.run(config, tmp_path / "killed")
    assert files(tmp_path / "killed") == sorted([*UNFINISHED, "agent.pt", "episodes.csv"])
    (tmp_path / "killed" / "agent.pt").unlink()  # as Snakemake does with outputs
    run.run(config, tmp_path / "killed")
    assert outcome(tmp_path / "killed") == outcome(tmp_path / "whole")


def test_killed_while_writing_a_checkpoint(run_config, tmp_path, monkeypatch):
    """The one before is whole, and is what the run continues from."""
    config = run_config("CartPole-v1", "mace_fixed", 0, episodes=9)
    run.run(config, tmp_path / "whole")
    monkeypatch.setattr(run.Clock, "checkpoint_due", lambda self: True)
    replaced = [0]
    replace = os.replace

    def replace_or_die(source, target) -> None:
        if Path(target).name == "checkpoint.pt":
            replaced[0] += 1
            if replaced[0] == 5:
                raise Killed
        replace(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", replace_or_die)
        with pytest.raises(Killed):
            run.run(config, tmp_path / "killed")
    assert files(tmp_path / "killed") == UNFINISHED
    run.run(config, tmp_path / "killed")
    assert outcome(tmp_path / "killed") == outcome(tmp_path / "whole")
    assert len(provenance_of(tmp_path / "killed")["interruptions"]) == 1


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
    kill(5)
    with pytest.raises(Killed):
        run.run(config, tmp_path / "run")
    kill(None)
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
def test_damaged_checkpoint_is_not_continued(interrupted, tmp_path, caplog, damage):
    path = interrupted.directory / "checkpoint.pt"
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    run.run(interrupted.config, interrupted.directory)
    assert f"starting afresh: {path}: cut off or altered" in caplog.text
    run.run(interrupted.config, tmp_path / "whole")
    assert outcome(interrupted.directory) == outcome(tmp_path / "whole")
    assert provenance_of(interrupted.directory)["interruptions"] == []


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
    interrupted, tmp_path, caplog, changes, message
):
    settings = merge(interrupted.config.model_dump(), changes, whole={"beta"})
    config = RunConfig.model_validate(settings)
    run.run(config, interrupted.directory)
    assert f"of another run: {message}" in caplog.text
    run.run(config, tmp_path / "whole")
    assert outcome(interrupted.directory) == outcome(tmp_path / "whole")


def test_checkpoint_of_other_versions_or_code_is_not_continued(
    interrupted, monkeypatch, caplog, kill
):
    found = provenance.versions()
    kill(1)  # before the first checkpoint, so the old one stays
    with monkeypatch.context() as patched:
        patched.setattr(provenance, "versions", lambda: found | {"torch": "9.9"})
        with pytest.raises(Killed):
            run.run(interrupted.config, interrupted.directory)
    assert f"versions.torch was {found['torch']!r} and is '9.9'" in caplog.text
    with monkeypatch.context() as patched:
        patched.setattr(sources, "digest", lambda path: "0" * 64)
        with pytest.raises(Killed):
            run.run(interrupted.config, interrupted.directory)
    assert "sources was" in caplog.text
    caplog.clear()
    kill(None)
    run.run(interrupted.config, interrupted.directory)
    assert "afresh" not in caplog.text


def test_identity_covers_every_module_that_training_imports():
    """A change in any of them changes the digest, so the checkpoint is of another code."""
    script = "import sys, mace_rl.run; print(*(m for m in sys.modules if m.startswith('mace_rl.')))"
    listed = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    ).stdout
    imported = {f"{name.removeprefix('mace_rl.')}.py" for name in listed.split()}
    covered = {path.name for path in sources.sources(sources.PACKAGE / "run.py")}
    assert {"train.py", "ppo.py", "run.py"} <= imported <= covered


class Payload:
    """Creates a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


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


class Faulty(gymnasium.Env):
    """Pays NaN in the third step once 20 steps were made, if it is broken."""

    observation_space, action_space = Box(-1, 1, (2,), np.float32), Discrete(2)

    def __init__(self, broken: bool) -> None:
        self.broken, self.total = broken, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps, self.total = self.steps + 1, self.total + 1
        reward = np.nan if self.broken and self.total > 20 and self.steps == 3 else 1.0
        return self.np_random.random(2).astype(np.float32), reward, False, False, {}


def test_nan_stops_the_run_and_keeps_the_last_checkpoint(
    run_config, register, tmp_path, checkpoint_every, caplog
):
    name = register("Faulty-v0", Faulty, 6, broken=True)
    config = run_config(name, "mace_full", 3, episodes=9)
    checkpoint_every(1)
    with pytest.raises(NonFiniteError) as caught:
        run.run(config, tmp_path / "run")
    place = "Faulty-v0 mace_full seed 3, episode 4: the reward is nan after step 3"
    assert str(caught.value) == place
    assert files(tmp_path / "run") == UNFINISHED
    register("Faulty-v0", Faulty, 6, broken=False)  # whatever it was is repaired
    with caplog.at_level(logging.INFO):
        run.run(config, tmp_path / "run")
    assert "resuming after episode 3" in caplog.text
    run.run(config, tmp_path / "whole")
    assert outcome(tmp_path / "run") == outcome(tmp_path / "whole")


# --- What a run leaves behind -------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(run_config, tmp_path_factory):
    """A finished run: its configuration and folder."""
    config: RunConfig = run_config("CartPole-v1", "mace_full", 0, episodes=5)
    directory = tmp_path_factory.mktemp("runs") / "deep" / "er"
    run.run(config, directory)
    return SimpleNamespace(config=config, directory=directory)


def test_only_the_results_are_left(finished):
    assert files(finished.directory) == RESULTS


def test_episodes_csv_holds_the_records_to_the_bit(finished):
    trainer = Trainer(finished.config)
    for _ in trainer.run():
        pass
    frame = read_episodes(finished.directory / "episodes.csv", 5)
    assert frame.to_dict("records") == [vars(record) for record in trainer.records]


def test_agent_is_the_trained_one_and_loads_as_plain_data(finished):
    path = finished.directory / "agent.pt"
    trainer = Trainer(finished.config)
    for _ in trainer.run():
        pass
    loaded = torch.load(path, weights_only=True)
    for name, network in {"actor": trainer.ppo.actor, **trainer.ppo.critics}.items():
        assert (loaded["networks"][name]["parameters"].numpy() == network.parameters).all()


def test_run_json_says_where_the_results_come_from(finished):
    found = provenance_of(finished.directory)
    assert found["config"] == finished.config.model_dump()
    assert found["versions"]["torch"] == torch.__version__
    assert found["versions"]["numpy"] == np.__version__
    assert found["versions"]["gymnasium"] == gymnasium.__version__
    assert found["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert found["sources"] == sources.digest(sources.PACKAGE / "run.py")
    assert set(found["code"]) == {"commit", "dirty"}
    assert found["machine"]["cores"] == os.cpu_count() and found["machine"]["cpu"]
    assert found["threads"] == 1
    assert 0 <= found["checkpoint_seconds"] <= found["seconds"] < 600
    assert found["interruptions"] == []
    assert 50 < found["peak_memory_mb"] < 5000
    assert found["outputs"] == {
        name: hashlib.sha256((finished.directory / name).read_bytes()).hexdigest()
        for name in ("episodes.csv", "agent.pt")
    }


def test_progress_says_how_far_it_is(interrupted):
    progress = json.loads((interrupted.directory / "progress.json").read_text())
    assert (progress["episode"], progress["episodes"]) == (1, 6)  # then not for two seconds
    assert progress["env_steps"] == progress["recent_return"]  # CartPole pays 1 a step
    assert progress["pid"] == os.getpid()
    rate = progress["env_steps"] / progress["seconds"]
    assert progress["steps_per_second"] == pytest.approx(rate)


def test_run_that_failed_gives_its_folder_back(run_config, tmp_path, kill):
    config = run_config("CartPole-v1", "ppo", 0, episodes=3)
    kill(2)
    with pytest.raises(Killed):
        run.run(config, tmp_path)
    kill(None)
    run.run(config, tmp_path)
    assert files(tmp_path) == RESULTS


# --- When a checkpoint is due -------------------------------------------------------------------


@pytest.mark.parametrize(("cost", "wait"), [(0.01, 10.0), (0.1, 10.0), (0.5, 50.0), (3.0, 300.0)])
def test_checkpoints_cost_at_most_one_percent(monkeypatch, cost, wait):
    """Every 10 s, or as seldom as their cost demands; the clock is set by hand."""
    now = [1000.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    clock = run.Clock(start=900.0)  # 100 s were spent before an interruption
    assert clock.elapsed() == 100 and not clock.checkpoint_due()
    now[0] += 10
    assert clock.checkpoint_due()
    with clock.saving():
        now[0] += cost
    assert clock.checkpoint_seconds == pytest.approx(cost)
    now[0] = 1010 + wait - 0.001
    assert not clock.checkpoint_due()
    now[0] += 0.002
    assert clock.checkpoint_due()
