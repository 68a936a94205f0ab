"""What Snakemake, imports and file writing add to training.

A small study is run for real, two jobs at a time, in a folder of its own; a large one is planned.
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

from benchmarks.measuring import ENVIRONMENTS, ROOT, VARIANTS, Scale

CORES = 2
BEFORE, AFTER = "before the first training: imports, planning", "after the last: tables, figures"
WALL, OUTSIDE = "all of it", "per training: imports, start, end, waiting"


def measure(scale: Scale) -> list[dict[str, Any]]:
    """A row for each run of the small workflow, its parts, and the planning of the large one."""
    budget = {"episodes": scale.workflow_episodes}
    small = {
        "seeds": list(range(scale.workflow_seeds)),
        "training": budget,
        "environment_settings": dict.fromkeys(ENVIRONMENTS, budget),
    }
    with tempfile.TemporaryDirectory(prefix="mace-rl-workflow-") as folder:
        began, ended = snakemake(Path(folder), small, "--cores", str(CORES), "all")
        records = sorted(Path(folder).glob("results/runs/*/*/seed*/run.json"))
        jobs = [job(record) for record in records]
    first, last = min(began for _, began, _ in jobs), max(ended for _, _, ended in jobs)
    idle = CORES * (last - first) - sum(run["seconds"] for run, _, _ in jobs)
    large = {"seeds": list(range(scale.planned_seeds))}
    with tempfile.TemporaryDirectory(prefix="mace-rl-planning-") as folder:
        start, end = snakemake(Path(folder), large, "-n", "--quiet", "all")
    planned = len(ENVIRONMENTS) * len(VARIANTS) * scale.planned_seeds
    parts = {
        f"{len(jobs)} trainings of {scale.workflow_episodes} episodes: {WALL}": ended - began,
        BEFORE: first - began,
        AFTER: ended - last,
        OUTSIDE: idle / len(jobs),
        f"planning {planned} runs, `snakemake -n`": end - start,
    }
    rows = [{"part": part, "seconds": seconds} for part, seconds in parts.items()]
    return [run for run, _, _ in jobs] + rows


def job(record: Path) -> tuple[dict[str, Any], float, float]:
    """A run of the workflow, and when its job began and ended."""
    run = json.loads(record.read_text(encoding="utf-8"))
    results, folder = record.parents[4], record.relative_to(record.parents[3]).parent
    benchmark = results / "benchmarks" / "train" / folder.with_suffix(".tsv")
    ended = benchmark.stat().st_mtime  # Snakemake writes it when the job is over
    names, values = (line.split("\t") for line in benchmark.read_text().splitlines())
    seconds = float(dict(zip(names, values, strict=True))["s"])
    config = run["config"]
    identity = {"env": config["environment"], "contestant": config["variant"]}
    identity |= {"repeat": config["seed"], "part": "training"}
    cost = {"seconds": run["seconds"], "memory_mb": run["peak_memory_mb"]}
    return identity | cost, ended - seconds, ended


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
