"""What `tools/kill_test.py` notices; not the killing, which takes minutes."""

import json
from pathlib import Path

import pytest
from shared import message

from mace_rl import files
from tools import kill_test
from tools.slurm_test import contents


def run_in(folder: Path, interruptions: int = 0, **changes: str | None) -> Path:
    """What a finished run leaves, with other files (dots in names as _); None: without."""
    found = dict.fromkeys(files.RESULTS, "the same")
    found[files.RECORD] = json.dumps({"interruptions": [{}] * interruptions})
    found |= {name.replace("_", "."): text for name, text in changes.items()}
    folder.mkdir(parents=True)
    for name, text in found.items():
        if text is not None:
            (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"interruptions": 2}, True),
        ({"agent_pt": "another"}, False),
        ({"episodes_csv": "the same\n"}, False),
        ({"diagnostics_csv": None}, False),
        ({"run_json": None}, False),
        ({"checkpoint_pt": "left"}, False),
        ({"progress_json": "left"}, False),
    ],
)
def test_every_byte_and_every_file_counts(tmp_path: Path, changes: dict, expected: bool) -> None:
    undisturbed = run_in(tmp_path / "undisturbed")
    assert kill_test.same(run_in(tmp_path / "killed", **changes), undisturbed) == expected


def test_what_had_a_checkpoint_has_to_be_resumed(tmp_path: Path) -> None:
    cut = run_in(tmp_path / "cut", run_json=None, checkpoint_pt="half")
    over = run_in(tmp_path / "over", checkpoint_pt="whole")
    fresh = run_in(tmp_path / "fresh", run_json=None)
    assert [kill_test.cut_off(folder) for folder in (cut, over, fresh)] == [True, False, False]
    once = run_in(tmp_path / "once", interruptions=1)
    assert [kill_test.resumed(folder) for folder in (once, over, cut)] == [True, False, False]


@pytest.mark.parametrize(
    ("hit", "equal", "as_it_should", "expected"),
    [
        (True, True, True, "equal"),
        (True, True, False, "NOT RESUMED"),
        (True, False, True, "DIFFERENT"),
        (False, True, True, "NOT HIT"),
    ],
)
def test_only_what_was_hit_resumed_and_equal_passes(
    hit: bool, equal: bool, as_it_should: bool, expected: str
) -> None:
    assert kill_test.outcome(hit, equal, as_it_should) == expected


def test_of_a_study_all_but_the_circumstances_counts(tmp_path: Path) -> None:
    folder = run_in(tmp_path / "study/runs/A-v0/ppo/seed0", diagnostics_csv="1")
    for name in ("logs/train/a.log", "benchmarks/a.tsv", ".lock", "table1.csv"):
        (tmp_path / "study" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "study" / name).write_text(name)
    claims = '{"cost": {"runs": 9,\n "core_hours": %s},\n "claims": [%d]}'
    found = {}
    for hours, claim in ((0.5, 1), (7.25, 1), (0.5, 2)):
        (tmp_path / "study/claims.json").write_text(claims % (hours, claim))
        found[hours, claim] = contents(tmp_path / "study")
    place = folder.relative_to(tmp_path / "study")
    kept = {f"{place}/{name}" for name in files.RESULTS}
    assert set(found[0.5, 1]) == {"table1.csv", "claims.json", *kept}
    assert found[0.5, 1] == found[7.25, 1] != found[0.5, 2]


def test_no_kill_at_all_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    said = message(monkeypatch, kill_test, "--repeats", "0")
    assert said == "kill test: --repeats is 0, but should be at least 1"
