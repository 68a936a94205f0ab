"""The five names of `mace_rl`, in somebody's own program."""

import csv
import datetime
import json
import math
import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import gymnasium
import numba
import numpy as np
import pytest
from shared import OUTCOME, ROOT, Bonanza, call, refused

from mace_rl import load_agent, settings, train
from mace_rl.base.errors import Refusal
from mace_rl.config.reading import DEFAULTS
from mace_rl.config.section import ConfigError
from mace_rl.numerics import compiling
from mace_rl.runs import provenance
from mace_rl.runs.evaluate import evaluate

HEAVY = ["snakemake", "pybullet", "pybullet_envs_gymnasium", "pandas", "matplotlib", "seaborn"]


def told(code: str) -> list:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_importing_loads_little_and_changes_nothing():
    loaded, changed, cache = told(
        "import json, os, sys; before = dict(os.environ); import mace_rl.wrapping.wrappers, numba; "
        "print(json.dumps([list(sys.modules), before != os.environ, numba.config.CACHE_DIR]))"
    )
    assert not {*HEAVY} & {*loaded} and not changed
    assert cache == os.environ.get("NUMBA_CACHE_DIR", "")
    bare = told("import json, sys, mace_rl; print(json.dumps(list(sys.modules)))")
    assert not {"numpy", "torch", "numba", "gymnasium"} & {*bare}


@pytest.mark.slow
@pytest.mark.parametrize("module", ["mace_rl.cli", "tools"])
def test_the_commands_pin_what_numpy_and_torch_compute_with(module):
    numpy_has, torch_has = told(
        f"import {module}, json, torch; from numpy._core._multiarray_umath import __cpu_features__;"
        "print(json.dumps([__cpu_features__, torch.backends.cpu.get_cpu_capability()]))"
    )
    assert numpy_has["AVX2"] and not numpy_has["AVX512_SKX"] and torch_has == "AVX2"


def test_settings_are_the_study_s_but_for_what_is_given(run_config, tmp_path):
    assert DEFAULTS == ROOT / "config.yaml"  # not a copy, which edits would not reach
    files = [tmp_path / "own.yaml", tmp_path / "over.yaml"]
    files[0].write_text("variant_settings: {low: {beta: {kind: constant, value: 0.2}}}")
    files[1].write_text("variant_settings: {low: {beta: {value: 0.1}}}")
    changes = {"episodes": 7, "ppo": {"clip": 0.1}}
    found = settings("CartPole-v1", "low", seed=np.int64(3), config=files, **changes)
    expected = run_config(seed=3, variant="mace_fixed", **changes).settings()
    beta = {"kind": "constant", "value": 0.1}
    assert found.settings() == expected | {"variant": "low", "beta": beta}
    assert settings("Blackjack-v1", max_episode_steps=9).max_episode_steps == 9


OWN, MODULE = {"kind": "custom", "arguments": {"d": {1}}}, {"kind": "torch", "module": "a:B"}
DAY = datetime.date(2024, 1, 1)


def given(value: object) -> dict:
    return {"environment_arguments": {"d": value}}


