"""`make tables`: what is made of the kept runs is compared with what is kept, byte for byte."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from invented import PAPERS, ROBUST, digits_of, table_for_claims

from mace_rl.runs.run import run
from mace_rl.study.compare.verdicts import ledger
from mace_rl.study.config import read_study
from mace_rl.study.show.cells import number
from tools import kept_runs, tables

ROOT = Path(__file__).parents[1]
SETTINGS = read_study([ROOT / "config.yaml"]).metrics
SETTINGS = SETTINGS.model_copy(update={"bootstrap_repetitions": 500})


def test_the_first_study_stands_beside_this_one_part_by_part() -> None:
    noise = {"ppo": 0.0, "mace_fixed": 0.03, "mace_full": 0.06}
    first, second = (
        ledger(table_for_claims(seeds, noise, 0.1), SETTINGS, PAPERS) for seeds in (11, 12)
    )
    page = tables.beside_the_first(first[2:], second)
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| C")]
    said, parts = rows[:10], rows[10:]
    for row, *claims in zip(said, second, [None, None, *first[2:]], strict=True):
        now, before = (claim.ways[ROBUST].verdict if claim else "" for claim in claims)
        assert row[-2:] == [before, now] if before else row[-1] == now
    count = 0
    for claim, other in zip(second[2:], first[2:], strict=True):
        for part, old in zip(claim.ways[ROBUST].parts, other.ways[ROBUST].parts, strict=True):
            row = parts[4 + count]  # C1 and C2 have two parts each
            digits = digits_of(part)
            assert [row[place] for place in (0, 4, 6, 7, 9)] == [
                *(claim.claim, "12", part.outcome, "11", old.outcome)
            ]
            for place, found in ((5, part), (8, old)):
                assert row[place].startswith(f"{number(found.difference, digits)} (")
            count += 1
    assert count == len(parts) - 4


@pytest.mark.slow
def test_a_kept_study_is_made_compared_and_reported(tmp_path: Path) -> None:
    for name in ("workflow", "profiles", "config"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("Snakefile", "config.yaml"):
        shutil.copy(ROOT / name, tmp_path)
    small = {"environments": ["CartPole-v1"], "variants": ["ppo"], "seeds": [0, 1]}
    small |= {"training": {"episodes": 60}, "metrics": {"comparisons": []}}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(small))
    study = read_study([tmp_path / "config.yaml", tmp_path / "small.yaml"])
    for seed in (0, 1):
        folder = tmp_path / f"results/runs/CartPole-v1/ppo/seed{seed}"
        run(study.run_config("CartPole-v1", "ppo", seed), folder)
    kept_runs.pack(tmp_path / "results", tmp_path / "reference/study")
    wanted = {
        "configfiles": ["small.yaml"],
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
