"""`make tables`: what is made of the kept runs is compared with what is kept, byte for byte."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from mace_rl.runs.run import run
from mace_rl.study.config import read_study
from tools import kept_runs

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_a_kept_study_is_made_compared_and_reported(tmp_path: Path) -> None:
    for name in ("workflow", "profiles", "config"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("Snakefile", "config.yaml"):
        shutil.copy(ROOT / name, tmp_path)
    small = {"environments": ["CartPole-v1"], "variants": ["ppo"], "seeds": [0, 1]}
    small |= {"training": {"episodes": 60}, "metrics": {"comparisons": []}}
    (tmp_path / "config/small.yaml").write_text(yaml.safe_dump(small))
    study = read_study([tmp_path / "config.yaml", tmp_path / "config/small.yaml"])
    for seed in (0, 1):
        folder = tmp_path / f"results/runs/CartPole-v1/ppo/seed{seed}"
        run(study.run_config("CartPole-v1", "ppo", seed), folder)
    kept_runs.pack(tmp_path / "results", tmp_path / "reference/study")
    wanted = {
        "configuration": "config",
        "configfiles": ["config/small.yaml"],
        "config": [],
        "outputs": ["metrics.csv", "figure1.png"],
    }
    studies, kept = tmp_path / "reference/studies.yaml", tmp_path / "reference/tables/small"
    studies.write_text(yaml.safe_dump({"small": wanted}))

    def tabulate(*words: str) -> tuple[str, str]:
        script = "from pathlib import Path; from tools import tables; "
        script += f"tables.ROOT = Path({str(tmp_path)!r}); tables.main()"
        command = [sys.executable, "-c", script, *words]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
        assert (done.returncode == 1) == ("tables: " in done.stderr), done.stderr
        return done.stdout, done.stderr.strip()

    stale = tmp_path / "results/tables/small/stale"
    stale.parent.mkdir(parents=True)
    stale.touch()
    names = ("metrics.csv", "figure1.png", "README.md")
    made = "3 tables and figures of 1 studies from 2 runs, in results/tables\n"
    new = "".join(f"new: reference/tables/small/{name}\n" for name in names)
    assert tabulate() == (new + made, "") and not stale.exists()
    readme = (kept / "README.md").read_text()
    assert readme.startswith("# small\n") and readme.count("![") == 1
    assert "![figure1](figure1.png)" in readme and "## Mean return of training" in readme

    metrics = (kept / "metrics.csv").read_bytes()
    (kept / "metrics.csv").write_bytes(metrics + b"\n")
    (kept / "README.md").unlink()
    named = "tables: not those that are kept: "
    named += "reference/tables/small/metrics.csv, reference/tables/small/README.md"
    assert tabulate("--check") == (made, named)
    (kept / "metrics.csv").write_bytes(metrics)
    (kept / "README.md").write_text("stale")
    assert tabulate() == ("renewed: reference/tables/small/README.md\n" + made, "")
    assert (kept / "README.md").read_text() == readme

    studies.write_text(yaml.safe_dump({"small": wanted, "bad": wanted | {"config": ["seeds=[2]"]}}))
    output, error = tabulate()
    assert "tables: bad: " in error and "seed2/run.json" in error and not output
    assert tabulate("--report", "small")[0] == "results/tables/small/report.html\n"
    assert "<!DOCTYPE html>" in (tmp_path / "results/tables/small/report.html").read_text()
    assert "--report is 'none', but should be one of bad, small" in tabulate("--report", "none")[1]
