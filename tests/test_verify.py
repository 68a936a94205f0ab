"""`mace-rl verify`: kept runs are trained again and compared to the bit."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from shared import call

from mace_rl.runs import verify

RUN = "runs/CartPole-v1/ppo/seed0"


@pytest.fixture
def reference(trained, tmp_path) -> Path:
    """A folder with one kept run."""
    shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / RUN)
    return tmp_path


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change what the kept run's run.json says."""
    path = folder / RUN / "run.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    change(record)
    path.write_text(json.dumps(record), encoding="utf-8")


@pytest.mark.parametrize(
    ("section", "change", "said"),
    [
        ("config", {"seed": 1}, "different from episode 1; mean return"),
        ("outputs", {"agent.pt": "0" * 64}, "different in the agent's weights only;"),
        ("versions", {"numpy": "1.0"}, "versions.numpy was '1.0' and is"),
    ],
)
def test_verify_says_what_is_different(reference, monkeypatch, capsys, section, change, said):
    rewrite(reference, lambda record: record["machine"].update(cpu="Z80"))
    if section == "versions":
        rewrite(reference, lambda record: record["config"].update(seed=1))
    rewrite(reference, lambda record: record[section].update(change))
    expected = "mace-rl: not reproduced: 0 of 1 runs equal to the bit"
    assert call(monkeypatch, "verify", str(reference)) == (1, expected)
    assert said in capsys.readouterr().out


def test_a_sample_is_as_large_as_asked_and_always_the_same(tmp_path, monkeypatch):
    folders = [tmp_path / f"runs/CartPole-v1/ppo/seed{seed}" for seed in range(10, 20)]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "run.json").touch()

    def drawn(sample: int | None) -> list[str]:
        return [*verify.verify(tmp_path, sample)][:-1]

    monkeypatch.setattr(verify, "repeat", lambda folder, trust: (True, str(folder)))
    assert drawn(None) == drawn(99) == [*map(str, folders)]
    assert drawn(3) == drawn(3) == sorted({*drawn(3)} & {*drawn(None)}) and len(drawn(3)) == 3


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
    damage(reference / RUN)
    code, message = call(monkeypatch, "verify", str(reference))
    assert code == 1 and str(reference) in message and "\n" not in message
