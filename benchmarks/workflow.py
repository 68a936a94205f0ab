"""What Snakemake, imports and file writing add to training: workflow.csv and planning.csv.

A small study is run for real, with two jobs at a time, in a folder of its own; what it shows is
extrapolated to the paper's budgets by `aggregate.paper_budget`. A large study is only planned.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

from benchmarks.process import ONE_THREAD, write_rows
from benchmarks.settings import ENVIRONMENTS, ROOT, Scale

CORES = 2


def measure_all(scale: Scale) -> None:
    """Run the small workflow, plan the large one, write both files."""
    with tempfile.TemporaryDirectory(prefix="mace-rl-workflow-") as folder:
        run_small(Path(folder), scale)
    with tempfile.TemporaryDirectory(prefix="mace-rl-planning-") as folder:
        plan_large(Path(folder), scale)


def run_small(folder: Path, scale: Scale) -> None:
    """Every environment and variant, few seeds and episodes; one row per run in workflow.csv."""
    budget = {"episodes": scale.workflow_episodes}
    settings = {
        "seeds": list(range(scale.workflow_seeds)),
        "training": budget,
        "environment_settings": dict.fromkeys(ENVIRONMENTS, budget),
    }
    began, ended = snakemake(folder, settings, f"-j{CORES}", "all")
    whole = {"workflow_began": began, "workflow_ended": ended}
    records = sorted(folder.glob("results/runs/*/*/seed*/run.json"))
    rows = [job(record) | whole for record in records]
    write_rows(scale.data / "workflow.csv", rows)
    print(f"workflow: {len(rows)} runs in {ended - began:.0f} s")


def job(record: Path) -> dict[str, Any]:
    """One run of the workflow: seconds of training, and when its job began and ended."""
    run = json.loads(record.read_text(encoding="utf-8"))
    identity = {"env": run["config"]["environment"], "variant": run["config"]["variant"]}
    runs = record.parents[3]
    folder = record.relative_to(runs).parent
    benchmark = runs.parent / "benchmarks" / "train" / folder.with_suffix(".tsv")
    header, values = (line.split("\t") for line in benchmark.read_text().splitlines())
    seconds = float(values[header.index("s")])
    ended = benchmark.stat().st_mtime  # Snakemake writes it when the job is over
    return identity | {
        "seed": run["config"]["seed"],
        "training_seconds": run["seconds"],
        "job_began": ended - seconds,
        "job_ended": ended,
        "peak_memory_mb": run["peak_memory_mb"],
    }


def plan_large(folder: Path, scale: Scale) -> None:
    """`snakemake -n` of every variant that has settings, with many seeds; planning.csv."""
    variants = yaml.safe_load((ROOT / "config.yaml").read_text(encoding="utf-8"))
    settings = {
        "variants": list(variants["variant_settings"]),
        "seeds": list(range(scale.planned_seeds)),
    }
    began, ended = snakemake(folder, settings, "-n", "--quiet", "all")
    runs = len(ENVIRONMENTS) * len(settings["variants"]) * scale.planned_seeds
    write_rows(scale.data / "planning.csv", [{"runs": runs, "seconds": ended - began}])
    print(f"planning: {runs} runs in {ended - began:.1f} s")


def snakemake(folder: Path, settings: dict[str, Any], *arguments: str) -> tuple[float, float]:
    """Run the project's workflow on a copy of config.yaml in `folder`; when it began and ended."""
    shutil.copy(ROOT / "config.yaml", folder)
    (folder / "changes.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")]
    command += ["--workflow-profile", str(ROOT / "profiles" / "default"), *arguments]
    began = time.time()
    run = subprocess.run(
        [*command, "--configfile", "changes.yaml"],
        cwd=folder,
        env=os.environ | ONE_THREAD | {"PYTHONUTF8": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    ended = time.time()
    if run.returncode:
        sys.exit(f"the workflow failed:\n{run.stdout}")
    return began, ended
