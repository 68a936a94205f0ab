"""What Snakemake, imports and file writing add to training: workflow.csv and planning.csv.

A small study is run for real, with two jobs at a time, in a folder of its own; what it shows is
extrapolated to the paper's budgets by `summaries.paper_budget`. A large study is only planned.
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

import pandas as pd
import yaml

from benchmarks.settings import CORES, ENVIRONMENTS, ROOT, Scale


def measure_all(scale: Scale) -> None:
    """Run the small workflow, plan the large one, write both files."""
    budget = {"episodes": scale.workflow_episodes}
    small = {
        "seeds": list(range(scale.workflow_seeds)),
        "training": budget,
        "environment_settings": dict.fromkeys(ENVIRONMENTS, budget),
    }
    with tempfile.TemporaryDirectory(prefix="mace-rl-workflow-") as folder:
        began, ended = snakemake(Path(folder), small, "--cores", str(CORES), "all")
        records = sorted(Path(folder).glob("results/runs/*/*/seed*/run.json"))
        jobs = pd.DataFrame([job(record) for record in records])
    jobs = jobs.assign(workflow_began=began, workflow_ended=ended)
    jobs.to_csv(scale.data / "workflow.csv", index=False)
    print(f"workflow: {len(jobs)} runs in {ended - began:.0f} s")

    variants = yaml.safe_load((ROOT / "config.yaml").read_text(encoding="utf-8"))
    variants = list(variants["variant_settings"])
    large = {"variants": variants, "seeds": list(range(scale.planned_seeds))}
    with tempfile.TemporaryDirectory(prefix="mace-rl-planning-") as folder:
        began, ended = snakemake(Path(folder), large, "-n", "--quiet", "all")
    runs = len(ENVIRONMENTS) * len(variants) * scale.planned_seeds
    planning = pd.DataFrame({"runs": [runs], "seconds": [ended - began]})
    planning.to_csv(scale.data / "planning.csv", index=False)
    print(f"planning: {runs} runs in {ended - began:.1f} s")


def job(record: Path) -> dict[str, Any]:
    """One run of the workflow: seconds of training, and when its job began and ended."""
    run = json.loads(record.read_text(encoding="utf-8"))
    results, folder = record.parents[4], record.relative_to(record.parents[3]).parent
    benchmark = results / "benchmarks" / "train" / folder.with_suffix(".tsv")
    ended = benchmark.stat().st_mtime  # Snakemake writes it when the job is over
    return {
        "env": run["config"]["environment"],
        "variant": run["config"]["variant"],
        "seed": run["config"]["seed"],
        "training_seconds": run["seconds"],
        "job_began": ended - pd.read_csv(benchmark, sep="\t")["s"][0],
        "job_ended": ended,
        "peak_memory_mb": run["peak_memory_mb"],
    }


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
        env=os.environ | {"PYTHONUTF8": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    ended = time.time()
    if run.returncode:
        sys.exit(f"the workflow failed:\n{run.stdout}")
    return began, ended
