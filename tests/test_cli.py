"""The command `mace-rl`: mistakes are answered in one line before anything is done."""

import json
import shutil
import sys

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from mace_rl import cli
from mace_rl.hyperparameters import ConfigError
from mace_rl.study import load_study

CONFIG = yaml.safe_load(cli.CONFIG.read_text(encoding="utf-8"))


def call(monkeypatch, *words: str) -> tuple[int, str]:
    """Exit code and message of `mace-rl words`."""
    monkeypatch.setattr(sys, "argv", ["mace-rl", *words])
    try:
        cli.main()
    except SystemExit as exit_:
        return (exit_.code, "") if isinstance(exit_.code, int) else (1, str(exit_.code))
    return 0, ""


GOOD = {"--env": "CartPole-v1", "--variant": "ppo", "--seed": "0", "--episodes": "3"}

# What is changed in a good command, and what the message has to name.
MISTAKES = {
    "unknown environment": ({"--env": "CartPole-v9"}, ["'CartPole-v9'", "'CartPole-v1'"]),
    "environment with a path": ({"--env": "../CartPole-v1"}, ["'../CartPole-v1'", "letters"]),
    "empty environment": ({"--env": ""}, ["''", "letters"]),
    "environment without a time limit": ({"--env": "CliffWalking-v1"}, ["time limit"]),
    "unknown variant": ({"--variant": "mace_ful"}, ["'mace_ful'", "'mace_full'"]),
    "empty variant": ({"--variant": ""}, ["''", "variant"]),
    "negative seed": ({"--seed": "-1"}, ["-1", "0"]),
    "seed beyond 32 bits": ({"--seed": "4294967296"}, ["4294967296"]),
    "no episodes": ({"--episodes": "0"}, ["--episodes", "0", "at least 1"]),
    "negative episodes": ({"--episodes": "-7"}, ["--episodes", "-7", "at least 1"]),
    "config that is not there": ({"--config": "/nonexistent.yaml"}, ["/nonexistent.yaml"]),
    "config that is a folder": ({"--config": "/"}, ["/"]),
    "out below a file": ({"--out": f"{__file__}/run"}, ["test_cli.py"]),
}
# Mistakes in the form of the command, which argparse answers with the usage and its reason.
MALFORMED = {
    "no command": [],
    "unknown command": ["tarin"],
    "unknown option": ["train", "--environment", "CartPole-v1"],
    "abbreviated option": ["train", "--var", "ppo"],
    "nothing else": ["train"],
    "seed that is text": ["train", *sum(GOOD.items(), ()), "--out", "x", "--seed", "one"],
    "seed that is no integer": ["train", *sum(GOOD.items(), ()), "--out", "x", "--seed", "1.5"],
    "episodes that are text": ["train", *sum(GOOD.items(), ()), "--out", "x", "--episodes", "1e3"],
    "option without value": ["train", "--env"],
    "verify without folder": ["verify"],
    "evaluate without folder": ["evaluate", "--episodes", "3"],
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_gets_one_line(name, monkeypatch, tmp_path):
    change, expected = MISTAKES[name]
    options = GOOD | {"--out": str(tmp_path / "run")} | change
    code, message = call(monkeypatch, "train", *sum(options.items(), ()))
    assert code == 1
    assert message.startswith("mace-rl: ") and "\n" not in message
    for fragment in expected:
        assert fragment in message
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_command_is_refused_with_its_reason(name, monkeypatch, capsys):
    code, _ = call(monkeypatch, *MALFORMED[name])
    assert code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("mace-rl")


def leaves(section: dict, path: tuple = ()) -> list[tuple]:
    """The path of every value in nested mappings."""
    return [
        leaf
        for key, value in section.items()
        for leaf in (leaves(value, (*path, key)) if isinstance(value, dict) else [(*path, key)])
    ]


ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.integers() | st.text(max_size=3), max_size=3),
    st.dictionaries(st.text(max_size=5), st.integers(), max_size=2),
)


@settings(max_examples=300, deadline=None)
@given(path=st.sampled_from(leaves(CONFIG)), value=ANYTHING, extra=st.none() | st.text(max_size=6))
def test_anything_in_place_of_a_value_is_accepted_or_refused_in_one_line(path, value, extra):
    config = json.loads(json.dumps(CONFIG))
    section = config
    for key in path[:-1]:
        section = section[key]
    section[path[-1]] = value
    if extra is not None:
        section[extra] = value
    try:
        load_study(config, "some.yaml")
    except ConfigError as error:
        assert "\n" not in str(error) and str(error).startswith("some.yaml: ")


def test_a_run_by_hand_then_again_then_as_another(monkeypatch, tmp_path, caplog):
    caplog.set_level("INFO")
    out = tmp_path / "a run with ümlaut"
    options = sum((GOOD | {"--out": str(out)}).items(), ())
    assert call(monkeypatch, "train", *options) == (0, "")
    assert {path.name for path in out.iterdir()} == {"agent.pt", "episodes.csv", "run.json"}
    records = (out / "episodes.csv").read_bytes()
    assert call(monkeypatch, "train", *options) == (0, "")
    assert "finished" in caplog.text
    code, message = call(monkeypatch, "train", *options, "--seed", "1")
    assert code == 1 and "seed is 0, not 1" in message
    assert (out / "episodes.csv").read_bytes() == records


