"""What the project set out to reach, and what was measured."""

from collections.abc import Iterator

import pandas as pd

from benchmarks.aggregate import growth_summary, overhead, paper_budget, ratios
from benchmarks.settings import ACROBOT, CARTPOLE, HOPPER, OURS, REFERENCE
from benchmarks.workflow import CORES

STUDY_SEEDS = 5  # of config.yaml

# (what, over, under, environment, floor, aim): at least
SPEED_UPS = (
    ("our PPO, 2048 steps ÷ stable-baselines3", "ppo_2048", REFERENCE, CARTPOLE, 15, 40),
    ("our PPO, 2048 steps ÷ stable-baselines3", "ppo_2048", REFERENCE, ACROBOT, 15, 48),
    ("our PPO, 2048 steps ÷ stable-baselines3", "ppo_2048", REFERENCE, HOPPER, 3.5, 6),
    ("our PPO, default ÷ stable-baselines3", "ppo", REFERENCE, CARTPOLE, 12, 30),
    ("`mace_full` ÷ stable-baselines3", "mace_full", REFERENCE, CARTPOLE, 5, 12),
    ("`mace_full` ÷ stable-baselines3", "mace_full", REFERENCE, ACROBOT, 5, 12),
    ("our environment ÷ the library's, alone", "environment_fast", "environment", HOPPER, 2, 3),
)


def goals(
    results: pd.DataFrame, growth: pd.DataFrame, jobs: pd.DataFrame, planning: pd.DataFrame
) -> Iterator[dict[str, str]]:
    """One row per goal: what, measured, the same later in training, floor, aim."""
    for what, over, under, environment, floor, aim in SPEED_UPS:
        yield {
            "goal": f"{what}, {environment}",
            "measured": spread(ratios(results, environment, over, under, last=False), "×"),
            "later in training": spread(ratios(results, environment, over, under, last=True), "×")
            if over in OURS
            else "",
            "floor": f"{floor}×",
            "aim": f"{aim}×",
        }
    slower = ("ppo", "mace_full")  # steps per second of the one ÷ the other: time the other way
    yield {
        "goal": f"`mace_full` time per step ÷ our PPO's, {HOPPER}",
        "measured": spread(ratios(results, HOPPER, *slower, last=False), ""),
        "later in training": spread(ratios(results, HOPPER, *slower, last=True), ""),
        "floor": "≤ 1.5",
        "aim": "≤ 1.2",
    }
    runs = growth_summary(growth)
    study = paper_budget(results, overhead(jobs, CORES), STUDY_SEEDS, CORES)
    plan = planning.iloc[0]
    for goal, measured, floor, aim in (
        (
            "time per step, last tenth ÷ second tenth of a long `mace_full` run",
            ", ".join(f"{ratio:.2f}" for ratio in runs["time_ratio"]),
            "≤ 1.2",
            "1.0",
        ),
        (
            "peak memory of one training",
            f"{jobs['peak_memory_mb'].max():.0f} MB",
            "≤ 700 MB",
            "≤ 450 MB",
        ),
        (
            "share of `snakemake -j2 all` outside training, paper's budgets",
            f"{study['share']:.1%}",
            "≤ 5 %",
            "≤ 2 %",
        ),
        (
            f"planning (`snakemake -n`) of {plan['runs']:.0f} runs",
            f"{plan['seconds']:.0f} s",
            "≤ 60 s",
            "≤ 20 s",
        ),
    ):
        yield {"goal": goal, "measured": measured, "floor": floor, "aim": aim}


def spread(values: pd.Series, unit: str) -> str:
    """Median and range."""
    low, high = values.min(), values.max()
    return f"{values.median():.3g}{unit} ({low:.3g} to {high:.3g})"