MISTAKES = {
    "unknown key 'ppo.clpi'": {"ppo": {"clpi": 0.1}},
    "unknown key 'epsiodes' (value 3); the nearest known key is 'episodes'": {"epsiodes": 3},
    "environment_arguments.d is datetime.date(2024, 1, 1), but it should be made of": given(DAY),
    "environment_arguments.d is {1: 2}, but": given({1: 2}),
    "environment_arguments.d is nan, but it should be made of finite": given(math.nan),
    "surrogates not allowed": given("\ud800"),
    "beta.arguments.d is {1}": {"beta": OWN | {"rule": "a:B"}},
    "ppo.network.arguments.d is {1}": {"ppo": {"network": OWN | MODULE}},
    "in the changes: unknown key 'memory.capacty'": {"variant": "ppo", "memory": {"capacty": 3}},
    "in the changes: novelty is 5, but": {"variant": "ppo", "novelty": 5},
    "in the settings of CartPole-v1 and ppo, bonus is": {"trainer": "published"},
    "'max_episode_steps' is not for the environment's constructor": {
        "environment_arguments": {"max_episode_steps": 5}
    },
    "environment is None, but should be a name": {"environment": None},
    "variant is 3, but should be a name": {"variant": 3},
    "seed is True, but should be an integer from 0": {"seed": True},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_gets_one_line(message):
    with refused(ConfigError, re.escape(message)):
        settings(**{"environment": "CartPole-v1", "variant": "ppo"} | MISTAKES[message])


class Counting(Bonanza):
    open = 0

    def __init__(self):
        super().__init__()
        type(self).open += 1

    def close(self):
        type(self).open -= 1


def test_environments_are_closed_also_after_a_mistake(register, tmp_path):
    name = register("Counting-v0", Counting, 5)
    run = settings(name, "ppo", episodes=2)
    train(run, folder=tmp_path)
    evaluate(tmp_path, 2, seed=0, trust=True)
    with pytest.raises(ZeroDivisionError):
        train(run, lambda episode: 1 / 0)
    assert Counting.open == 0


def test_a_run_names_the_commit_that_it_began_with(monkeypatch, tmp_path):
    states = iter(["first", "second"])
    monkeypatch.setattr(provenance, "git_state", lambda: {"commit": next(states)})
    run = settings("CartPole-v1", "ppo", episodes=2)
    seen = []
    train(run, lambda _: seen or seen.append(provenance.git_state()["commit"]), tmp_path)
    code = json.loads((tmp_path / "run.json").read_text())["code"]
    assert (code, seen) == ({"commit": "first"}, ["second"])


def test_an_empty_folder_is_no_folder():
    with refused(ConfigError, "folder is empty, but should be a path, or None"):
        train(settings("CartPole-v1", "ppo", episodes=2), folder="")


def test_what_no_layer_has_is_missing_in_the_variant(tmp_path):
    (tmp_path / "own.yaml").write_text("variant_settings: {own: {label: x}}")
    with refused(ConfigError, "in variant_settings.own, the key 'beta' is missing"):
        settings("CartPole-v1", "own", config=tmp_path / "own.yaml", episodes=2)


class Text(str):
    __slots__ = ()


def test_arguments_are_what_json_gives_back(monkeypatch, tmp_path):
    """So that what is played later is what was trained, and the same call finds its run again."""
    map_ = Text("SF")  # as an enum's members are texts or numbers
    given = {"map_name": None, "desc": (map_, "FG"), "is_slippery": np.bool_(False)}
    run = settings("FrozenLake-v1", "ppo", episodes=2, environment_arguments=given)
    plain = {"map_name": None, "desc": ["SF", "FG"], "is_slippery": False}
    assert run.environment_arguments == plain
    assert [*map(type, run.environment_arguments.values())] == [type(None), list, bool]
    assert type(run.environment_arguments["desc"][0]) is str
    for _ in range(2):
        train(run, folder=tmp_path)
    found = json.loads((tmp_path / "run.json").read_text())["config"]
    assert found["environment_arguments"] == plain
    other = settings("FrozenLake-v1", "ppo", episodes=3, environment_arguments=given)
    assert len(train(other, folder=tmp_path, restart=True).episodes) == 3
    assert json.loads((tmp_path / "_aside1" / "run.json").read_text())["config"] == found


def test_train_is_the_command_and_calls_back_for_each_episode(monkeypatch, tmp_path):
    options = {"--env": "CartPole-v1", "--variant": "mace_full", "--seed": "5", "--episodes": "8"}
    command = ["train", *sum(options.items(), ()), "--out"]
    assert call(monkeypatch, *command, str(tmp_path / "command")) == (0, "")
    run, told = settings("CartPole-v1", "mace_full", seed=5, episodes=8), []
    trained = train(run, told.append, tmp_path / "own")
    for name in OUTCOME:
        one, other = ((tmp_path / folder / name).read_bytes() for folder in ("command", "own"))
        assert one == other
    with open(tmp_path / "own" / "episodes.csv", newline="", encoding="utf-8") as file:
        cells = [[*map(float, row.values())] for row in csv.DictReader(file)]
    assert [[*vars(record).values()] for record in trained.episodes] == cells and len(cells) == 8
    assert told == trained.episodes == train(run).episodes  # without a folder, too
    assert train(run, told.append, tmp_path / "own") and len(told) == 8  # is finished
    observation = [0.1, 0.0, -0.1, 0.2]
    logits = [a.policy(observation).logits for a in (trained.agent, load_agent(tmp_path / "own"))]
    assert logits[0].tolist() == logits[1].tolist()
    with pytest.raises(ConfigError, match="episodes was 8 and is 7"):
        train(settings("CartPole-v1", "mace_full", seed=5, episodes=7), folder=tmp_path / "own")
    longer = settings("CartPole-v1", "mace_full", seed=5, episodes=9)
    assert train(longer, told.append, tmp_path / "own").episodes == train(longer).episodes
    assert told[-1].episode == 9


def test_the_folder_of_an_id_with_a_namespace(register, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    cart = gymnasium.spec("CartPole-v1").entry_point
    words = ["train", "--env", register("Own/Cart-v0", cart, None), "--variant", "ppo"]
    assert call(monkeypatch, *words, "--episodes", "2", "--max-episode-steps", "5") == (0, "")
    record = json.loads(Path("runs/Own+Cart-v0/ppo/seed0/run.json").read_text())
    assert record["config"]["environment"] == "Own/Cart-v0"


def test_the_readme_s_example(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    example = next(b for b in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "train(" in b)
    assert len(example.splitlines()) <= 10 and "episodes=200" in example
    names: dict = {}
    exec(example.replace("episodes=200", "episodes=4"), names)
    assert len(names["episodes"]) == 4


def test_without_a_folder_for_caches_a_temporary_one_serves(tmp_path, monkeypatch, caplog):
    """numba runs what it finds there."""
    folders = []

    def njit(**options):
        folders.append(compiling.config.CACHE_DIR)
        if len(folders) == 1:
            raise RuntimeError("cannot cache function 'f': no locator available for file 'f.py'")
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    compiling.spare_folder.cache_clear()
    before = compiling.config.CACHE_DIR
    assert compiling.njit(cache=True)(abs) is abs
    (own,) = tmp_path.iterdir()
    assert folders[1] == str(own / compiling.FOLDER.name) and before == compiling.config.CACHE_DIR
    assert len(caplog.messages) == 1 and str(own) in caplog.text
    own.chmod(0o770)
    compiling.spare_folder.cache_clear()
    with pytest.raises(Refusal, match="is not this user's alone: let NUMBA_CACHE_DIR name"):
        compiling.spare_folder()


def test_compiled_code_need_not_be_kept(monkeypatch, tmp_path, caplog):
    """As on a full disk, here by a limit on what a file may hold."""
    monkeypatch.setattr(compiling, "FOLDER", tmp_path / "numba" / "x")
    compiling.warn_unkept.cache_clear()

    def one_more(x):
        return x + 1

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    compiled = compiling.njit(cache=True)(one_more)
    assert isinstance(compiled, numba.core.dispatcher.Dispatcher)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        assert compiled(1) == 2 and compiled(1.5) == 2.5
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [str(tmp_path / "numba") in message for message in caplog.messages] == [True]
