"""Checkpoints: which are continued and which refused, what they hold, and how often they come."""

import hashlib
import random
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from shared import RESULTS, Killed, content_of, provenance_of

from mace_rl.base import code_digest
from mace_rl.runs import checkpoint, provenance, run
from mace_rl.training.trainer import Trainer


class Bomb:
    def __reduce__(self):
        return Path.touch, (Path("executed"),)


def signed(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode() + b"\n" + content


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content[:-1] + bytes([content[-1] ^ 1]), "cut off or altered"),
        (lambda _: b"", "cut off or altered"),
        (lambda _: signed(checkpoint.archive({"identity": Bomb()})), "not a readable archive"),
        (lambda _: signed(checkpoint.archive({"identity": 5, "state": {}})), "it has no identity"),
    ],
)
def test_damaged_checkpoint_is_not_continued(
    interrupted, completes, caplog, tmp_path, monkeypatch, damage, message
):
    monkeypatch.chdir(tmp_path)
    path = interrupted.directory / "checkpoint.pt"
    path.write_bytes(content := damage(path.read_bytes()))
    assert completes(interrupted.config, interrupted.directory)["interruptions"] == []
    assert f"starting afresh: {path}: {message}" in caplog.text
    assert (path.parent / "_aside1" / "checkpoint.pt").read_bytes() == content
    assert not Path("executed").exists()


def test_another_unfinished_run_is_not_lost(interrupted, run_config, monkeypatch, caplog):
    config, directory = interrupted.config, interrupted.directory
    before = content_of(directory)
    found = provenance.versions(config)
    others = [
        ({"seed": 1}, None, "config.seed was 0 and is 1"),
        ({"ppo": {"clip": 0.3}}, None, "config.ppo.clip was 0.2 and is 0.3"),
        ({}, (provenance, "versions", lambda _: found | {"torch": "9.9"}), "versions.torch was "),
        (
            {},
            (code_digest, "digest", lambda *paths: "0" * 64),
            "unfinished run of other code, in mace",
        ),
    ]
    for number, (changes, replaced, message) in enumerate(others, start=1):
        other = run_config("CartPole-v1", "mace_full", **{"episodes": 6} | changes)
        with monkeypatch.context() as patched:
            if replaced:
                patched.setattr(*replaced)
            with pytest.raises(run.RunError, match=f"holds an .*{message}.*--restart"):
                run.run(other, directory)
            assert content_of(directory) == before
            with pytest.raises(Killed):
                patched.setattr(Trainer, "ppo_update", Mock(side_effect=Killed))
                run.run(other, directory, aside="others")  # as the workflow does
        aside = directory / f"_aside{number}"
        assert message in caplog.text and content_of(aside) == before
        shutil.copytree(aside, directory, dirs_exist_ok=True)
    with pytest.raises(Killed), monkeypatch.context() as patched:
        patched.setattr(Trainer, "ppo_update", Mock(side_effect=Killed))
        run.run(config, directory, aside="all")
    assert content_of(directory) == {} and content_of(directory / "_aside5") == before
    run.run(config, directory / "_aside5")
    assert len(provenance_of(directory / "_aside5")["interruptions"]) == 1


@pytest.mark.parametrize(
    "name", [*RESULTS[:3], "checkpoint.pt", "progress.json", ".notes.tmp", ".agent.pt.1.tmp"]
)
def test_somebody_s_files_stay(run_config, tmp_path, name):
    (tmp_path / name).write_text("mine")
    before = content_of(tmp_path)
    config = run_config("CartPole-v1", "ppo", 0, episodes=2)
    for _ in range(2):
        if not name.startswith("."):
            with pytest.raises(run.RunError, match=f"{name}.*choose another folder"):
                run.run(config, tmp_path)
            assert content_of(tmp_path) == before
    run.run(config, tmp_path, aside="all")
    assert (tmp_path / ("" if name.startswith(".") else "_aside1") / name).read_text() == "mine"


