"""The command `mace-rl`: mistakes are answered in one line before anything is done."""

import functools
import json
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
from types import ModuleType

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shared import GOOD, RESULTS, Bonanza, call, files, refusal

from mace_rl import __main__, cli
from mace_rl.config.reading import DEFAULTS
from mace_rl.config.section import ConfigError
from mace_rl.runs import run
from mace_study.config.study import load_study

CONFIG = yaml.safe_load(DEFAULTS.read_text(encoding="utf-8"))

# What is changed in a good command, and what is said.
MISTAKES = [
    ({"--variant": "beta_0.4"}, "'beta_0.4'.*--config FILE"),  # of a further study
    ({"--seed": "4294967296"}, "4294967296"),
    ({"--episodes": "0"}, "--episodes.* 0.*at least 1"),
    ({"--max-episode-steps": "0"}, "--max-episode-steps.* 0.*at least 1"),
    ({"--config": "/nonexistent.yaml"}, "/nonexistent.yaml"),
    ({"--config": "/"}, "/"),
    ({"--out": f"{__file__}/run"}, "test_cli.py"),
]
# Mistakes in the form of the command, which argparse answers with the usage and its reason.
MALFORMED = [
    [],
    ["tarin"],
    ["train", "--env", "CartPole-v1", "--var", "ppo", "--episodes", "0"],
    ["train", *sum(GOOD.items(), ()), "--out", "x", "--seed", "1.5"],
    ["train", *sum(GOOD.items(), ()), "--out", "x", "--engine", "jax"],
    ["verify"],
    ["status"],
]


def refused(monkeypatch, options: dict[str, str], pattern: str) -> None:
    said = refusal(monkeypatch, "train", *sum(options.items(), ()))
    assert re.search(f"^mace-rl: .*{pattern}", said)


@pytest.mark.parametrize(("change", "pattern"), MISTAKES)
def test_a_mistake_gets_one_line(monkeypatch, tmp_path, change, pattern):
    refused(monkeypatch, GOOD | {"--out": str(tmp_path / "run")} | change, pattern)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("words", MALFORMED, ids=" ".join)
def test_a_malformed_command_is_refused_with_its_reason(words, monkeypatch, capsys):
    code, _ = call(monkeypatch, *words)
    assert code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("mace-rl")


@pytest.mark.slow
def test_the_examples_in_the_help_texts_work(monkeypatch, tmp_path, caplog, capsys):
    caplog.set_level("INFO")
    monkeypatch.chdir(tmp_path)
    kept = tmp_path / "reference/runs/CartPole-v1/mace_full/seed0"
    kept.parent.mkdir(parents=True)
    kept.symlink_to(tmp_path / "cartpole_run")  # what the first example makes
    plan = tmp_path / "results" / "reduced" / "logs" / "plan.json"  # what the workflow makes
    plan.parent.mkdir(parents=True)
    plan.write_text('{"cores": 2, "runs": []}')
    (action,) = [a for a in cli.parser()._actions if isinstance(a.choices, dict)]
    for name, parser in {"": cli.parser(), **action.choices}.items():
        word, program, *words = shlex.split(parser.epilog)
        assert (word, program, words[0]) == ("example:", "mace-rl", name or "train")
        assert call(monkeypatch, *words) == (0, ""), words
    assert (tmp_path / "cartpole_run/episodes.csv").exists()
    assert list((tmp_path / "events").iterdir()) and (tmp_path / "cartpole.gif").exists()
    assert "20 episodes: mean return" in (said := capsys.readouterr().out)
    assert "1 of 1 runs equal to the bit" in said


def leaves(section: dict, path: tuple = ()) -> list[tuple]:
    found = []
    for key, value in section.items():
        place = (*path, key)
        found += leaves(value, place) if isinstance(value, dict) else [place]
    return found


ANYTHING = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
ANYTHING |= st.lists(st.integers() | st.text(max_size=3), max_size=3)
ANYTHING |= st.dictionaries(st.text(max_size=5), st.integers(), max_size=2)


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


def test_a_run_by_hand_then_as_another_then_again(monkeypatch, tmp_path, caplog):
    caplog.set_level("INFO")
    out = tmp_path / "a run with ümlaut"
    options = GOOD | {"--out": str(out)}
    assert call(monkeypatch, "train", *sum(options.items(), ())) == (0, "")
    assert files(out) == sorted([*RESULTS, "checkpoint.pt"])
    whole = {path.name: path.read_bytes() for path in out.iterdir()}
    caplog.clear()
    steps = tmp_path / "steps.yaml"
    steps.write_text("environment_settings: {CartPole-v1: {max_episode_steps: 9}}")
    for option, value, difference in (
        ("--seed", "1", "config.seed was 0 and is 1"),
        ("--engine", "torch", "config.engine was 'compiled' and is 'torch'"),
        ("--config", str(steps), "config.max_episode_steps was None and is 9"),
    ):
        way_out = "choose another folder, or set this run aside: --restart"
        refused(monkeypatch, options | {option: value}, f"{out}.*{difference}.*{way_out}")
    assert not caplog.text  # neither trained nor called finished
    assert call(monkeypatch, "train", *sum(options.items(), ())) == (0, "")
    assert "finished" in caplog.text
    assert {path.name: path.read_bytes() for path in out.iterdir()} == whole


