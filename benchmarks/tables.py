"""The tables of docs/performance.md, as Markdown."""

from collections.abc import Sequence

import pandas as pd

from benchmarks import arithmetic, purejaxrl, start, update
from benchmarks.breakdown import ALL_SECTIONS
from benchmarks.settings import (
    ACROBOT,
    CARTPOLE,
    CORES,
    ENVIRONMENTS,
    HOPPER,
    LABELS,
    OURS,
    REFERENCE,
    VARIANTS,
)
from benchmarks.summaries import GROWTH, growth_summary, rates, speed_summary

# What the project set out to reach in steps per second of the first contestant ÷ the second's:
# goal, contestants, environment, floor, aim. The other goals are in `goals`.
RATIOS = (
    ("our PPO, 2048 steps ÷ stable-baselines3", "ppo_2048", REFERENCE, CARTPOLE, "15×", "40×"),
    ("our PPO, 2048 steps ÷ stable-baselines3", "ppo_2048", REFERENCE, ACROBOT, "15×", "48×"),
    ("our PPO, 2048 steps ÷ stable-baselines3", "ppo_2048", REFERENCE, HOPPER, "3.5×", "6×"),
    ("our PPO, default ÷ stable-baselines3", "ppo", REFERENCE, CARTPOLE, "12×", "30×"),
    ("`mace_full` ÷ stable-baselines3", "mace_full", REFERENCE, CARTPOLE, "5×", "12×"),
    ("`mace_full` ÷ stable-baselines3", "mace_full", REFERENCE, ACROBOT, "5×", "12×"),
    ("our environment ÷ the library's", "environment_fast", "environment", HOPPER, "2×", "3×"),
    ("`mace_full` time per step ÷ our PPO's", "ppo", "mace_full", HOPPER, "≤ 1.5", "≤ 1.2"),
)


def markdown(table: pd.DataFrame, numbers: Sequence[str] = ()) -> str:
    """A Markdown table without the index; the columns `numbers` are right-aligned."""
    rows = [
        list(table.columns),
        ["--:" if column in numbers else "---" for column in table.columns],
        *table.astype(str).to_numpy().tolist(),
    ]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def machine(results: pd.DataFrame) -> str:
    """What it ran on, and whether the machine had other work."""
    first = results.iloc[0]
    share = (results["cpu_seconds"] / results["seconds"]).median()
    return (
        f"{first['cpu']}; {first['versions']}. The measured processes had the processor for "
        f"{share:.0%} of the time (median): well below 100 % means a busy machine."
    )


def goals(
    results: pd.DataFrame,
    growth: pd.DataFrame,
    jobs: pd.DataFrame,
    study: dict[str, float],
    plan: pd.Series,
) -> str:
    """What was to be reached and what was: the median over repeats and the range."""
    rows, measured = [], rates(results)
    for goal, over, under, environment, floor, aim in RATIOS:
        found = measured.loc[environment, over] / measured.loc[environment, under]
        unit = "×" if "×" in aim else ""
        first, last = (
            f"{ratio.median():.3g}{unit} ({ratio.min():.3g} to {ratio.max():.3g})"
            for _, ratio in found.items()
        )
        rows.append((f"{goal}, {environment}", first, last if over in OURS else "", floor, aim))
    per_step = ", ".join(f"{ratio:.2f}" for ratio in growth_summary(growth)[GROWTH])
    peak = f"{jobs['peak_memory_mb'].max():.0f} MB"
    share = "share of `snakemake -j2 all` outside training, paper's budgets"
    planning = f"planning (`snakemake -n`) of {plan['runs']:.0f} runs"
    long_run = "time per step, last tenth ÷ second tenth of a long `mace_full` run"
    rows += [
        (long_run, per_step, "", "≤ 1.2", "1.0"),
        ("peak memory of one training of 200 episodes", peak, "", "≤ 700 MB", "≤ 450 MB"),
        (share, f"{study['share']:.1%}", "", "≤ 5 %", "≤ 2 %"),
        (planning, f"{plan['seconds']:.0f} s", "", "≤ 60 s", "≤ 20 s"),
    ]
    columns = ["goal", "measured", "later in training", "floor", "aim"]
    return markdown(pd.DataFrame(rows, columns=columns))


