"""Runs of others: their files become run folders, of which the workflow makes tables and claims."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shared import ROOT, call, refusal

from mace_rl.runs import progress
from mace_rl.runs.finished import FinishedRun
from mace_study import imported

CLAIMS = """
table1: {caption: Final return, metrics: [final_return], variants: {a: A, b: B}, values: {}}
ways: {by return: by what is learned}
families:
  claims:
    words: {shown: holds, reversed: fails, absent: fails, open: cannot tell, no_room: cannot tell}
    claims:
      B1:
        statement: B ends above A
        parts: {by return: [{environments: [Walk-v0], metric: final_return, variant: b, over: [a]}]}
"""


def test_monitors_of_a_vector_environment_are_one_run_as_their_own_library_reads_them(tmp_path):
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.monitor import load_results

    envs = make_vec_env("CartPole-v1", 3, seed=0, monitor_dir=str(tmp_path / "logs"))
    envs.reset()
    draws = np.random.default_rng(0)
    for _ in range(300):
        envs.step(draws.integers(2, size=3))
    envs.close()
    expected = load_results(str(tmp_path / "logs"))
    rows = imported.read(tmp_path / "logs")
    assert len(rows) > 20
    assert [row.extrinsic_return for row in rows] == expected["r"].tolist()
    assert [row.length for row in rows] == expected["l"].tolist()
    np.testing.assert_allclose([row.ended for row in rows], expected["t"], atol=1e-5)


def test_what_export_writes_comes_back_with_beta(monkeypatch, tmp_path, trained):
    from mace_rl.runs import export

    folder = trained(variant="mace_fixed", episodes=5)
    export.write(export.columns(folder), tmp_path / "runs.csv")
    words = "--env", "CartPole-v1", "--variant", "back", "--out", str(tmp_path / "out")
    assert call(monkeypatch, str(tmp_path / "runs.csv"), *words, tool=imported) == (0, "")
    back = FinishedRun(tmp_path / "out" / "runs" / "CartPole-v1" / "back" / "seed0").rows
    for row, own in zip(back, FinishedRun(folder).rows, strict=True):
        assert (row.extrinsic_return, row.env_steps) == (own.extrinsic_return, own.env_steps)
        assert row.beta == own.beta > 0 and row.intrinsic_return == 0


GOOD = "r,l\n1.5,3\n2.5,4\n"
MISTAKES = {  # a file, options, what is said
    "nothing": ("", "", "runs.csv: line 1: "),
    "no episode": ("r,l\n", "", "runs.csv: it has no episode"),
    "no return": ("a,b\n1,2\n", "", "its columns are a, b, and none is a return, as r, return"),
    "other name": (GOOD, "--return score", "its columns are r, l, and none is 'score'"),
    "text": ("r,l\n1.5,3\nx,4\n", "", "line 3: r is 'x', not a finite number"),
    "cut off": ('#{"t_start": 1}\nr,l,t\n1.5,3,1\n2.5', "", "line 4: it ends before its t"),
    "no length": ("r,l\n1.5,0\n", "", "line 2: l is '0', not a whole number from 1 on"),
    "head": ("#x\nr,l\n1,1\n", "", "line 1: no text, or no head of a Monitor"),
    "two runs": (
        "task,algorithm,seed,folder,return\nA,a,0,x,1\nA,a,1,x,1\n",
        "",
        "line 3: seed is '1' after '0': another run",
    ),
    "variant": (GOOD, "--variant a/b", "--variant has 'a/b', but a name here becomes a folder"),
}


@pytest.mark.parametrize("kind", MISTAKES)
def test_a_mistaken_file_or_option_is_named_in_one_line(monkeypatch, tmp_path, kind):
    content, options, said = MISTAKES[kind]
    (tmp_path / "runs.csv").write_text(content)
    words = ["--env", "A-v0", "--variant", "a", "--out", str(tmp_path / "out"), *options.split()]
    assert said in refusal(monkeypatch, str(tmp_path / "runs.csv"), *words, tool=imported)
    assert not (tmp_path / "out").exists()


def test_only_runs_that_each_variant_has_are_in_the_study(monkeypatch, tmp_path, capsys, trained):
    files = [f"{tmp_path}/{number}.csv" for number in range(3)]
    for file in files:
        Path(file).write_text(GOOD)
    out = tmp_path / "out"

    def brought(count: int, variant: str) -> None:
        words = "--env", "A-v0", "--variant", variant, "--out", str(out)
        assert call(monkeypatch, *files[:count], *words, tool=imported) == (0, "")

    brought(3, "a")
    brought(2, "b")
    assert "not in the study, since another variant lacks it: A-v0 a 2" in capsys.readouterr().out
    brought(1, "a")  # again
    assert progress.status(out) == ["3 of 3 runs done"]
    assert "not in the study, since another variant lacks it: A-v0 b 1" in capsys.readouterr().out
    place = out / "runs" / "CartPole-v1" / "ppo" / "seed0"
    shutil.copytree(trained(episodes=5), place)
    words = "--env", "CartPole-v1", "--variant", "ppo", "--out", str(out)
    said = refusal(monkeypatch, files[0], *words, tool=imported)
    assert f"{place} is a run that was trained here" in said


@pytest.mark.slow
def test_the_workflow_judges_them_without_training(monkeypatch, tmp_path):
    """Ten seeds of two algorithms, of unequal lengths; expected values by numpy alone."""
    monkeypatch.chdir(tmp_path)
    draws, returns = np.random.default_rng(0), {}
    for name, gain in (("a", 1.0), ("b", 3.0)):
        for seed in range(10):
            count = 60 + 7 * seed
            own = returns[name, seed] = np.linspace(0, gain, count) + draws.normal(0, 0.1, count)
            text = "\n".join(["score", *map(repr, own.tolist()), ""])
            (tmp_path / f"{name}{seed}.csv").write_text(text)
        own = [f"{name}{seed}.csv" for seed in range(10)]
        words = "--env", "Walk-v0", "--variant", name, "--return", "score", "--random-return", "0"
        words += "--label", name.upper(), "--out", "walk"
        assert call(monkeypatch, *own, *words, tool=imported) == (0, "")
    (tmp_path / "claims.yaml").write_text(CLAIMS)
    (tmp_path / "own.yaml").write_text(
        "claims: claims.yaml\nmetrics: {reference_return: {Walk-v0: 3}}\n"
    )
    command = [sys.executable, "-m", "snakemake", "-s", str(ROOT / "Snakefile"), "-j2", "all"]
    command += ["--configfile", "walk/study.yaml", "own.yaml"]
    path = f"{os.path.dirname(sys.executable)}:{os.environ['PATH']}"
    done = subprocess.run(command, env=os.environ | {"PATH": path}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "runs to train" not in done.stderr and "Job" in done.stderr
    table = pd.read_csv("walk/table1.csv").set_index("variant")
    for name in "ab":
        ends = [
            own[-int(np.ceil(len(own) / 10)) :].mean()
            for (who, _), own in returns.items()
            if who == name
        ]
        assert table.loc[name, "mean"] == pytest.approx(np.mean(ends))
    [answer] = json.loads((tmp_path / "walk" / "claims.json").read_text())["claims"]
    assert answer["by return"]["verdict"] == "holds"
    assert pd.read_csv("walk/figure1.csv").groupby("variant")["episode"].max().tolist() == [60, 60]
    assert "B" in (tmp_path / "walk" / "table1.tex").read_text()
