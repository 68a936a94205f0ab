"""The command `mace-rl`: mistakes are answered in one line before anything is done."""

import argparse
import json
import shlex

import gymnasium
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shared import GOOD, call, files
from snakemake.utils import update_config

from mace_rl import cli
from mace_rl.config.reading import DEFAULTS
from mace_rl.config.section import ConfigError
from mace_rl.config.study import load_study
from mace_rl.runs import run

CONFIG = yaml.safe_load(DEFAULTS.read_text(encoding="utf-8"))

# What is changed in a good command, and what the message has to name.
MISTAKES = {
    "unknown environment": ({"--env": "CartPole-v9"}, ["'CartPole-v9'", "'CartPole-v1'"]),
    "environment with a path": ({"--env": "../CartPole-v1"}, ["'../CartPole-v1'", "letters"]),
    "environment without a time limit": ({"--env": "CliffWalking-v1"}, ["time limit"]),
    "unknown variant": ({"--variant": "mace_ful"}, ["'mace_ful'", "'mace_full'"]),
    "variant of a further study": ({"--variant": "beta_0.4"}, ["'beta_0.4'", "--config FILE"]),
    "seed beyond 32 bits": ({"--seed": "4294967296"}, ["4294967296"]),
    "no episodes": ({"--episodes": "0"}, ["--episodes", "0", "at least 1"]),
    "no steps": ({"--max-episode-steps": "0"}, ["--max-episode-steps", "0", "at least 1"]),
    "config that is not there": ({"--config": "/nonexistent.yaml"}, ["/nonexistent.yaml"]),
    "config that is a folder": ({"--config": "/"}, ["/"]),
    "out below a file": ({"--out": f"{__file__}/run"}, ["test_cli.py"]),
}
# What an overlay's settings for FrozenLake-v1 make wrong, noticed when the run is to begin.
MISFITS = {
    "unknown argument": ("environment_arguments: {slippery: false}", ["FrozenLake-v1", "slippery"]),
    "argument's value": ("environment_arguments: {map_name: 9x9}", ["FrozenLake-v1", "9x9"]),
    "network's outputs": (
        "ppo: {network: {kind: torch, module: 'test_network:headless'}}",
        ["ppo.network.module", "headless", "(2, 64)", "(2, 4)"],
    ),
    "code that is not there": (
        "ppo: {network: {kind: torch, module: 'shared:nothing'}}",
        ["ppo.network.module", "'shared:nothing'", "'nothing'"],
    ),
}
# Mistakes in the form of the command, which argparse answers with the usage and its reason.
MALFORMED = [
    [],
    ["tarin"],
    ["train", "--var", "ppo"],
    ["train", *sum(GOOD.items(), ()), "--out", "x", "--seed", "1.5"],
    ["train", *sum(GOOD.items(), ()), "--out", "x", "--config"],
    ["train", *sum(GOOD.items(), ()), "--out", "x", "--engine", "jax"],
    ["verify"],
    ["status"],
]


def refused(monkeypatch, options: dict[str, str], expected: list[str]) -> None:
    code, message = call(monkeypatch, "train", *sum(options.items(), ()))
    assert code == 1
    assert message.startswith("mace-rl: ") and "\n" not in message
    for fragment in expected:
        assert fragment in message


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_gets_one_line(name, monkeypatch, tmp_path):
    change, expected = MISTAKES[name]
    refused(monkeypatch, GOOD | {"--out": str(tmp_path / "run")} | change, expected)
    assert not (tmp_path / "run").exists()