def speed_table(
    summary: pd.DataFrame,
    labels: dict[str, str] = LABELS,
    name: str = "environment steps per second",
) -> str:
    """Median, range and ratio of every contestant; a second row for a later reading."""
    rows = summary.sort_values("target_steps")
    rows["reading"] = rows.groupby(["env", "contestant"]).cumcount()
    rows["cell"] = [
        f"**{row.steps_per_second:,.0f}** ({row.slowest:,.0f} to {row.fastest:,.0f}) "
        f"{row.ratio:.1f}×"
        for row in rows.itertuples()
    ]
    table = rows.pivot(index=["contestant", "reading"], columns="env", values="cell").fillna("–")
    table = table.reindex(labels, level=0)
    table.index = [labels[who] if n == 0 else "… later in training" for who, n in table.index]
    return by_environment(name, table, "")


def steps_table(summary: pd.DataFrame) -> str:
    """After how many steps the rates were read."""
    rows = {"everybody": REFERENCE, "ours, later in training": "ppo", "environment": "environment"}
    steps = summary.groupby(["contestant", "env"])["target_steps"].max().unstack("env")
    return by_environment("steps", steps.loc[rows.values()].set_axis(rows), ",.0f")


def memory_table(jobs: pd.DataFrame) -> str:
    """Peak memory of the workflow's training jobs, the most of all seeds, MB."""
    peaks = jobs.groupby(["variant", "env"])["peak_memory_mb"].max().unstack("env")
    return by_environment("peak memory, MB", peaks.reindex(VARIANTS), ".0f")


def by_environment(name: str, table: pd.DataFrame, form: str) -> str:
    """`table`, whose columns are environments and whose index is called `name`."""
    there = [environment for environment in ENVIRONMENTS if environment in table]
    cells = table[there].map(lambda value: format(value, form))
    return markdown(cells.reset_index(names=name), there)


def breakdown_table(times: pd.DataFrame) -> str:
    """µs per step: sections by environment and contestant."""
    columns = [(environment, name) for environment in ENVIRONMENTS for name in OURS]
    table = times.pivot(
        index="section", columns=["env", "contestant"], values="microseconds_per_step"
    ).loc[ALL_SECTIONS, columns]
    table.loc["sum"] = table.sum()
    table.columns = [" ".join(column) for column in columns]
    table = table.map("{:.1f}".format).reset_index(names="µs per step")
    return markdown(table, table.columns[1:])


def growth_table(growth: pd.DataFrame) -> str:
    """One row per walk."""
    table = growth_summary(growth).astype(object)
    for column, form in zip(table, ("", ".0f", ",.0f", ".1f", ".3f", ".0f", ".0f"), strict=True):
        table[column] = [format(value, form) for value in table[column]]
    return markdown(table, table.columns[1:])


def workflow_table(study: dict[str, float], plan: pd.Series) -> str:
    """What the small workflow took, what that means for the paper's, and the planning time."""
    rows = {
        "small workflow: training jobs": f"{study['small_jobs']}",
        "small workflow: wall time": f"{study['small_wall']:.1f} s",
        "before the first training: imports, planning": f"{study['before']:.1f} s",
        "after the last training: metrics, tables, figure": f"{study['after']:.1f} s",
        "per training job: imports, start and end": f"{study['per_job']:.1f} s",
        "paper's budgets: training jobs": f"{study['jobs']}",
        "paper's budgets: training, core time": f"{study['training'] / 3600:.2f} h",
        f"paper's budgets: wall time on {CORES} cores": f"{study['wall'] / 3600:.2f} h",
        "paper's budgets: share of core time outside training": f"{study['share']:.2%}",
        f"planning {plan['runs']:.0f} runs, `snakemake -n`": f"{plan['seconds']:.1f} s",
    }
    return markdown(pd.DataFrame(rows.items(), columns=["what", "measured"]), ["measured"])