class Draws(gymnasium.Env):
    observation_space, action_space = Box(-9, 9, (1,), np.float32), Discrete(2)

    def __init__(self, kind: str) -> None:
        self.kind, self.own, self.resets, self.kept = kind, np.random.default_rng(1), 0, []
        if kind.startswith("offered"):
            self.load_state_dict = lambda state: vars(self).update(resets=state["resets"])

    def state_dict(self) -> dict:
        return {"resets": np.int64(1) if self.kind == "offered badly" else self.resets}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets += 1
        self.kept += [*self.np_random.random(3 * (self.kind == "kept"))]
        return np.zeros(1, np.float32), {}

    def step(self, action):
        pays = {
            "np_random": self.np_random.random,
            "own": self.own.random,
            "random": random.random,
            "numpy": np.random.random,
            "torch": lambda: float(torch.rand(())),
            "kept": lambda: self.kept.pop() if self.kept else 0.0,
        }
        reward = pays.get(self.kind, lambda: self.resets / 100)()
        return np.full(1, reward, np.float32), reward, False, False, {}


class Offers(gymnasium.Wrapper):
    """Has what its environment remembers beside its generator."""

    def state_dict(self) -> dict:
        return {"resets": self.env.resets}

    def load_state_dict(self, state: dict) -> None:
        self.env.resets = state["resets"]


def seed_all(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


@pytest.mark.parametrize(
    ("kind", "saved"),
    [
        *((kind, True) for kind in ("np_random", "random", "numpy", "torch", "offered", "wrapper")),
        *((kind, False) for kind in ("own", "kept", "counter")),
        *((name, True) for name in ("BarrenRegion-v0", "Pendulum-v1", "AntBulletEnv-v0")),
        ("HumanoidFlagrunHarderBulletEnv-v0", False),
    ],
)
def test_what_else_an_environment_draws_from_is_saved_or_noticed(
    run_config, register, tmp_path, kill, checkpoint_every, caplog, kind, saved
):
    draws = (lambda **given: Offers(Draws(**given))) if kind == "wrapper" else Draws
    name = kind if "-v" in kind else register("Draws-v0", draws, 5, kind=kind)
    config = run_config(name, "ppo", 0, episodes=23, max_episode_steps=60 if "-v" in kind else 5)
    checkpoint_every(1)
    for folder in ("killed", "whole"):
        seed_all(1)
        if folder == "killed":
            kill(22, config, tmp_path / folder)
            seed_all(2)  # another process
        run.run(config, tmp_path / folder)
    (interruption,) = provenance_of(tmp_path / "killed")["interruptions"]
    assert interruption["environment_replayed"] == saved
    assert (f"{name} plays its last episodes otherwise" in caplog.text) == (not saved)
    one, other = ((tmp_path / name / "episodes.csv").read_bytes() for name in ("killed", "whole"))
    assert one == other or not saved


def test_a_state_that_would_not_be_read_again_is_named(run_config, register, tmp_path):
    name = register("Draws-v0", Draws, 5, kind="offered badly")
    message = r"state.environment.remembered.own.resets is np.int64\(1\), but should be a tensor"
    (tmp_path / "run.json").touch()
    with pytest.raises(checkpoint.CheckpointError, match=message):
        run.run(run_config(name, "ppo", 0, episodes=2), tmp_path, aside="all")
    assert (tmp_path / "run.json").exists()  # nothing was moved


@pytest.mark.parametrize("said", ["often", "-1", "nan", ""])
def test_a_time_between_checkpoints_that_cannot_be(
    trained, run_config, tmp_path, monkeypatch, said
):
    refusal = f"MACE_RL_CHECKPOINT_SECONDS is {said!r}, but should be a number of seconds"
    shutil.copytree(trained("CartPole-v1", "ppo", episodes=2), tmp_path / "run")
    monkeypatch.setenv("MACE_RL_CHECKPOINT_SECONDS", said)
    before = content_of(tmp_path / "run")
    with pytest.raises(run.RunError, match=re.escape(refusal)):
        run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path / "run", aside="all")
    assert content_of(tmp_path / "run") == before  # nothing was moved


@pytest.mark.parametrize(("cost", "wait"), [(0.01, 10.0), (0.1, 10.0), (0.5, 50.0), (3.0, 300.0)])
def test_checkpoints_cost_at_most_one_percent(monkeypatch, cost, wait):
    now = [1000.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    clock = run.Clock(900.0)
    clock.checkpoint_seconds = 0.7  # before an interruption
    assert clock.elapsed() == 100 and not clock.checkpoint_due()
    now[0] += 2  # the first comes soon
    assert clock.checkpoint_due()
    now[0] += 8
    assert clock.checkpoint_due()
    with clock.saving():
        now[0] += cost
    assert clock.checkpoint_seconds == pytest.approx(0.7 + cost)
    now[0] = 1010 + wait - 0.001
    assert not clock.checkpoint_due()
    now[0] += 0.002
    assert clock.checkpoint_due()