def overlay(folder, environment: str, settings: str) -> str:
    """A file with settings, in YAML, of one environment."""
    path = folder / "overlay.yaml"
    path.write_text(f"environment_settings: {{{environment}: {{{settings}}}}}", encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", MISFITS)
def test_settings_that_do_not_fit_the_environment_get_one_line(name, monkeypatch, tmp_path):
    settings, expected = MISFITS[name]
    config = overlay(tmp_path, "FrozenLake-v1", settings)
    change = {"--env": "FrozenLake-v1", "--config": config, "--out": str(tmp_path / "run")}
    refused(monkeypatch, GOOD | change, expected)


@pytest.mark.parametrize("order", [("planted", "questions"), ("questions", "planted")])
def test_runs_of_combined_studies_are_those_of_the_workflow(order):
    """As Snakemake's own function reads the files over each other."""
    paths = [DEFAULTS.parent / "config" / f"{name}.yaml" for name in order]
    merged = json.loads(json.dumps(CONFIG))
    for path in paths:
        update_config(merged, yaml.safe_load(path.read_text(encoding="utf-8")))
    expected = load_study(merged, "some.yaml").run_config("DeepSea10-v0", "beta_0.4", 0)
    options = {"--env": "DeepSea10-v0", "--variant": "beta_0.4"}
    assert config_of(*paths, **options) == expected.model_copy(update={"episodes": 3})


def config_of(*paths, **changes: str):
    """The run that `mace-rl train` is asked for with these files, of which the last wins."""
    options = sum((GOOD | {"--out": "x"} | changes).items(), ())
    words = ["--config", str(paths[0]), "--config", *map(str, paths[1:])]
    return cli.run_config(cli.parser().parse_args(["train", *options, *words]))


@pytest.mark.parametrize("words", MALFORMED, ids=" ".join)
def test_a_malformed_command_is_refused_with_its_reason(words, monkeypatch, capsys):
    code, _ = call(monkeypatch, *words)
    assert code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("mace-rl")


def subcommands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each subcommand."""
    (action,) = [a for a in cli.parser()._actions if isinstance(a.choices, dict)]
    return action.choices


@pytest.mark.slow
def test_the_examples_in_the_help_texts_work(monkeypatch, tmp_path, caplog, capsys):
    """In the order of the help, each beginning where the one before ended."""
    caplog.set_level("INFO")
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "reference/runs/CartPole-v1/mace_full/seed0"
    kept.parent.mkdir(parents=True)
    kept.symlink_to(tmp_path / "cartpole_run")  # what the first example makes
    plan = tmp_path / "results" / "reduced" / "logs" / "plan.json"  # what the workflow makes
    plan.parent.mkdir(parents=True)
    plan.write_text('{"cores": 2, "runs": []}')
    for name, parser in {"": cli.parser(), **subcommands()}.items():
        word, program, *words = shlex.split(parser.epilog)
        assert (word, program, words[0]) == ("example:", "mace-rl", name or "train")
        assert call(monkeypatch, *words) == (0, ""), words
    assert (tmp_path / "cartpole_run/episodes.csv").exists()
    assert list((tmp_path / "events").iterdir()) and (tmp_path / "cartpole.gif").exists()
    assert "20 episodes: mean return" in (said := capsys.readouterr().out)
    assert "1 of 1 runs equal to the bit" in said


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


@settings(max_examples=300, deadline=None, derandomize=True)
@given(path=st.sampled_from(leaves(CONFIG)), value=ANYTHING, extra=st.none() | st.text(max_size=6))
@example(path=("variant_settings", "ppo", "beta", "kind"), value="\n", extra=None)
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
    results = {"agent.pt", "diagnostics.csv", "episodes.csv", "run.json"}
    assert set(files(out)) == results
    records = (out / "episodes.csv").read_bytes()
    assert call(monkeypatch, "train", *options) == (0, "")
    assert "finished" in caplog.text
    limited = overlay(tmp_path, "CartPole-v1", "max_episode_steps: 9")
    for change, difference in {
        ("--seed", "1"): "config.seed was 0 and is 1",
        ("--engine", "torch"): "config.engine was 'compiled' and is 'torch'",
        ("--config", limited): "config.max_episode_steps was None and is 9",
    }.items():
        code, message = call(monkeypatch, "train", *options, *change)
        assert code == 1 and difference in message
    assert (out / "episodes.csv").read_bytes() == records


OTHERS = {  # what is changed in run.json, and what the message has to name
    "sources": ("", "a finished run of other code, in mace_rl"),
    "versions": ({"numpy": "1.0"}, "a finished run where versions.numpy was '1.0' and is '"),
}


def test_results_that_are_damaged_or_of_other_code_are_not_this_run(monkeypatch, tmp_path, caplog):
    caplog.set_level("INFO")
    words = ["train", *sum((GOOD | {"--out": str(tmp_path)}).items(), ())]
    assert call(monkeypatch, *words) == (0, "")
    whole = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    caplog.clear()

    def refused(name: str, content: bytes | None, *expected: str) -> None:
        (tmp_path / name).unlink()
        if content is not None:
            (tmp_path / name).write_bytes(content)
        code, message = call(monkeypatch, *words)
        (tmp_path / name).write_bytes(whole[name])
        assert code == 1 and "\n" not in message and str(tmp_path) in message
        for fragment in (*expected, "choose another folder, or remove this one"):
            assert fragment in message

    for name in ("episodes.csv", "diagnostics.csv", "agent.pt"):
        refused(name, whole[name][:-1], name, "cut off")
        refused(name, None, name, "missing")
    record = json.loads(whole["run.json"])
    for key, (other, expected) in OTHERS.items():
        changed = record[key] | other if isinstance(other, dict) else other
        refused("run.json", json.dumps(record | {key: changed}).encode(), expected)
    assert not caplog.text  # neither trained nor called finished
    assert call(monkeypatch, *words) == (0, "") and "finished" in caplog.text
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == whole


class Breaks(gymnasium.Wrapper):
    """CartPole whose seventh step raises, in the second episode."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("CartPole-v1").unwrapped)
        self.resets = self.steps = 0

    def reset(self, **options):
        self.resets, self.steps = self.resets + 1, 0  # one more than there are episodes
        return self.env.reset(**options)

    def step(self, action):
        self.steps += 1
        observation, reward, *_, info = self.env.step(action)
        if (self.resets, self.steps) == (3, 7):
            raise ZeroDivisionError("a mistake of its own")
        return observation, reward, False, self.steps == 8, info


def test_an_exception_of_an_environment_says_when_it_was(register, run_config, tmp_path):
    config = run_config(register("Breaks-v0", Breaks), "ppo", 3, episodes=4)
    with pytest.raises(ZeroDivisionError, match="a mistake of its own") as caught:
        run.run(config, tmp_path)
    assert caught.value.__notes__ == [
        "in step 7 of an episode of Breaks-v0",
        "in Breaks-v0 ppo seed 3, episode 2",
    ]


UNFIT = {  # an option's value, and what would be right
    ("watch", "--out", "a.mp4"): "'a.mp4', but should end in .gif",
    ("watch", "--seconds", "nan"): "nan, but should be greater than 0",
    ("watch", "--width", "2001"): "2001, but should be from 50 to 2000",
    ("evaluate", "--episodes", "-3"): "-3, but should be at least 1",
    ("evaluate", "--seed", "-1"): "-1, but should be at least 0",
    ("verify", "--sample", "0"): "0, but should be at least 1",
}


@pytest.mark.parametrize("command", UNFIT, ids=" ".join)
def test_a_mistaken_value_of_an_option_is_named_alone(monkeypatch, tmp_path, command):
    name, option, value = command
    expected = f"mace-rl: {option} is {UNFIT[command]}"
    assert call(monkeypatch, name, str(tmp_path), option, value) == (1, expected)


def test_an_interrupted_training_says_that_it_resumes(monkeypatch, caplog):
    def interrupted(_) -> None:
        raise KeyboardInterrupt

    caplog.set_level("INFO")
    monkeypatch.setattr(cli, "train", interrupted)
    assert call(monkeypatch, "train", "--out", "x", *sum(GOOD.items(), ())) == (130, "")
    assert caplog.messages == ["interrupted; the same command resumes it"]
