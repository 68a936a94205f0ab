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
from unittest.mock import Mock

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shared import GOOD, RESULTS, call, files, refusal

from mace_rl import __main__, cli
from mace_rl.config.reading import DEFAULTS
from mace_rl.config.section import ConfigError
from mace_study.config.study import load_study

CONFIG = yaml.safe_load(DEFAULTS.read_text(encoding="utf-8"))

TRAIN = ["train", *sum(GOOD.items(), ())]
MISTAKES = [  # a command, an option, its value, and what is said
    (TRAIN, "--variant", "beta_0.4", "'beta_0.4'.*--config FILE"),  # of a further study
    (TRAIN, "--seed", "4294967296", "4294967296"),
    (TRAIN, "--max-episode-steps", "0", "--max-episode-steps.* 0.*at least 1"),
    (TRAIN, "--config", "/nonexistent.yaml", "/nonexistent.yaml"),
    (TRAIN, "--out", f"{__file__}/run", "test_cli.py"),
    (["watch", "."], "--out", "a.mp4", "--out is 'a.mp4', but should end in .gif"),
    (["watch", "."], "--seconds", "nan", "--seconds is nan, but should be greater than 0"),
    (["watch", "."], "--width", "2001", "--width is 2001, but should be from 50 to 2000"),
    (["evaluate", "."], "--episodes", "-3", "--episodes is -3, but should be at least 1"),
    (["evaluate", "."], "--seed", "-1", "--seed is -1, but should be from 0 to 4294967295"),
    (["verify", "."], "--sample", "0", "--sample is 0, but should be at least 1"),
]
# Mistakes in the form of the command, which argparse answers with the usage and its reason.
MALFORMED = [
    [],
    ["tarin"],
    ["train", "--env", "CartPole-v1", "--var", "ppo", "--episodes", "0"],
    [*TRAIN, "--out", "x", "--seed", "1.5"],
    [*TRAIN, "--out", "x", "--engine", "jax"],
    [*TRAIN, "--out", ""],
    ["status"],
]


@pytest.mark.parametrize(("command", "option", "value", "pattern"), MISTAKES)
def test_a_mistaken_value_of_an_option_is_named(
    monkeypatch, tmp_path, command, option, value, pattern
):
    monkeypatch.chdir(tmp_path)
    assert re.search(f"^mace-rl: .*{pattern}", refusal(monkeypatch, *command, option, value))
    assert not [*tmp_path.iterdir()]


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
    command = [*TRAIN, "--out", str(out)]
    assert call(monkeypatch, *command) == (0, "")
    assert files(out) == sorted([*RESULTS, "checkpoint.pt"])
    whole = {path.name: path.read_bytes() for path in out.iterdir()}
    caplog.clear()
    said = refusal(monkeypatch, *command, "--engine", "torch")
    assert f"{out}" in said and "config.engine was 'compiled' and is 'torch'" in said
    assert "--restart" in said and not caplog.text  # neither trained nor called finished
    assert call(monkeypatch, *command) == (0, "")
    assert "finished" in caplog.text
    assert {path.name: path.read_bytes() for path in out.iterdir()} == whole


@pytest.mark.parametrize("command", [["status", "."], [*TRAIN, "--out", "x"]])
@pytest.mark.parametrize(
    ("raised", "code", "said"),
    [
        (MemoryError, 1, "mace-rl: out of memory"),
        (OSError, 1, "mace-rl: OSError()"),  # an error without words
        (SystemExit(0), 1, "ended the program: SystemExit(0)"),  # by a module of the user's
        (KeyboardInterrupt, 130, ""),
    ],
)
def test_whatever_ends_a_command_is_said(monkeypatch, caplog, command, raised, code, said):
    caplog.set_level("INFO")
    monkeypatch.setattr(cli, command[0], Mock(side_effect=raised))
    found = call(monkeypatch, *command)
    assert found[0] == code and found[1].endswith(said)
    resumes = "; the same command resumes it" if command[0] == "train" else ""
    assert caplog.messages == [f"interrupted{resumes}"] * (code == 130)


def test_an_interrupt_during_imports_is_quiet(monkeypatch):
    class Module(ModuleType):
        def __getattr__(self, name: str):
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "mace_rl.cli", Module("mace_rl.cli"))
    with pytest.raises(SystemExit) as caught:
        __main__.main()
    assert caught.value.code == 130


LOUD = """
import gymnasium
from gymnasium.envs.classic_control import MountainCarEnv
step = MountainCarEnv.step
def loud(*given):
    print("β" * 9999)  # in letters that the terminal may lack, and at once
    return step(*given)
MountainCarEnv.step = loud
entry = "gymnasium.envs.classic_control:MountainCarEnv"  # by name: torch is not imported
gymnasium.register("Loud-v0", entry, max_episode_steps=5)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "shown", [">&-", "<&- >&- 2>&-", "2>&1 | true", ">/dev/full 2>&1", "a lost terminal"]
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


def test_code_that_cannot_run_uncompiled_says_so(tmp_path):
    command = [sys.executable, "-m", "mace_rl", *TRAIN, "--out", "x"]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("mace-rl: NUMBA_DISABLE_JIT is set")
