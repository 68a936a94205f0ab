"""PureJaxRL in the benchmark, without it: its set-up, its settings, how it is timed."""

import re
import subprocess
import sys
from dataclasses import replace

import pandas as pd
import pytest

from benchmarks import purejaxrl, speed, tables
from benchmarks.settings import FULL, QUICK

PYTHON_STUB = """#!/bin/sh
echo "$*" >>"{calls}"
case "$*" in
*"$BREAK"*) echo "first the noise" >&2; echo "ERROR: the cause" >&2; echo "a hint" >&2; exit 1 ;;
"-m venv "*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
esac
"""


@pytest.fixture
def peer(tmp_path, monkeypatch):
    """A folder with a repository instead of PureJaxRL's, and a Python that only pretends."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=b"]
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message", "c"], check=True)
    commit = subprocess.run([*git, "rev-parse", "HEAD"], check=True, stdout=-1, text=True).stdout
    monkeypatch.setattr(purejaxrl, "COMMIT", commit.strip())
    home, lock, stub = tmp_path / "own", tmp_path / "lock", tmp_path / "python"
    for name, value in {
        "HOME": home,
        "CLONE": home / "purejaxrl",
        "PYTHON": home / "bin" / "python",
        "LOCK": lock,
    }.items():
        monkeypatch.setattr(purejaxrl, name, value)
    lock.write_text("a==1")
    stub.write_text(PYTHON_STUB.format(calls=tmp_path / "calls"))
    stub.chmod(0o755)
    (tmp_path / "calls").touch()
    monkeypatch.setattr(sys, "executable", str(stub))
    monkeypatch.setenv("PUREJAXRL", str(tmp_path))
    monkeypatch.setenv("BREAK", "nothing")
    return tmp_path


def test_purejaxrl_gets_an_environment_of_its_own_once(peer):
    purejaxrl.set_up()
    venv, install = (peer / "calls").read_text().splitlines()
    assert venv == f"-m venv {peer / 'own'}"
    assert install.startswith("-m pip install ") and install.endswith(f" -r {peer / 'lock'}")
    assert {"--no-deps", "--require-hashes"} < set(install.split())
    assert (peer / "own" / "purejaxrl" / ".git").is_dir()
    purejaxrl.set_up()
    assert len((peer / "calls").read_text().splitlines()) == 2, "it is there"
    (peer / "lock").write_text("a==2")
    purejaxrl.set_up()
    assert len((peer / "calls").read_text().splitlines()) == 4, "made anew"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"BREAK": "pip"}, "its packages cannot be had: ERROR: the cause"),
        ({"BREAK": "venv"}, "its environment cannot be made: ERROR: the cause"),
        ({"PUREJAXRL": "/no/such folder"}, "its code cannot be had from /no/such folder"),
        ({"PATH": "/nowhere"}, "its code cannot be had from"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_without_purejaxrl_one_line_says_why_and_the_rest_goes_on(
    peer, monkeypatch, capsys, change, reason
):
    for name, value in change.items():
        monkeypatch.setenv(name, value)
    for _ in range(2):  # what broke off is not taken for complete
        purejaxrl.measure_all(replace(QUICK, data=peer))
        began, said = capsys.readouterr().out.splitlines()
        assert began.startswith("Setting up ")
        assert said.startswith(f"PureJaxRL is left out: {reason}")
    table = tables.purejaxrl_tables(pd.read_csv(peer / "purejaxrl.csv"))
    assert table == said.replace("is left out", "was left out")


@pytest.mark.parametrize("contestant", purejaxrl.ROLLOUTS)
def test_purejaxrl_has_our_settings_and_whole_rollouts(run_config, contestant):
    for scale in (FULL, QUICK):
        for environment in purejaxrl.ENVIRONMENTS:
            steps = scale.later_steps[environment]
            given = purejaxrl.configuration(contestant, environment, steps)
            rollout = given["NUM_ENVS"] * given["NUM_STEPS"]
            assert steps % rollout == rollout % given["NUM_MINIBATCHES"] == 0
    ours, side_by_side = run_config(environment, "ppo").ppo, given["NUM_ENVS"]
    assert contestant == f"purejaxrl_{side_by_side}x{given['NUM_STEPS']}"
    assert (given["LR"], given["GAMMA"]) == (ours.actor_learning_rate, ours.discount)
    assert (given["UPDATE_EPOCHS"], given["CLIP_EPS"]) == (ours.epochs, ours.clip)
    assert (given["GAE_LAMBDA"], given["ENT_COEF"]) == (ours.gae_lambda, ours.entropy_coefficient)
    assert given["MAX_GRAD_NORM"] == ours.max_gradient_norm
    assert ours.hidden_units == [64, 64], "as PureJaxRL has them"


FAKE_JAX = """
import time
from types import SimpleNamespace

random = SimpleNamespace(PRNGKey=int)
block_until_ready = next  # nothing happens before
jit = lambda train: SimpleNamespace(lower=lambda key: SimpleNamespace(compile=lambda: train))
"""
FAKE_PPO = """
import time
from importlib import import_module

EpisodeWrapper = import_module("brax.envs.wrappers.training").EpisodeWrapper
import_module("navix")

def make_train(config):
    def train(key):  # the warm-up is slow
        end = time.process_time() + (0.3 if key > 7 else 0.01)
        while time.process_time() < end:
            pass
        yield config
    return train
"""


def test_purejaxrl_is_timed_when_it_is_compiled_and_warm(tmp_path, monkeypatch):
    from benchmarks import purejaxrl_training

    (tmp_path / "purejaxrl").mkdir()
    (tmp_path / "purejaxrl" / "ppo.py").write_text(FAKE_PPO)
    (tmp_path / "jax.py").write_text(FAKE_JAX)
    for name in purejaxrl_training.PACKAGES.split():
        folder = tmp_path / f"{name}-1.2.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(purejaxrl, "PYTHON", sys.executable)
    monkeypatch.setattr(purejaxrl, "CLONE", tmp_path)
    reading = purejaxrl.train({"TOTAL_TIMESTEPS": 100}, seed=7)
    assert reading["steps"] == reading["target_steps"] == 100
    assert 0.01 <= reading["cpu_seconds"] < 0.2
    assert reading["steps_per_second"] == 100 / reading["seconds"]
    assert reading["versions"].startswith("jax 1.2, jaxlib 1.2, ")
    assert reading.keys() - {"versions"} == speed.read_clock(iter([1]), [1])[0].keys()


def test_purejaxrl_s_lock_pins_what_it_needs_with_hashes():
    lock = purejaxrl.LOCK.read_text(encoding="utf-8")
    pins = re.findall(r"^(\S+==\S+)(?: \\\n    --hash=sha256:[0-9a-f]{64})+$", lock, re.MULTILINE)
    assert len(pins) == lock.count("==")
    asked = purejaxrl.LOCK.with_suffix(".in").read_text(encoding="utf-8")
    assert set(re.findall(r"^\w+==[\w.]+", asked, re.MULTILINE)) <= set(pins)
    assert not re.search(r"//|--index|--find", lock), "no address"
