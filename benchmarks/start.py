"""What a run costs besides its training, by hand and as a job of the workflow: start.csv.

In turn, so that whatever else the machine does meets everybody. A run of one episode is next to
nothing but its start and end. A job's part of a workflow is the difference between a workflow of
many such jobs, one after another, and of one, divided by how many more: all that Snakemake does for
a job is in it, and its own start is not. CPU time counts all processes.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from benchmarks.settings import CARTPOLE, FIRST_SEED, ROOT, Scale

HAND, JOB = "`mace-rl train`, by hand", "a job of the workflow"
IMPORTS, PREAMBLE = "imports of a training", "what Snakemake writes in front of a script"
CODE = {
    IMPORTS: "import mace_rl.runs.run",
    PREAMBLE: "from snakemake.logging import logger; from snakemake.iocontainers import Snakemake",
}


class Cost(NamedTuple):
    """Of a process and all that it started and waited for."""

    seconds: float
    cpu_seconds: float


def measure_all(scale: Scale) -> None:
    """Measure everything `scale.start_repeats` times, after once to compile and to warm up."""
    rows = []
    for repeat in range(-1, scale.start_repeats):
        for what, cost in costs(scale.start_jobs).items():
            rows.append({"what": what, "repeat": repeat} | cost._asdict())
    table = pd.DataFrame(rows).query("repeat >= 0")
    table.to_csv(scale.data / "start.csv", index=False)
    print(table.groupby("what", sort=False)[list(Cost._fields)].median().round(2))


def costs(jobs: int) -> dict[str, Cost]:
    """Each of them once, a job as the mean over `jobs`."""
    found = {what: cost("-c", code) for what, code in CODE.items()}
    run = ["--env", CARTPOLE, "--variant", "ppo", "--seed", str(FIRST_SEED), "--episodes", "1"]
    found[HAND] = cost("-m", "mace_rl.cli", "train", *run, "--out", "run")
    many, one = workflow(1 + jobs), workflow(1)
    found[JOB] = Cost(*((m - o) / jobs for m, o in zip(many, one, strict=True)))
    return found


def workflow(jobs: int) -> Cost:
    """Of a Snakemake that carries out so many runs, one at a time, and makes nothing of them."""
    seeds = range(FIRST_SEED, FIRST_SEED + jobs)
    return cost(
        *("-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")),
        *("--workflow-profile", str(ROOT / "profiles" / "default"), "--cores", "1"),
        *("--config", "training={episodes: 1}", f"seeds={[*seeds]}".replace(" ", ""), "--"),
        *(f"results/runs/{CARTPOLE}/ppo/seed{seed}/run.json" for seed in seeds),
    )


def cost(*arguments: str) -> Cost:
    """Of Python with these arguments, in an empty folder with the project's configuration."""
    with tempfile.TemporaryDirectory(prefix="mace-rl-start-") as folder:
        (Path(folder) / "config.yaml").symlink_to(ROOT / "config.yaml")
        with open(Path(folder) / "said", "w+b") as said:
            began = time.monotonic()
            process = subprocess.Popen(
                [sys.executable, *arguments], cwd=folder, stdout=said, stderr=said
            )
            _, status, used = os.wait4(process.pid, 0)
            seconds = time.monotonic() - began
            process.returncode = os.waitstatus_to_exitcode(status)
            if process.returncode:
                said.seek(0)
                sys.exit(f"{arguments} failed:\n{said.read().decode(errors='replace')}")
    return Cost(seconds, used.ru_utime + used.ru_stime)