@pytest.fixture
def reference(monkeypatch, tmp_path):
    """A folder with one kept run."""
    folder = tmp_path / "runs/CartPole-v1/ppo/seed0"
    options = sum((GOOD | {"--out": str(folder)}).items(), ())
    assert call(monkeypatch, "train", *options) == (0, "")
    return tmp_path


def test_an_agent_plays_as_at_the_end_of_its_training(monkeypatch, tmp_path, capsys):
    """Its returns are those of a trainer that trained it here and plays on."""
    import gymnasium
    import numpy as np
    import torch

    from mace_rl.evaluate import evaluate, load_agent

    options = GOOD | {"--env": "HopperBulletEnv-v0", "--episodes": "6", "--out": str(tmp_path)}
    assert call(monkeypatch, "train", *sum(options.items(), ())) == (0, "")
    assert call(monkeypatch, "evaluate", str(tmp_path), "--episodes", "3") == (0, "")
    assert capsys.readouterr().out.startswith("3 episodes: mean return ")
    agent = load_agent(tmp_path)
    actor, mean = agent.ppo.actor, agent.ppo.standardiser.mean
    env = gymnasium.make("HopperBulletEnv-v0")
    generator = np.random.default_rng(5)
    for _ in range(2):  # the library's own environment; its first reset is thrown away
        observation, _ = env.reset(seed=5)
    observation, _ = env.reset()
    noise = generator.standard_normal((1000, 3))
    layers = [
        (torch.from_numpy(weights.copy()), torch.from_numpy(biases.copy()))
        for weights, biases in zip(actor.weights, actor.biases, strict=True)
    ]
    total = 0.0
    for step in range(1000):
        x = np.clip((observation - mean) / agent.ppo.standardiser.std, -10, 10)
        hidden = torch.from_numpy(x.astype(np.float32))
        for weights, biases in layers[:-1]:
            hidden = torch.tanh(hidden @ weights + biases)
        action = (hidden @ layers[-1][0] + layers[-1][1]).numpy()
        action = action + np.exp(actor.log_std) * noise[step]
        observation, reward, terminated, truncated, _ = env.step(
            np.clip(action, -1, 1).astype(np.float32)
        )
        total += reward
        if terminated or truncated:
            break
    assert evaluate(tmp_path, 1, 5)[0] == pytest.approx(total, rel=1e-3)
    (tmp_path / "agent.pt").write_bytes((tmp_path / "agent.pt").read_bytes()[:-7])
    code, message = call(monkeypatch, "evaluate", str(tmp_path))
    assert code == 1 and "agent.pt" in message and "cut off" in message


def test_a_kept_run_is_verified_to_the_bit(reference, monkeypatch, capsys):
    assert call(monkeypatch, "verify", str(reference)) == (0, "")
    assert capsys.readouterr().out.splitlines() == [
        "CartPole-v1 ppo seed 0: equal to the bit",
        "1 of 1 runs equal to the bit",
    ]


def test_verify_says_what_is_different(reference, monkeypatch, capsys):
    path = reference / "runs/CartPole-v1/ppo/seed0/run.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["config"]["seed"] = 1
    record["machine"]["cpu"] = "Z80"
    path.write_text(json.dumps(record), encoding="utf-8")
    code, message = call(monkeypatch, "verify", str(reference))
    assert code == 1 and "not reproduced: 0 of 1" in message
    assert "different from episode 1" in (out := capsys.readouterr().out) and "Z80" in out


@pytest.mark.parametrize(
    "damage",
    [
        lambda run: (run / "run.json").write_text("{", encoding="utf-8"),
        lambda run: (run / "run.json").write_text("{}", encoding="utf-8"),
        lambda run: (run / "episodes.csv").unlink(),
        lambda run: (run / "episodes.csv").write_bytes(
            (run / "episodes.csv").read_bytes().replace(b",1\n", b",0\n", 1)
        ),
        lambda run: shutil.rmtree(run),
    ],
)
def test_damaged_references_are_refused(damage, reference, monkeypatch):
    damage(reference / "runs/CartPole-v1/ppo/seed0")
    code, message = call(monkeypatch, "verify", str(reference))
    assert code == 1 and str(reference) in message and "\n" not in message


def test_verify_counts_agreement_by_hand():
    from mace_rl.verify import Repetition, verdict

    def run(then: float, now: float, equal: bool = False) -> Repetition:
        return Repetition("a run", equal, None if equal else 1, (then, now), 2.0, "cpu")

    assert verdict([run(1, 1, True)] * 3, 0.95) == (True, "3 of 3 runs equal to the bit")
    # Changes of -1, 1 and 0 spreads: their mean is 0. Changes of 1, 1.1 and 0.9: clearly not.
    assert verdict([run(10, 8), run(10, 12), run(5, 5)], 0.95)[0]
    assert not verdict([run(10, 12), run(10, 12.2), run(5, 6.8)], 0.95)[0]
    assert not verdict([run(10, 12), run(1, 1, True)], 0.95)[0]
