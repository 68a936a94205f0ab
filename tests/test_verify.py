"""`mace-rl verify`: kept runs are trained again and compared to the bit."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shared import GOOD, call

from mace_rl.runs import verify
from mace_rl.runs.verify import NotReproducedError, Repetition, _made_with, verdict


@pytest.fixture
def reference(monkeypatch, tmp_path):
    """A folder with one kept run."""
    folder = tmp_path / "runs/CartPole-v1/ppo/seed0"
    options = sum((GOOD | {"--out": str(folder)}).items(), ())
    assert call(monkeypatch, "train", *options) == (0, "")
    return tmp_path


def test_a_kept_run_is_verified_to_the_bit(reference, monkeypatch, capsys):
    assert call(monkeypatch, "verify", str(reference)) == (0, "")
    assert capsys.readouterr().out.splitlines() == [
        "CartPole-v1 ppo seed 0: equal to the bit",
        "1 of 1 runs equal to the bit",
    ]


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change what the kept run's run.json says."""
    path = folder / "runs/CartPole-v1/ppo/seed0/run.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    change(record)
    path.write_text(json.dumps(record), encoding="utf-8")


def test_verify_says_what_is_different(reference, monkeypatch, capsys):
    rewrite(reference, lambda record: record["config"].update(seed=1))
    rewrite(reference, lambda record: record["machine"].update(cpu="Z80"))
    code, message = call(monkeypatch, "verify", str(reference))
    assert code == 1 and "not reproduced: 0 of 1" in message
    assert "with equal arithmetic and versions all of them should be" in message
    assert "different from episode 1" in (out := capsys.readouterr().out) and "Z80" in out


def test_of_another_version_a_difference_is_left_to_statistics(reference, monkeypatch, capsys):
    rewrite(reference, lambda record: record["config"].update(seed=1))
    rewrite(reference, lambda record: record["versions"].update(numpy="1.0.0"))
    code, message = call(monkeypatch, "verify", str(reference))
    assert code == 1 and "with one that differs, statistics cannot" in message
    assert "versions.numpy was '1.0.0' and is" in capsys.readouterr().out


def test_an_agent_that_differs_is_a_difference(reference, monkeypatch, capsys):
    rewrite(reference, lambda record: record["outputs"].update({"agent.pt": "0" * 64}))
    code, message = call(monkeypatch, "verify", str(reference))
    assert code == 1 and "not reproduced: 0 of 1" in message
    assert "different in the agent's weights only; " in capsys.readouterr().out


def test_a_sample_is_drawn_by_its_seed(tmp_path, monkeypatch):
    folders = [tmp_path / f"runs/CartPole-v1/ppo/seed{seed}" for seed in range(10, 20)]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "run.json").touch()
    repeated: list[Path] = []

    def repeat(folder: Path) -> Repetition:
        repeated.append(folder)
        return Repetition(folder.name, True, True, None, (1.0, 1.0), 2.0, "no difference")

    monkeypatch.setattr(verify, "repeat", repeat)
    drawn = []
    for sample, seed in ((3, 0), (3, 0), (3, 1), (3, 2), (None, 0), (99, 0)):
        lines = list(verify.verify(tmp_path, sample, seed, 0.95))
        drawn.append(repeated[:])
        assert lines[-1] == f"{len(repeated)} of {len(repeated)} runs equal to the bit"
        repeated.clear()
    assert drawn[0] == drawn[1] and drawn[4] == drawn[5] == folders
    assert len({tuple(sample) for sample in drawn[1:4]}) > 1
    for sample in drawn[:4]:
        assert len(sample) == 3 and sample == sorted(set(sample))
    assert set(drawn[1]) | set(drawn[2]) | set(drawn[3]) != set(folders[:3])
    monkeypatch.setattr(verify, "repeat", lambda folder: repeat(folder)._replace(equal=False))
    with pytest.raises(NotReproducedError, match="0 of 3 runs equal"):
        list(verify.verify(tmp_path, 3, 0, 0.95))


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
    assert verdict([run(0.3), run(0.3), run(0.3)], 0.95)[0]
    assert not verdict([run(0.6), run(0.6), run(0.6)], 0.95)[0]
    assert not verdict([run(-0.6), run(-0.6), run(-0.6)], 0.95)[0]
    # A collapse of both is far from agreement, however wide it makes the interval.
    assert not verdict([run(-1.0), run(-150.0)], 0.95)[0]
    assert not verdict([run(0.1), equal], 0.95)[0]
    # What was made alike has to be equal, whatever the returns.
    assert not verdict([run(0), run(0), run(0, same=True)], 0.95)[0]
    assert "no unit" in verdict([run(0), run(0.1, spread=0.0)], 0.95)[1]
