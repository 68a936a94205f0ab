"""Runs that are kept come out as they went in."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from invented import episode_columns
from shared import content_of, refusal, refused

from mace_rl.base import files
from mace_rl.library import settings
from mace_rl.runs.provenance import file_digest
from mace_rl.runs.run import run as train
from mace_rl.training.records import rounded, write_episodes
from tools import kept_runs


def make_run(folder: Path, number: int, episodes: int = 30, **others: np.ndarray) -> None:
    folder.mkdir(parents=True)
    columns = episode_columns(episodes, number)
    columns["beta"] = np.array([rounded(value) for value in columns["beta"]])
    if number % 2 == 0:  # the others have all digits of a double
        columns["extrinsic_return"] = -columns["length"].astype(float)
    write_episodes(folder / files.EPISODES, columns | others)
    (folder / files.AGENT).write_bytes(b"agent")
    digests = {name: file_digest(folder / name) for name in (files.EPISODES, files.AGENT)}
    config = {"environment": "A-v1", "variant": "ppo", "seed": number, "episodes": episodes}
    record = {"config": config, "versions": {}, "sources": "", "machine": {}, "outputs": digests}
    record["seconds"] = 10 * number
    (folder / files.RECORD).write_text(json.dumps(record))


def test_what_was_packed_comes_out(tmp_path: Path) -> None:
    """But for `intrinsic_return`; compared with what pandas reads of the run's own file."""
    results, kept = tmp_path / "results", tmp_path / "kept"
    runs = "A-v1/ppo/seed100", "A-v1/mace_full/seed1000", "A-v1/ppo/seed99", "B-v0/ppo/seed3"
    for number, run in enumerate(runs):
        make_run(results / "runs" / run, number, episodes=1000 + 7 * number)
    (results / "runs/A-v1/ppo/seed11").mkdir()  # not finished
    assert kept_runs.pack(results, kept) == 4
    assert sorted(content_of(kept)) == ["A-v1.parquet", "B-v0.parquet"]
    found = {
        (path.stem, *key): run
        for path in kept.glob("*.parquet")
        for key, run in kept_runs.read(path).items()
    }
    for run in runs:
        env, variant, seed = run.split("/")
        record, episodes = found.pop((env, variant, int(seed[4:])))
        assert record == (results / "runs" / run / files.RECORD).read_text()
        whole = pd.read_csv(results / "runs" / run / files.EPISODES)
        pd.testing.assert_frame_equal(episodes, whole[episodes.columns], check_exact=True)
        assert {*whole.columns} - {*episodes.columns} == {"intrinsic_return"}
    assert not found
    assert [*kept_runs.read(kept / "A-v1.parquet", ["mace_full"])] == [("mace_full", 1000)]
    assert kept_runs.read(kept / "A-v1.parquet", ["mace_fixed"]) == {}


@pytest.mark.parametrize(
    ("returns", "stored"),
    [
        (lambda length, ended: 0.1 * length * ended - 0.3, False),  # follows from how it ended
        (lambda length, ended: np.tile([1 / 3, -0.0, 1 / 7, 0.1], 500), True),
        (lambda length, ended: np.random.default_rng(1).normal(size=2000), True),
        (lambda length, ended: -length.astype(float), False),
        (lambda length, ended: np.where(length < 9, -0.0, 0.0), False),
        (lambda length, ended: np.tile([-0.0, 0.0], 1000), True),  # two numbers
    ],
)
def test_returns_that_follow_or_repeat_come_out_to_the_bit(tmp_path, returns, stored) -> None:
    columns = episode_columns(2000, seed=1)
    own = returns(columns["length"], columns["terminated"])
    make_run(tmp_path / "results/runs/A-v1/ppo/seed1", 1, episodes=2000, extrinsic_return=own)
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    path = tmp_path / "kept/A-v1.parquet"
    ((_, episodes),) = kept_runs.read(path).values()
    assert episodes["extrinsic_return"].to_numpy().tobytes() == own.tobytes()
    assert ("extrinsic_return" in pd.read_parquet(path)) == stored


def test_packing_again_adds_and_equal_runs_give_equal_files(tmp_path: Path) -> None:
    for half in (0, 1):
        make_run(tmp_path / f"half{half}/runs/A-v1/ppo/seed{half}", half)
        make_run(tmp_path / f"whole/runs/A-v1/ppo/seed{half}", half)
    kept_runs.pack(tmp_path / "half1", tmp_path / "kept")
    assert kept_runs.pack(tmp_path / "half0", tmp_path / "kept") == 2
    kept_runs.pack(tmp_path / "whole", tmp_path / "kept whole")
    assert content_of(tmp_path / "kept") == content_of(tmp_path / "kept whole")


