"""Runs that are kept come out as they went in."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest

from mace_rl import files
from mace_rl.runs.provenance import KEYS
from tools import kept_runs


def make_run(folder: Path, text: str) -> None:
    folder.mkdir(parents=True)
    (folder / files.EPISODES).write_text(text)
    (folder / files.AGENT).write_text(f"agent of {text}")
    digests = {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
        for name in (files.EPISODES, files.AGENT)
    }
    record = {key: {} for key in KEYS} | {"outputs": digests}
    (folder / files.RECORD).write_text(json.dumps(record))


def content(folder: Path) -> dict[str, bytes]:
    """The files in a folder but for agents that are not kept."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and (path.name != files.AGENT or path.parent.name == "seed0")
    }


def test_what_was_packed_comes_out(tmp_path: Path) -> None:
    results, kept = tmp_path / "results", tmp_path / "kept"
    for run in ("A-v1/ppo/seed0", "A-v1/ppo/seed10", "A-v1/ppo/seed9", "B-v0/mace_full/seed3"):
        make_run(results / "runs" / run, f"records of {run}\n" * 50)
    (results / "runs/A-v1/ppo/seed11").mkdir()  # not finished
    assert kept_runs.pack(results, kept) == 4
    assert sorted(content(kept)) == ["A-v1/ppo.tar.xz", "B-v0/mace_full.tar.xz"]
    assert kept_runs.unpack(kept, tmp_path / "again") == 4
    assert content(tmp_path / "again") == content(results)
    assert len([*(tmp_path / "again").rglob(files.AGENT)]) == 1


def test_packing_again_adds_and_equal_runs_give_equal_files(tmp_path: Path) -> None:
    for half in (0, 1):
        make_run(tmp_path / f"half{half}/runs/A-v1/ppo/seed{half}", f"{half}\n")
        make_run(tmp_path / f"whole/runs/A-v1/ppo/seed{half}", f"{half}\n")
    kept_runs.pack(tmp_path / "half1", tmp_path / "kept")
    assert kept_runs.pack(tmp_path / "half0", tmp_path / "kept") == 2
    kept_runs.pack(tmp_path / "whole", tmp_path / "kept whole")
    assert content(tmp_path / "kept") == content(tmp_path / "kept whole")


def test_records_that_are_not_the_runs_and_other_runs_of_a_seed_are_refused(tmp_path: Path) -> None:
    run, kept = tmp_path / "results/runs/A-v1/ppo/seed0", tmp_path / "kept"
    make_run(run, "1\n")
    kept_runs.pack(tmp_path / "results", kept)
    before = content(kept)
    (run / files.EPISODES).write_text("2\n")
    with pytest.raises(ValueError, match=r"episodes\.csv: not the file that run\.json describes"):
        kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    (run / files.EPISODES).write_text("1\n")
    (run / files.AGENT).write_text("another")
    with pytest.raises(ValueError, match=r"agent\.pt: not the file that run\.json describes"):
        kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    shutil.rmtree(run)
    make_run(run, "2\n")
    with pytest.raises(ValueError, match=r"ppo\.tar\.xz has another run of this seed"):
        kept_runs.pack(tmp_path / "results", kept)
    assert content(kept) == before


@pytest.mark.parametrize("command", ["pack", "unpack"])
@pytest.mark.parametrize("folder", ["nope", "without a finished run"])
def test_where_there_are_no_runs_nothing_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, folder: str
) -> None:
    origin, goal = tmp_path / folder, tmp_path / "goal"
    (tmp_path / "without a finished run/runs/A-v1/ppo/seed0").mkdir(parents=True)
    make_run(tmp_path / "results/runs/A-v1/ppo/seed1", "1\n")
    kept_runs.pack(tmp_path / "results", goal)  # what is there already does not count
    before = content(tmp_path)
    wanted = {"pack": "runs/ENV/VARIANT/seedN/run.json", "unpack": "ENV/VARIANT.tar.xz"}[command]
    monkeypatch.setattr("sys.argv", ["kept_runs", command, str(origin), str(goal)])
    with pytest.raises(SystemExit) as ended:
        kept_runs.main()
    assert ended.value.code == f"kept_runs: {origin}: no {wanted} in it"
    assert content(tmp_path) == before