def test_an_exception_of_an_environment_says_when_it_was(register, run_config, tmp_path):
    name = register("Bonanza-v0", Bonanza, 5, where="reward", value="text")  # 1 + "text"
    with pytest.raises(TypeError) as caught:
        run.run(run_config(name, "ppo", 3, episodes=9), tmp_path)
    notes = ["in step 3 of an episode of Bonanza-v0", "in Bonanza-v0 ppo seed 3, episode 4"]
    assert caught.value.__notes__ == notes


UNFIT = {  # an option's value, and what would be right
    ("watch", "--out", "a.mp4"): "'a.mp4', but should end in .gif",
    ("watch", "--seconds", "nan"): "nan, but should be greater than 0",
    ("watch", "--width", "2001"): "2001, but should be from 50 to 2000",
    ("evaluate", "--episodes", "-3"): "-3, but should be at least 1",
    ("evaluate", "--seed", "-1"): "-1, but should be from 0 to 4294967295",
    ("watch", "--seed", "4294967296"): "4294967296, but should be from 0 to 4294967295",
    ("verify", "--sample", "0"): "0, but should be at least 1",
}


@pytest.mark.parametrize("command", UNFIT, ids=" ".join)
def test_a_mistaken_value_of_an_option_is_named_alone(monkeypatch, tmp_path, command):
    name, option, value = command
    expected = f"mace-rl: {option} is {UNFIT[command]}"
    assert call(monkeypatch, name, str(tmp_path), option, value) == (1, expected)


def test_an_empty_path_is_refused(monkeypatch, capsys):
    assert call(monkeypatch, "train", "--out", "", *sum(GOOD.items(), ()))[0] == 2
    assert "argument --out: it is empty" in capsys.readouterr().err


@pytest.mark.parametrize("error, said", [(MemoryError, "out of memory"), (OSError, "OSError()")])
def test_an_error_without_words_is_said(monkeypatch, error, said):
    def failing(_) -> None:
        raise error

    monkeypatch.setattr(cli, "train", failing)
    assert call(monkeypatch, "train", *sum(GOOD.items(), ())) == (1, f"mace-rl: {said}")


def test_an_interrupt_during_imports_is_quiet(monkeypatch):
    class Module(ModuleType):
        def __getattr__(self, name: str):
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "mace_rl.cli", Module("mace_rl.cli"))
    with pytest.raises(SystemExit) as caught:
        __main__.main()
    assert caught.value.code == 130


def test_an_interrupted_training_says_that_it_resumes(monkeypatch, caplog):
    def interrupted(_) -> None:
        raise KeyboardInterrupt

    caplog.set_level("INFO")
    monkeypatch.setattr(cli, "train", interrupted)
    assert call(monkeypatch, "train", "--out", "x", *sum(GOOD.items(), ())) == (130, "")
    assert caplog.messages == ["interrupted; the same command resumes it"]


LOUD = """
import gymnasium
from shared import Bonanza
class Loud(Bonanza):
    def step(self, action):
        print("β" * 9999)  # in letters that the terminal may lack, and at once
        return super().step(action)
gymnasium.register("Loud-v0", Loud, max_episode_steps=5)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "shown", [">&-", "2>&-", "<&- >&- 2>&-", "2>&1 | true", ">/dev/full 2>&1", "a lost terminal"]
)
def test_nobody_has_to_watch_a_training(tmp_path, shown):
    (tmp_path / "loud.py").write_text(LOUD, encoding="utf-8")
    options = "--env loud:Loud-v0 --variant ppo --episodes 9 --out run"
    command = f"set -o pipefail; {shlex.quote(sys.executable)} -m mace_rl train {options}"
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONIOENCODING": "ascii"}
    if shown == "a lost terminal":
        command, shown = f"sleep 0.5; {command}", ""
        terminal, end = pty.openpty()
    else:
        terminal = end = os.open(os.devnull, os.O_RDWR)
    streams = dict.fromkeys(("stdin", "stdout", "stderr"), end)
    # No `trap`: Bash makes a terminal its own before it reads one, so the hang-up can come first.
    deaf = functools.partial(signal.signal, signal.SIGHUP, signal.SIG_IGN)
    settings = {"cwd": tmp_path, "env": environment, "start_new_session": True, "preexec_fn": deaf}
    with subprocess.Popen(["bash", "-c", f"{command} {shown}"], **settings, **streams) as process:
        os.close(terminal)
    kept = sorted([*RESULTS, "checkpoint.pt"])
    assert (process.returncode, files(tmp_path / "run")) == (0, kept)


@pytest.mark.slow
@pytest.mark.parametrize("shown", [">&-", ">/dev/full"])
def test_an_output_that_is_lost_has_not_succeeded(trained, shown):
    run = shlex.quote(str(trained("CartPole-v1", "ppo", episodes=3)))
    command = f"{shlex.quote(sys.executable)} -m mace_rl evaluate {run} --episodes 1 {shown}"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(["sh", "-c", command], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("mace-rl: standard output: ")


@pytest.mark.parametrize("command", [["status", "."], ["train", *sum(GOOD.items(), ())]])
def test_what_leaves_by_itself_has_not_succeeded(monkeypatch, command):
    """A module of the user's that calls `sys.exit(0)` when it is imported."""
    monkeypatch.setattr(cli, command[0], lambda _: sys.exit(0))
    code, said = call(monkeypatch, *command)
    assert code == 1 and said.endswith("ended the program: SystemExit(0)")


def test_code_that_cannot_run_uncompiled_says_so(tmp_path):
    command = [sys.executable, "-m", "mace_rl", "train", *sum(GOOD.items(), ()), "--out", "x"]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("mace-rl: NUMBA_DISABLE_JIT is set")
