"""From measurements to numbers: what the tables and pictures of docs/performance.md show."""

from collections.abc import Sequence

import pandas as pd

from benchmarks.settings import (
    ACROBOT,
    CARTPOLE,
    CORES,
    HOPPER,
    REFERENCE,
    VARIANTS,
)

# Environment steps of one training at the paper's budgets (2000, 2000, 6000 episodes), about: means
# of `env_steps` in reference/tables/study/metrics.csv.
PAPER_STEPS = {CARTPOLE: 972_000, ACROBOT: 190_000, HOPPER: 4_770_000}
STUDY_SEEDS = 10
GROWTH = "time per step, last tenth ÷ second"


def speed_summary(results: pd.DataFrame) -> pd.DataFrame:
    """One row per environment, contestant and reading: medians, ranges, ratio to the reference.

    The ratio is taken within a repeat, in which everything was measured at nearly the same time.
    The reference is read once in a training; its speed does not depend on when.
    """
    reference = results[results["contestant"] == REFERENCE].set_index(["env", "repeat"])
    rows = results.join(reference["steps_per_second"].rename("reference"), on=["env", "repeat"])
    rows["ratio"] = rows["steps_per_second"] / rows["reference"]
    rows["cpu_share"] = rows["cpu_seconds"] / rows["seconds"]
    by_reading = rows.groupby(["env", "contestant", "target_steps"], sort=False, as_index=False)
    return by_reading.agg(
        repeats=("repeat", "size"),
        steps_per_second=("steps_per_second", "median"),
        slowest=("steps_per_second", "min"),
        fastest=("steps_per_second", "max"),
        ratio=("ratio", "median"),
        ratio_lowest=("ratio", "min"),
        ratio_highest=("ratio", "max"),
        cpu_share=("cpu_share", "median"),
        peak_memory_mb=("peak_memory_mb", "max"),
    )


def rates(results: pd.DataFrame) -> pd.DataFrame:
    """Steps per second at the first and the last reading, by environment, contestant, repeat."""
    rows = results.sort_values("target_steps").groupby(["env", "contestant", "repeat"])
    return rows["steps_per_second"].agg(["first", "last"])


def growth_summary(growth: pd.DataFrame) -> pd.DataFrame:
    """One row per walk."""
    rows = []
    for walk, run in growth.groupby("env", sort=False):
        tenth = len(run) // 10
        at = run[["env_steps", "cpu_seconds", "memory_mb"]].iloc
        parts = at[-1], at[-1] - at[-1 - tenth], at[2 * tenth - 1] - at[tenth - 1]
        whole, last, second = (part["cpu_seconds"] / part["env_steps"] for part in parts)
        rows.append(
            {
                "environment": walk,
                "episodes": len(run),
                "steps": at[-1]["env_steps"],
                "µs per step": 1e6 * whole,
                GROWTH: last / second,
                "MB after the second tenth": at[2 * tenth - 1]["memory_mb"],
                "MB at the end": at[-1]["memory_mb"],
            }
        )
    return pd.DataFrame(rows)


def makespan(durations: Sequence[float], cores: int) -> float:
    """When the last of these jobs ends if the longest ones start first."""
    free_at = [0.0] * cores
    for duration in sorted(durations, reverse=True):
        free_at[free_at.index(min(free_at))] += duration
    return max(free_at)


def paper_budget(results: pd.DataFrame, jobs: pd.DataFrame) -> dict[str, float]:
    """What the small workflow spent outside training, and hence the paper's study; seconds.

    before, after: from the start of Snakemake to the first training job, and from the end of the
    last one, wall time. per_job: all core time between the two that was not training, idle cores
    included, divided by the number of jobs. In the study a training takes `PAPER_STEPS` at the
    median rate of its last reading. share: of its core time, outside training.
    """
    workflow_began, workflow_ended = jobs.loc[0, ["workflow_began", "workflow_ended"]]
    began, ended = jobs["job_began"].min(), jobs["job_ended"].max()
    before, after = began - workflow_began, workflow_ended - ended
    per_job = (CORES * (ended - began) - jobs["training_seconds"].sum()) / len(jobs)
    rate = rates(results)["last"].groupby(["env", "contestant"]).median()
    trainings = STUDY_SEEDS * [
        steps / rate[environment, variant]
        for environment, steps in PAPER_STEPS.items()
        for variant in VARIANTS
    ]
    wall = before + makespan([seconds + per_job for seconds in trainings], CORES) + after
    return {
        "small_jobs": len(jobs),
        "small_wall": workflow_ended - workflow_began,
        "before": before,
        "after": after,
        "per_job": per_job,
        "jobs": len(trainings),
        "training": sum(trainings),
        "wall": wall,
        "share": 1 - sum(trainings) / (CORES * wall),
    }
