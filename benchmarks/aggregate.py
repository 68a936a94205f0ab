"""From measurements to the numbers in tables and plots: pure functions of data frames."""

from collections.abc import Sequence

import pandas as pd

from benchmarks.settings import ACROBOT, CARTPOLE, HOPPER, REFERENCE, VARIANTS

# Environment steps of one training at the paper's budgets (2000, 2000, 6000 episodes), about: those
# of `mace-rl train --variant ppo --seed 1000`, Hopper's extrapolated from 3800 episodes.
PAPER_STEPS = {CARTPOLE: 918_000, ACROBOT: 215_000, HOPPER: 3_800_000}


def first_target(results: pd.DataFrame) -> pd.Series:
    """Whether a row is its training's first reading, after as many steps as everybody's, [rows]."""
    first = results.groupby(["env", "contestant"])["target_steps"].transform("min")
    return results["target_steps"] == first


def ratios(results: pd.DataFrame, environment: str, over: str, under: str, last: bool) -> pd.Series:
    """Steps per second of contestant `over` ÷ those of `under`, one for each repeat.

    Within a repeat both were measured at nearly the same time. At the first reading of both, or
    at the last of both.
    """
    rows = results[(results["env"] == environment) & (first_target(results) | last)]
    rates = rows.sort_values("target_steps").groupby(["contestant", "repeat"])["steps_per_second"]
    rates = rates.last()
    return rates[over] / rates[under]


def speed_summary(results: pd.DataFrame) -> pd.DataFrame:
    """One row per environment, contestant and reading: medians, ranges, ratio to the reference.

    The reference, `REFERENCE`, is read once in a training; its speed does not depend on when.
    """
    rows = []
    for (environment, contestant, target), group in results.groupby(
        ["env", "contestant", "target_steps"], sort=False
    ):
        rate = group.set_index("repeat")["steps_per_second"]
        reference = results[(results["env"] == environment) & (results["contestant"] == REFERENCE)]
        ratio = rate / reference.set_index("repeat")["steps_per_second"]
        rows.append(
            {
                "env": environment,
                "contestant": contestant,
                "target_steps": target,
                "repeats": len(group),
                "steps_per_second": rate.median(),
                "slowest": rate.min(),
                "fastest": rate.max(),
                "ratio": ratio.median(),
                "ratio_lowest": ratio.min(),
                "ratio_highest": ratio.max(),
                "cpu_share": (group["cpu_seconds"] / group["seconds"]).median(),
                "peak_memory_mb": group["peak_memory_mb"].max(),
            }
        )
    return pd.DataFrame(rows)


def growth_ratio(episodes: pd.DataFrame) -> float:
    """Time per step of the last tenth of a run ÷ that of its second tenth.

    episodes: one row per episode, with `env_steps` and `cpu_seconds` since the start.
    """
    tenth = len(episodes) // 10
    at = episodes[["env_steps", "cpu_seconds"]].reset_index(drop=True)
    second = at.iloc[2 * tenth - 1] - at.iloc[tenth - 1]
    last = at.iloc[-1] - at.iloc[-1 - tenth]
    return (last["cpu_seconds"] / last["env_steps"]) / (second["cpu_seconds"] / second["env_steps"])


def growth_summary(growth: pd.DataFrame) -> pd.DataFrame:
    """One row per walk: the ratio above, and memory at the ends of second and last tenth."""
    rows = []
    for walk, episodes in growth.groupby("env", sort=False):
        tenth = len(episodes) // 10
        rows.append(
            {
                "env": walk,
                "episodes": len(episodes),
                "env_steps": episodes["env_steps"].iloc[-1],
                "microseconds_per_step": 1e6
                * episodes["cpu_seconds"].iloc[-1]
                / episodes["env_steps"].iloc[-1],
                "time_ratio": growth_ratio(episodes),
                "memory_mb_second_tenth": episodes["memory_mb"].iloc[2 * tenth - 1],
                "memory_mb_end": episodes["memory_mb"].iloc[-1],
            }
        )
    return pd.DataFrame(rows)


def overhead(jobs: pd.DataFrame, cores: int) -> dict[str, float]:
    """What a real run of the workflow spent outside training; seconds.

    before, after: from the start of Snakemake to the first training job, and from the end of the
    last one, wall time. per_job: all core time between the two that was not training, idle cores
    included, divided by the number of jobs. share: of the core time of the whole.
    """
    wall = jobs["workflow_ended"].iloc[0] - jobs["workflow_began"].iloc[0]
    began, ended = jobs["job_began"].min(), jobs["job_ended"].max()
    training = jobs["training_seconds"].sum()
    return {
        "wall": wall,
        "before": began - jobs["workflow_began"].iloc[0],
        "after": jobs["workflow_ended"].iloc[0] - ended,
        "per_job": (cores * (ended - began) - training) / len(jobs),
        "share": 1 - training / (cores * wall),
    }


def makespan(durations: Sequence[float], cores: int) -> float:
    """When the last of these jobs ends if the longest ones start first."""
    free_at = [0.0] * cores
    for duration in sorted(durations, reverse=True):
        free_at[free_at.index(min(free_at))] += duration
    return max(free_at)


def paper_budget(
    results: pd.DataFrame, measured: dict[str, float], seeds: int, cores: int
) -> dict[str, float]:
    """The same for the paper's study, from measured rates and the `overhead` of a small workflow.

    A training takes `PAPER_STEPS` at the median rate of its last reading; a job that and the
    measured overhead per job; the workflow the makespan of its jobs and what comes before and
    after. Seconds, and the share of core time outside training.
    """
    last = results.sort_values("target_steps").groupby(["env", "contestant", "repeat"]).last()
    rates = last["steps_per_second"].groupby(["env", "contestant"]).median()
    trainings = [
        steps / rates[environment, variant]
        for environment, steps in PAPER_STEPS.items()
        for variant in VARIANTS
        for _ in range(seeds)
    ]
    jobs = [seconds + measured["per_job"] for seconds in trainings]
    wall = measured["before"] + makespan(jobs, cores) + measured["after"]
    return {
        "jobs": len(jobs),
        "training": sum(trainings),
        "wall": wall,
        "share": 1 - sum(trainings) / (cores * wall),
    }
