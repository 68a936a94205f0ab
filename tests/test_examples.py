"""examples/ and docs/wrappers.md: stable-baselines3's PPO trained with the curiosity reward."""

import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
from shared import ROOT

pytestmark = pytest.mark.slow
EXAMPLE = ROOT / "examples" / "sb3_ppo.py"


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLE), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_prints_a_row_for_each_seed_and_what_came_out():
    done = run("--seeds", "2", "--first-seed", "1000", "--steps", "256")
    assert done.returncode == 0, done.stderr
    rows = re.findall(r"(?m)^\| (\w+) \|(?:[^|]+\|){4}$", done.stdout)
    assert rows == ["seed", "1000", "1001", "mean"]
    assert "with curiosity minus without, last tenth: " in done.stdout


def test_help_and_mistakes(monkeypatch, capsys):
    main = runpy.run_path(str(EXAMPLE))["main"]

    def refused(*words: str) -> str:
        """What it exits with, in place of its work, or the last line that it printed."""
        monkeypatch.setattr(sys, "argv", [str(EXAMPLE), *words])
        with pytest.raises(SystemExit) as ended:
            main()
        said = "".join(capsys.readouterr())
        return ended.value.code if isinstance(ended.value.code, str) else said.splitlines()[-1]

    assert refused("--help").startswith("example: python examples/sb3_ppo.py")
    for option, value, least in (("--seeds", 0, 1), ("--steps", -5, 1), ("--first-seed", -1, 0)):
        expected = f"{option} is {value}, but should be at least {least}"
        assert refused(option, str(value)).endswith(expected)
    for name in ("Foo", "CartPole-v9", "nope:Foo-v0"):
        line = refused("--environment", name)
        assert line.startswith(f"sb3_ppo: --environment {name!r} cannot be made: ")
        assert "\n" not in line
    few = refused("--environment", "Acrobot-v1", "--steps", "1", "--seeds", "1")
    assert few == "sb3_ppo: no episode ended in --steps 1: give more"


def test_curiosity_changes_the_policy_and_not_what_is_counted():
    train = runpy.run_path(str(EXAMPLE))["train"]
    without, with_curiosity = (train("DeepSea10-v0", curious, 1000, 1536) for curious in (0, 1))
    own = {*np.round(-0.001 * np.arange(11), 6), 0.99}  # Deep Sea's own returns, without a bonus
    for returns in (without, with_curiosity):
        assert len(returns) >= 153 and set(np.round(returns, 6)) <= own
    assert (without[:25] == with_curiosity[:25]).all()  # until the first update, after 256 steps
    assert (without != with_curiosity).any()


def test_what_the_page_shows_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "wrappers.md").read_text(encoding="utf-8")
    assert text.count("learn(10_000)") == 1
    text = text.replace("learn(10_000)", "learn(1)")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    names = {}
    for block in blocks:
        exec(block, names)
        env = names["env"]
        assert len(env.tracker.curiosity.memory) > 0  # the restored one's, too
    names["shared"].reset()
    assert names["shared"].step(np.arange(4))[1].shape == (4,)
    names["agent"].learn(1)