def test_records_that_are_not_the_runs_and_other_runs_of_a_seed_are_refused(tmp_path: Path) -> None:
    run, kept = tmp_path / "results/runs/A-v1/ppo/seed100", tmp_path / "kept"
    make_run(run, 1)
    kept_runs.pack(tmp_path / "results", kept)
    before = content_of(kept)
    shutil.rmtree(run)
    make_run(run, 2)
    with pytest.raises(ValueError, match=r"A-v1\.parquet has another run of this seed"):
        kept_runs.pack(tmp_path / "results", kept)
    text = (run / files.EPISODES).read_text()
    (run / files.EPISODES).write_text(text.replace("0", "1"))
    with pytest.raises(ValueError, match=r"episodes\.csv: "):
        kept_runs.pack(tmp_path / "results", tmp_path / "new")
    assert content_of(kept) == before and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["pack", "nope", "goal"], "nope: no runs/ENV/VARIANT/seedN/run.json in it"),
        (["pack", "unfinished", "goal"], "unfinished: no runs/ENV/VARIANT/seedN/run.json in it"),
        (["verify", "nope"], "nope: 0 runs in it that take less than 60 s"),
        (["verify", "kept", "--sample", "0"], "--sample is a number of runs, at least 1"),
    ],
)
def test_what_cannot_be_done_is_one_line(tmp_path, monkeypatch, words, said) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "unfinished/runs/A-v1/ppo/seed0").mkdir(parents=True)
    assert refusal(monkeypatch, *words, tool=kept_runs) == f"kept_runs: {said}"
    assert not (tmp_path / "goal").exists()


def test_a_sample_is_of_short_runs_of_different_variants(tmp_path: Path) -> None:
    for number in range(9):  # which take 0 to 80 seconds
        make_run(tmp_path / f"results/runs/{'AB'[number % 2]}-v0/v{number // 2}/seed100", number)
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    found = [json.loads(run.record) for run in kept_runs.sample(tmp_path / "kept", 4)]
    assert len({record["config"]["seed"] for record in found}) == 4
    assert all(record["seconds"] < 60 for record in found)
    assert found == [json.loads(run.record) for run in kept_runs.sample(tmp_path / "kept", 4)]
    with pytest.raises(ValueError, match="6 runs in it that take less than 60 s"):
        list(kept_runs.sample(tmp_path / "kept", 7))


@pytest.mark.slow
def test_a_kept_run_is_trained_again_and_a_difference_named(tmp_path, monkeypatch, capsys) -> None:
    config = settings("CartPole-v1", "mace_full", seed=3, episodes=20)
    train(config, tmp_path / "results/runs/CartPole-v1/mace_full/seed3")
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    monkeypatch.setattr(kept_runs, "LONGEST", np.inf)  # on a busy machine
    words = ["kept_runs", "verify", str(tmp_path / "kept"), "--sample", "1"]
    monkeypatch.setattr("sys.argv", words)
    kept_runs.main()
    line = "CartPole-v1 mace_full seed 3: equal to the bit\n1 of 1 runs equal to the bit\n"
    assert capsys.readouterr().out == line
    path = tmp_path / "kept/CartPole-v1.parquet"
    ((key, run),) = kept_runs.read(path).items()
    run.episodes.loc[7, "beta"] += 1e-3
    kept_runs.write(path, {key: run})
    with pytest.raises(SystemExit, match="1"):
        kept_runs.main()
    assert "seed 3: different" in capsys.readouterr().out


@pytest.mark.parametrize("damage", ["cut off", "a byte", "no parquet", "other columns", "a record"])
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    make_run(tmp_path / "results/runs/A-v1/ppo/seed1", 1, episodes=300)
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    path = tmp_path / "kept/A-v1.parquet"
    data = path.read_bytes()
    if damage == "cut off":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "a byte":  # in the middle of the returns
        path.write_bytes(data[:2500] + bytes([data[2500] ^ 1]) + data[2501:])
    elif damage == "no parquet":
        path.write_text("nothing")
    elif damage == "other columns":
        pd.DataFrame({"variant": ["ppo"]}).to_parquet(path)
    else:
        pd.read_parquet(path).assign(digest="0" * 64).to_parquet(path)
    with refused(ValueError, re.escape(str(path))):
        kept_runs.read(path)
