"""`mace-rl verify`: kept runs are trained again and compared to the bit."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shared import call

from mace_rl.runs import verify
from mace_rl.runs.verify import Repetition, _made_with, verdict

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
    ("section", "change", "message", "said"),
    [
        ("config", {"seed": 1}, "with equal arithmetic and versions all", "from episode 1"),
        ("outputs", {"agent.pt": "0" * 64}, "with equal", "different in the agent's weights only;"),
        ("versions", {"numpy": "1.0"}, "statistics cannot", "versions.numpy was '1.0' and is"),
    ],
)
def test_verify_says_what_is_different(
    reference, monkeypatch, capsys, section, change, message, said
):
    rewrite(reference, lambda record: record["machine"].update(cpu="Z80"))
    if section == "versions":
        rewrite(reference, lambda record: record["config"].update(seed=1))
    rewrite(reference, lambda record: record[section].update(change))
    code, found = call(monkeypatch, "verify", str(reference))
    assert code == 1 and "not reproduced: 0 of 1" in found and message in found
    assert said in capsys.readouterr().out


def test_a_sample_is_as_large_as_asked_and_always_the_same(tmp_path, monkeypatch):
    folders = [tmp_path / f"runs/CartPole-v1/ppo/seed{seed}" for seed in range(10, 20)]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "run.json").touch()

    def repeat(folder: Path) -> Repetition:
        return Repetition(str(folder), True, True, None, (1.0, 1.0), 2.0, "no difference")

    def drawn(sample: int | None) -> list[str]:
        return [line.split(":")[0] for line in list(verify.verify(tmp_path, sample, 0.95))[:-1]]

    monkeypatch.setattr(verify, "repeat", repeat)
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


def test_any_python_of_a_minor_version_and_nothing_else_counts_as_the_same() -> None:
    record = {"arithmetic": {"blas": "a"}, "versions": {"python": "3.11.7", "numpy": "2.4.6"}}

    def other(section: str, **values: str) -> dict[str, dict[str, str]]:
        return record | {section: record[section] | values}

    made = _made_with(record)
    assert made == _made_with(other("versions", python="3.11.13"))
    for different in (
        other("versions", python="3.12.7"),
        other("versions", numpy="2.4.7"),
        other("arithmetic", blas="b"),
    ):
        assert made != _made_with(different)


def test_verify_counts_agreement_by_hand():
    def run(change: float, **given: Any) -> Repetition:
        """A run whose mean return has changed by as many standard deviations of an episode."""
        known = Repetition("a run", False, False, 1, (10.0, 10 + 2 * change), 2.0, "cpu")
        return known._replace(**given)

    equal = run(0, equal=True, same=True)
    assert verdict([equal] * 3, 0.95) == (True, "3 of 3 runs equal to the bit")
    # By hand: of changes -a, 0, a the interval is 0 ± 4.303 · a / √3.
    for largest, expected in ((0.2, True), (0.203, False)):
        agree, said = verdict([equal, run(-largest), run(0), run(largest)], 0.95)
        assert agree is expected
        assert f"changed by +0.000 [-{4.3027 * largest / np.sqrt(3):.3f}, " in said
    for changes, expected in (
        ([0.3] * 3, True),
        ([0.6] * 3, False),
        ([-0.6] * 3, False),
        ([-1.0, -150.0], False),  # a collapse of both, however wide it makes the interval
    ):
        assert verdict([*map(run, changes)], 0.95)[0] == expected
    assert not verdict([run(0.1), equal], 0.95)[0]
    # What was made alike has to be equal, whatever the returns.
    assert not verdict([run(0), run(0), run(0, same=True)], 0.95)[0]
    assert "no unit" in verdict([run(0), run(0.1, spread=0.0)], 0.95)[1]
