"""`mace-rl export`: what pandas reads of it is what each run's records are."""

import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
from shared import call


@pytest.fixture
def runs(trained, tmp_path):
    """A folder with two finished runs."""
    for variant, seed in (("ppo", 0), ("mace_full", 1)):
        folder = tmp_path / "runs" / variant / f"seed{seed}"
        shutil.copytree(trained("CartPole-v1", variant, seed, episodes=6), folder)
    return tmp_path / "runs"


def test_the_table_has_every_episode_of_every_run(runs, monkeypatch, tmp_path):
    out = tmp_path / "new folder" / "runs.csv"
    assert call(monkeypatch, "export", str(runs), "--out", str(out)) == (0, "")
    table = pd.read_csv(out)
    assert table["task"].unique() == ["CartPole-v1"] and len(table) == 12
    for (algorithm, seed), own in table.groupby(["algorithm", "seed"]):
        records = pd.read_csv(runs / algorithm / f"seed{seed}" / "episodes.csv")
        names = {"step": "env_steps", "return": "extrinsic_return"}
        for name in ("step", "return", "episode", "length", "beta"):
            assert own[name].tolist() == records[names.get(name, name)].tolist()


def test_runs_behind_links_are_there_and_once(runs, monkeypatch, tmp_path, capsys, caplog):
    """For every command that looks for runs; what was set aside is not."""
    caplog.set_level("INFO")
    elsewhere = (runs / "ppo").rename(tmp_path / "elsewhere")
    (runs / "ppo").symlink_to(elsewhere)
    (runs / "mace_full" / "loop").symlink_to(runs)
    (runs / "mace_full" / "again").symlink_to(runs / "mace_full" / "seed1")
    shutil.copytree(elsewhere / "seed0", elsewhere / "seed0" / "_aside1")
    out = tmp_path / "runs.csv"
    for _ in range(2):  # over what it wrote itself
        assert call(monkeypatch, "export", str(runs), "--out", str(out)) == (0, "")
    assert len(pd.read_csv(out)) == 12
    assert call(monkeypatch, "tensorboard", str(runs), "--out", str(tmp_path / "e")) == (0, "")
    assert "runs: 2;" in caplog.text
    assert call(monkeypatch, "verify", str(runs)) == (0, "")
    assert "2 of 2 runs equal" in capsys.readouterr().out


def test_the_page_s_interquartile_mean(trained, monkeypatch, tmp_path, capsys):
    """Of the last tenth of 10 episodes, the last one, over 4 seeds: the mean of the middle two."""
    for seed in range(4):
        shutil.copytree(trained("CartPole-v1", "ppo", seed, episodes=10), tmp_path / str(seed))
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "export", ".", "--out", "runs.csv") == (0, "")
    last = [pd.read_csv(f"{seed}/episodes.csv")["extrinsic_return"].iloc[-1] for seed in range(4)]
    page = (Path(__file__).parents[1] / "docs" / "extending.md").read_text(encoding="utf-8")
    [example] = re.findall(r"```py\n(.*?)```", page, re.DOTALL)
    capsys.readouterr()
    exec(example, {})
    assert f"{sum(sorted(last)[1:3]) / 2:.1f}" in capsys.readouterr().out


def test_mistakes_get_one_line(runs, monkeypatch, tmp_path):
    def refused(out: str) -> str:
        code, said = call(monkeypatch, "export", str(runs), "--out", str(tmp_path / out))
        assert code == 1 and "\n" not in said and not (tmp_path / out).exists()
        return said

    (tmp_path / "mine.csv").write_text("x,y\n1,2\n")
    _, said = call(monkeypatch, "export", str(runs), "--out", str(tmp_path / "mine.csv"))
    assert "not written by this command" in said
    assert (tmp_path / "mine.csv").read_text() == "x,y\n1,2\n"
    assert "--out is " in refused("x.json") and "end in .csv or .parquet" in refused("x.json")
    assert "pip install pyarrow" in refused("x.parquet")  # the lock is without; make test-wheel has
    shutil.copytree(runs / "ppo", runs / "again")
    assert "CartPole-v1 ppo seed 0 is in" in refused("x.csv")
