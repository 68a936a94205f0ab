"""`mace-rl verify`: kept runs are trained again and compared to the bit."""

import json
import shutil

import pytest
from shared import GOOD, call

from mace_rl.runs.verify import Repetition, verdict


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
    def run(then: float, now: float, equal: bool = False) -> Repetition:
        return Repetition("a run", equal, None if equal else 1, (then, now), 2.0, "cpu")

    assert verdict([run(1, 1, True)] * 3, 0.95) == (True, "3 of 3 runs equal to the bit")
    # Changes of -1, 1 and 0 spreads: their mean is 0. Changes of 1, 1.1 and 0.9: clearly not.
    assert verdict([run(10, 8), run(10, 12), run(5, 5)], 0.95)[0]
    assert not verdict([run(10, 12), run(10, 12.2), run(5, 6.8)], 0.95)[0]
    assert not verdict([run(10, 12), run(1, 1, True)], 0.95)[0]
