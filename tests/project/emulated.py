"""What test_cross_cpu.py lets a processor do: `python emulated.py TASKS`, a JSON list.

One process for all tasks: emulated, importing and compiling take minutes. A task is an environment,
a variant, a folder and whether to stop half way; or "tables" and a folder.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[2]
# More than the 10 updates after which a β has its credit.
EPISODES = {"Acrobot-v1": 14, "CartPole-v1": 60, "HopperBulletEnv-v0": 60}
# So small that memory and buffer are full before the end, and what is in them is replaced.
CHANGES = {"memory": {"capacity": 50}, "novelty": {"buffer_size": 100, "refresh_every": 32}}
TABLES = ["table1.csv", "table1.tex", "figure1.pdf", "figure1.png"]  # of the runs in reference/


class Interrupted(Exception):
    """A training was, as it should be."""


def train(environment: str, variant: str, folder: str, halt: bool) -> None:
    """Train, or begin to: half of the episodes, and what is left is a checkpoint."""
    from mace_rl import settings
    from mace_rl.runs import run

    config = settings(environment, variant, episodes=EPISODES[environment], **CHANGES)
    if not halt:
        run.run(config, Path(folder))
        return

    def interrupt(progress: dict[str, Any]) -> None:
        if progress["episode"] > config.episodes // 2:
            raise Interrupted

    every_round = {"CHECKPOINT_SECONDS": 0.0, "CHECKPOINT_COST": 1e9, "PROGRESS_SECONDS": 0.0}
    try:
        with patch.multiple(run, **every_round):
            run.run(config, Path(folder), interrupt)
    except Interrupted:
        return
    raise RuntimeError(f"{folder}: the training was not interrupted")


def tabulate(folder: str) -> None:
    """Make `TABLES` of the runs in reference/runs, as the workflow's jobs do."""
    from mace_rl.runs.finished import read_runs
    from mace_study import results
    from mace_study.config.study import read_study
    from mace_study.plan import Plan

    os.chdir(ROOT)
    study = read_study([Path("config.yaml"), Path("reference/runs.yaml")])  # results: reference
    plan, goal = Plan(study, ROOT), Path(folder)
    goal.mkdir()
    records = [f"{run}/run.json" for run in plan.folders]
    frames = read_runs(records, plan.with_episodes, plan.run_settings)
    own = plan.with_episodes, plan.measured, plan.paper
    results.measure(frames, plan.measured, goal, ["figure1"], None)
    results.tabulate(goal, *own, study.labels)
    results.draw(goal, ["figure1"], *own, plan.style, judged=False)


if __name__ == "__main__":
    for what, *task in json.loads(sys.argv[1]):
        tabulate(*task) if what == "tables" else train(what, *task)
