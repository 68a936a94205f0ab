"""Tables and pictures of docs/performance.md from the measurements; tables between markers."""

import re
from collections.abc import Sequence
from functools import partial

import matplotlib
import pandas as pd

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from benchmarks import arithmetic, purejaxrl, start, update, wrapper
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
    ROOT,
    VARIANTS,
    Scale,
)

# Environment steps of one training at the paper's budgets (2000, 2000, 6000 episodes), about: means
# of `env_steps` in reference/tables/study/metrics.csv.
PAPER_STEPS = {CARTPOLE: 972_000, ACROBOT: 190_000, HOPPER: 4_770_000}
STUDY_SEEDS = 10
GROWTH = "time per step, last tenth ÷ second"

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


def measure_all(scale: Scale) -> None:
    """Write the document and the pictures of the data in `scale.data`, and summary.csv."""
    names = ("results", "breakdown", "growth", "workflow", "planning", "start", "wrapper")
    names += ("purejaxrl", "arithmetic", "update")
    data = [pd.read_csv(scale.data / f"{name}.csv") for name in names]
    results, times, growth, jobs, planning, starts, costs, peers, prices, one_update = data
    summary = speed_summary(results)
    summary.to_csv(scale.data / "summary.csv", index=False)
    draw_speed(summary, scale)
    draw_breakdown(times, scale)
    draw_growth(growth, scale)
    study, plan = paper_budget(results, jobs), planning.iloc[0]
    tables = {
        "machine": machine(results),
        "goals": goals(results, growth, jobs, study, plan),
        "speed": speed_table(summary),
        "steps": steps_table(summary),
        "memory": memory_table(jobs),
        "breakdown": breakdown_table(times),
        "growth": growth_table(growth),
        "workflow": workflow_table(study, plan),
        "start": start_table(starts),
        "wrapper": wrapper.table(costs),
        "purejaxrl": purejaxrl_tables(peers),
        "arithmetic": arithmetic_table(prices),
        "update": update_table(one_update),
    }
    text = filled((ROOT / "docs" / "performance.md").read_text(encoding="utf-8"), tables)
    scale.document.write_text(text, encoding="utf-8")
    print(tables["goals"], f"\nAll tables: {scale.document}")


# --- from measurements to numbers -----------------------------------------------------------------


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


# --- tables ---------------------------------------------------------------------------------------


def filled(text: str, tables: dict[str, str]) -> str:
    """`text` with every `<!-- NAME -->` … `<!-- end of NAME -->` holding its table."""
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
        pattern = re.escape(begin) + ".*?" + re.escape(end)
        replacement = f"{begin}\n{table}\n\n{end}"
        text, found = re.subn(pattern, lambda _, new=replacement: new, text, flags=re.DOTALL)
        if found != 1:
            raise ValueError(f"the document has {found} places for {name!r}, but should have 1")
    return text


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


# --- pictures -------------------------------------------------------------------------------------

subplots = partial(plt.subplots, layout="constrained")


def draw_speed(summary: pd.DataFrame, scale: Scale) -> None:
    """Steps per second, logarithmic: medians as bars, ranges as whiskers."""
    figure, panels = subplots(1, 3, figsize=(13, 4.2), sharey=True)
    for panel, environment in zip(panels, ENVIRONMENTS, strict=True):
        rows = summary[summary["env"] == environment].drop_duplicates("contestant")
        rows = rows.set_index("contestant").reindex(LABELS)
        median, fastest = rows["steps_per_second"], rows["fastest"]
        colours = ["#9e9e9e"] * 2 + ["#1f77b4"] * 2 + ["#ff7f0e"] * len(OURS)
        whiskers = [median - rows["slowest"], fastest - median]
        panel.barh(range(len(rows)), median, color=colours, xerr=whiskers, capsize=2)
        for y, (rate, ratio, end) in enumerate(zip(median, rows["ratio"], fastest, strict=True)):
            if rate > 0:
                panel.text(end * 1.15, y, f"{rate:,.0f}  ({ratio:.1f}×)", va="center", fontsize=8)
        panel.set(xscale="log", title=environment, xlabel="environment steps per second")
        panel.set_xlim(median.min() / 2, median.max() * 50)
        panel.grid(axis="x", alpha=0.3)
        panel.set_axisbelow(True)
    panels[0].set_yticks(range(len(LABELS)), LABELS.values())
    panels[0].invert_yaxis()
    figure.suptitle(f"One core, from scratch; in brackets the ratio to {LABELS[REFERENCE]}")
    figure.savefig(scale.pictures / "speed.png", dpi=150)


def draw_breakdown(times: pd.DataFrame, scale: Scale) -> None:
    """µs per step by section, stacked, with the sum on top."""
    figure, panels = subplots(1, 3, figsize=(13, 4.5))
    for panel, environment in zip(panels, ENVIRONMENTS, strict=True):
        table = times[times["env"] == environment].pivot(
            index="contestant", columns="section", values="microseconds_per_step"
        )
        table = table.loc[list(OURS), ALL_SECTIONS].clip(lower=0)
        table.plot.bar(
            stacked=True, ax=panel, colormap="tab10", width=0.8, legend=False, rot=0, fontsize=8
        )
        panel.bar_label(panel.containers[-1], [f"{total:.0f}" for total in table.sum(axis=1)])
        panel.set(title=environment, xlabel="", ylabel="µs per environment step")
        panel.margins(y=0.1)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside right center", fontsize=9)
    figure.savefig(scale.pictures / "breakdown.png", dpi=150)


def draw_growth(episodes: pd.DataFrame, scale: Scale) -> None:
    """µs per step and memory over the steps of long `mace_full` runs."""
    figure, (times, memory) = subplots(1, 2, figsize=(10, 3.5))
    for walk, rows in episodes.groupby("env", sort=False):
        per_step = 1e6 * rows["cpu_seconds"].diff() / rows["env_steps"].diff()
        window = max(1, len(rows) // 20)
        times.plot(rows["env_steps"], per_step.rolling(window).mean(), label=walk)
        memory.plot(rows["env_steps"], rows["memory_mb"], label=walk)
    times.set(ylabel="µs per step, moving average", xlabel="environment steps", ylim=(0, None))
    memory.set(ylabel="resident memory, MB", xlabel="environment steps")
    memory.set_ylim(0, 1.3 * episodes["memory_mb"].max())
    memory.legend()
    figure.savefig(scale.pictures / "growth.png", dpi=150)
