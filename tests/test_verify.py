"""`mace-rl verify`: kept runs are trained again and compared to the bit."""

import json
import shutil

import pytest
from shared import call

from mace_rl.runs import verify


@pytest.mark.parametrize(
    ("section", "change", "said"),
    [
        ("config", {"seed": 1}, "different from episode 1; mean return"),
        ("outputs", {"agent.pt": "0" * 64}, "different in the agent's weights only;"),
        ("versions", {"numpy": "1.0"}, "versions.numpy was '1.0' and is"),
    ],
)
def test_verify_says_what_is_different(
    trained, tmp_path, monkeypatch, capsys, section, change, said
):
    run = shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / "runs")
    path = run / "run.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["machine"]["cpu"] = "Z80"
    record["config"]["seed"] = int(section != "outputs")
    record[section].update(change)
    path.write_text(json.dumps(record), encoding="utf-8")
    expected = "mace-rl: not reproduced: 0 of 1 runs equal to the bit"
    assert call(monkeypatch, "verify", str(tmp_path)) == (1, expected)
    assert said in capsys.readouterr().out


def test_a_sample_is_as_large_as_asked_and_always_the_same(tmp_path, monkeypatch):
    folders = [tmp_path / f"runs/CartPole-v1/ppo/seed{seed}" for seed in range(10, 20)]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "run.json").touch()

    def drawn(sample: int | None) -> list[str]:
        return [*verify.verify(tmp_path, sample)][:-1]

    monkeypatch.setattr(verify, "repeat", lambda run: (True, str(run.folder)))
    assert drawn(None) == drawn(99) == [*map(str, folders)]
    assert drawn(3) == drawn(3) == sorted({*drawn(3)} & {*drawn(None)}) and len(drawn(3)) == 3