def start_table(starts: pd.DataFrame) -> str:
    """Seconds of each part, and of a job those by hand; the ratio is taken within a repeat."""
    columns = {"cpu_seconds": "CPU time", "seconds": "wall time"}
    table = starts.pivot(index="repeat", columns="what", values=list(columns))
    rows = {
        f"{what}, s": [median_and_range(table[column][what], ".2f") for column in columns]
        for what in starts["what"].unique()
    }
    rows["job ÷ by hand"] = [
        median_and_range(table[column][start.JOB] / table[column][start.HAND], ".2f")
        for column in columns
    ]
    found = pd.DataFrame(rows, index=list(columns.values())).T
    return markdown(found.reset_index(names="start and end of a run"), list(columns.values()))


def purejaxrl_tables(rows: pd.DataFrame) -> str:
    """Steps per CPU second of everybody, ours relative to PureJaxRL's, what ran; or why nothing."""
    if "left_out" in rows:
        return f"PureJaxRL was left out: {rows['left_out'][0]}"
    rows = rows.assign(steps_per_second=rows["steps"] / rows["cpu_seconds"])
    labels = {name: LABELS[name] for name in purejaxrl.OTHERS} | purejaxrl.LABELS
    speeds = speed_table(speed_summary(rows), labels, "environment steps per CPU second")
    rate, ratios = rates(rows)["first"], []
    for environment in purejaxrl.ENVIRONMENTS:
        for ours in [name for name in purejaxrl.OTHERS if name in OURS]:
            found = (rate[environment, ours] / rate[environment, its] for its in purejaxrl.LABELS)
            cells = [median_and_range(ratio, ".2f") for ratio in found]
            ratios.append([f"{labels[ours]}, {environment}", *cells])
    against = [f"÷ {label}" for label in purejaxrl.LABELS.values()]
    columns = ["ratio of steps per CPU second", *against]
    relative = markdown(pd.DataFrame(ratios, columns=columns), against)
    its_versions = rows.set_index("contestant")["versions"][list(purejaxrl.LABELS)].iloc[0]
    return f"{speeds}\n\n{relative}\n\n{machine(rows)} {its_versions}."


def arithmetic_table(rows: pd.DataFrame) -> str:
    """Steps per CPU second with portable arithmetic and with native, their ratio, what ran."""
    lines = []
    for (environment, contestant), own in rows.groupby(["env", "contestant"], sort=False):
        rate = own.pivot(index="seed", columns="arithmetic", values="steps_per_cpu_second")
        cells = [median_and_range(rate[kind], ",.0f") for kind in arithmetic.KINDS]
        ratio = median_and_range(rate["portable"] / rate["native"], ".2f")
        lines.append([f"{contestant}, {environment}", *cells, ratio, len(rate)])
    columns = [*arithmetic.KINDS, "portable ÷ native", "repeats"]
    table = pd.DataFrame(lines, columns=["steps per CPU second", *columns])
    used = [
        f"{kind}: {', '.join(f'{name} {own[name].iloc[0]}' for name in arithmetic.LIBRARIES)}"
        for kind, own in rows.groupby("arithmetic", sort=False)
    ]
    return f"{markdown(table, columns)}\n\n{'; '.join(used)}."


def update_table(rows: pd.DataFrame) -> str:
    """µs of each part of an update by what may use all of the processor; *: other bits."""
    lines = []
    for part, own in rows.groupby("part", sort=False):
        times = own.pivot(index="repeat", columns="kind", values="microseconds")
        bits = own.groupby("kind")["digest"].unique()
        cells = [
            median_and_range(times[kind], ".1f")
            + "*" * (list(bits[kind]) != list(bits["portable"]))
            for kind in update.KINDS
        ]
        lines.append([part, *cells, median_and_range(times["native"] / times["portable"], ".2f")])
    columns = [*update.KINDS, "native ÷ portable"]
    return markdown(pd.DataFrame(lines, columns=["µs of CPU time", *columns]), columns)


def median_and_range(values: pd.Series, form: str) -> str:
    """Over the repeats."""
    numbers = (format(value, form) for value in (values.median(), values.min(), values.max()))
    return "{} ({} to {})".format(*numbers)
