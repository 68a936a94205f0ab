"""The examples of docs/extending.md, run from an empty folder as they stand there."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mace_rl.config.study import read_study
from mace_rl.results.metrics import LearningCurve, all_metrics
from mace_rl.results.records import read_episodes

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = {
    body.splitlines()[0].removeprefix("# "): body
    for body in re.findall(r"```(?:python|yaml)\n(.*?)```", TEXT, re.DOTALL)
}
TRAININGS = re.findall(r"^mace-rl (train .*)$", TEXT, re.MULTILINE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder with the examples' files in it."""
    for name, body in FILES.items():
        (tmp_path / name).write_text(body, encoding="utf-8")
    return tmp_path


def mace_rl(folder: Path, command: str) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-m", "mace_rl.cli", *shlex.split(command)]
    return subprocess.run(arguments, cwd=folder, capture_output=True, text=True, check=False)


def test_every_example_is_one_file_and_one_entry():
    assert len(FILES) == 10 and len(TRAININGS) == 4
    assert {Path(name).suffix for name in FILES} == {".py", ".yaml"}
    assert all(f"{Path(name).stem}.yaml" in FILES for name in FILES)


@pytest.mark.slow
@pytest.mark.parametrize("command", TRAININGS, ids=lambda text: text.split()[-1])
def test_example_trains(folder, command):
    done = mace_rl(folder, command)
    assert done.returncode == 0, done.stderr
    run = folder / command.split()[-1]
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    episodes = read_episodes(run / "episodes.csv", record["config"]["episodes"])
    assert len(episodes) >= 5
    match run.name:
        case "layer_norm":
            policy = "from mace_rl.runs.agent import load_agent; print(load_agent('layer_norm'))"
            shown = subprocess.run(
                [sys.executable, "-c", policy], cwd=folder, capture_output=True, text=True
            )
            assert shown.stdout.count("LayerNorm((64,)") == 3 * 2  # policy and two critics
        case "grid_counts":
            # By hand: a first episode in which every visit is judged as if it were the first.
            assert episodes["intrinsic_return"][0] == episodes["length"][0]
            assert (episodes["intrinsic_return"][1:] < episodes["length"][1:]).all()
        case "linear_decay":
            expected = [0.4 * max(0, 1 - n / 10) for n in range(len(episodes))]
            np.testing.assert_allclose(episodes["beta"], expected)
        case "chain":
            assert (episodes["length"] <= 50).all() and episodes["extrinsic_return"].max() == 1


@pytest.mark.slow
def test_edit_of_the_user_s_file_makes_it_another_run(folder):
    command = TRAININGS[2]
    assert mace_rl(folder, command).returncode == 0
    record = folder / "linear_decay" / "run.json"
    before = json.loads(record.read_text(encoding="utf-8"))["sources"]
    file = folder / "linear_decay.py"
    file.write_text(file.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    refused = mace_rl(folder, command)
    assert refused.returncode == 1
    assert "linear_decay holds a finished run of other code, in linear_decay:" in refused.stderr
    record.unlink()
    assert mace_rl(folder, command).returncode == 0
    assert json.loads(record.read_text(encoding="utf-8"))["sources"] != before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "file", "old", "new", "message"),
    [
        ("linear_decay", "linear_decay.yaml", ": 0.4", ": 1.5", "episode 1: β is 1.5, which is"),
        (
            "grid_counts",
            "grid_counts.py",
            "1 / (1",
            "2 / (1",
            "the curiosity bonus is 2.0, which is",
        ),
    ],
)
def test_numbers_out_of_range_stop_the_run_at_once(folder, name, file, old, new, message):
    text = (folder / file).read_text(encoding="utf-8")
    assert old in text
    (folder / file).write_text(text.replace(old, new), encoding="utf-8")
    done = mace_rl(folder, next(command for command in TRAININGS if command.endswith(name)))
    assert done.returncode == 1 and message in done.stderr, done.stderr
    assert not (folder / name / "episodes.csv").exists()


def test_example_metric(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    settings = read_study([ROOT / "config.yaml", folder / "to_100.yaml"]).metrics
    *_, metric = all_metrics(settings)
    assert (metric.name, metric.label) == ("to_100", "Episodes to 100")
    for returns, expected in (
        ([0.0] * 20 + [150.0] * 20, (27, False)),  # 7 of the last 10 are 150: 105
        ([99.0] * 40, (40, True)),
    ):
        curve = LearningCurve(np.array(returns), 0.0, 0.0, settings)
        assert metric.function(curve) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("layer_norm", "layer_norm:network", "layer_norms:network", "no Python module 'layer_norm"),
        ("layer_norm", "layer_norm:network", "layer_norm:net", "has no 'net'"),
        ("layer_norm", "layer_norm:network", "network", "package.module:Name"),
        ("chain", "max_episode_steps: 50", "episodes: 20", "occurs twice"),
        ("chain", "    max_episode_steps: 50\n", "", "max_episode_steps should set one"),
        ("chain", "length: 8", "size: 8", "unexpected keyword argument 'size'"),
        ("linear_decay", "{initial: 0.4, episodes: 10}", "{start: 1}", "'start'"),
        ("grid_counts", "kind: custom", "kind: counts", "estimator and kind: custom"),
    ],
)
def test_mistakes_get_one_line(folder, name, old, new, message):
    file = folder / f"{name}.yaml"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
    done = mace_rl(folder, next(command for command in TRAININGS if command.endswith(name)))
    assert done.returncode == 1
    assert message in done.stderr and len(done.stderr.strip().splitlines()) == 1, done.stderr
