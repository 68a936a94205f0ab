"""The generated parts of docs/performance.md: tables, between markers that name them."""

import re
from collections.abc import Sequence
from typing import Any

import pandas as pd

from benchmarks.aggregate import growth_summary, overhead, paper_budget, speed_summary
from benchmarks.breakdown import SECTIONS
from benchmarks.goals import STUDY_SEEDS, goals
from benchmarks.settings import ENVIRONMENTS, LABELS, OURS, REFERENCE, ROOT, VARIANTS, Scale
from benchmarks.workflow import CORES

TEMPLATE = ROOT / "docs" / "performance.md"


def write(scale: Scale) -> None:
    """Write the document with the tables of the data in `scale.data`, and summary.csv."""
    results = pd.read_csv(scale.data / "results.csv")
    times = pd.read_csv(scale.data / "breakdown.csv")
    growth = pd.read_csv(scale.data / "growth.csv")
    jobs = pd.read_csv(scale.data / "workflow.csv")
    planning = pd.read_csv(scale.data / "planning.csv")
    summary = speed_summary(results)
    summary.to_csv(scale.data / "summary.csv", index=False)
    tables = {
        "machine": machine(results),
        "goals": markdown(pd.DataFrame(goals(results, growth, jobs, planning)).fillna("")),
        "speed": speed_table(summary),
        "steps": steps_table(summary),
        "memory": memory_table(jobs),
        "breakdown": breakdown_table(times),
        "growth": growth_table(growth),
        "workflow": workflow_table(results, jobs, planning),
    }
    text = filled(TEMPLATE.read_text(encoding="utf-8"), tables)
    scale.document.write_text(text, encoding="utf-8")
    print(tables["goals"], f"\nAll tables: {scale.document}")


def machine(results: pd.DataFrame) -> str:
    """What it ran on, and whether the machine had other work."""
    first = results.iloc[0]
    share = (results["cpu_seconds"] / results["seconds"]).median()
    return (
        f"{first['cpu']}; {first['versions']}. The measured processes had the processor for "
        f"{share:.0%} of the time (median): well below 100 % means a busy machine."
    )


def filled(text: str, tables: dict[str, str]) -> str:
    """`text` with every `<!-- NAME -->` … `<!-- end of NAME -->` holding its table."""
    for name, table in tables.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
        pattern = re.escape(begin) + ".*?" + re.escape(end)
        replacement = f"{begin}\n{table}\n\n{end}"
        text, found = re.subn(pattern, lambda _, new=replacement: new, text, flags=re.DOTALL)
        if found != 1:
            raise ValueError(f"{TEMPLATE} has {found} places for {name!r}, but should have 1")
    return text


def markdown(table: pd.DataFrame, numbers: Sequence[str] = ()) -> str:
    """A Markdown table without the index; the columns `numbers` are right-aligned."""
    rows = [
        list(table.columns),
        ["--:" if column in numbers else "---" for column in table.columns],
        *table.astype(str).to_numpy().tolist(),
    ]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def speed_table(summary: pd.DataFrame) -> str:
    """Steps per second and ratio of every contestant; a second row for a later reading."""
    rows = []
    for contestant, label in LABELS.items():
        found = summary[summary["contestant"] == contestant]
        readings = {
            environment: of_environment.sort_values("target_steps").to_dict("records")
            for environment, of_environment in found.groupby("env")
        }
        for reading in range(max(map(len, readings.values()))):
            row = {"environment steps per second": label if reading == 0 else "… later in training"}
            for environment in ENVIRONMENTS:
                cells = readings.get(environment, [])[reading : reading + 1]
                row[environment] = "".join(map(rate, cells)) or "–"
            rows.append(row)
    return markdown(pd.DataFrame(rows), ENVIRONMENTS)


def rate(row: dict[str, Any]) -> str:
    """Median, range and ratio, from a row of `speed_summary`."""
    steps, low, high = row["steps_per_second"], row["slowest"], row["fastest"]
    return f"**{steps:,.0f}** ({low:,.0f} to {high:,.0f}) {row['ratio']:.1f}×"


def steps_table(summary: pd.DataFrame) -> str:
    """After how many steps the rates were read."""
    rows = {"everybody": REFERENCE, "ours, later in training": "ppo", "environment": "environment"}
    steps = summary.groupby(["contestant", "env"])["target_steps"].max().unstack("env")
    table = steps.loc[list(rows.values()), list(ENVIRONMENTS)].map("{:,.0f}".format)
    table.index = list(rows)
    return markdown(table.reset_index(names="steps"), ENVIRONMENTS)


def memory_table(jobs: pd.DataFrame) -> str:
    """Peak memory of the workflow's training jobs, the most of all seeds, MB."""
    peaks = jobs.groupby(["variant", "env"])["peak_memory_mb"].max().unstack("env")
    table = peaks.reindex(VARIANTS)[list(ENVIRONMENTS)].map("{:.0f}".format)
    return markdown(table.reset_index(names="peak memory, MB"), ENVIRONMENTS)


def breakdown_table(times: pd.DataFrame) -> str:
    """µs per step: sections by environment and contestant."""
    table = times.pivot(
        index="section", columns=["env", "contestant"], values="microseconds_per_step"
    )
    table = table.loc[list(SECTIONS), [(e, c) for e in ENVIRONMENTS for c in OURS]]
    table.loc["sum"] = table.sum()
    table.columns = [f"{environment} {contestant}" for environment, contestant in table.columns]
    table = table.map("{:.1f}".format).reset_index(names="µs per step")
    return markdown(table, table.columns[1:])


def growth_table(growth: pd.DataFrame) -> str:
    """One row per walk."""
    table = growth_summary(growth)
    formats = {
        "episodes": "{:.0f}",
        "env_steps": "{:,.0f}",
        "microseconds_per_step": "{:.1f}",
        "time_ratio": "{:.3f}",
        "memory_mb_second_tenth": "{:.0f}",
        "memory_mb_end": "{:.0f}",
    }
    for column, form in formats.items():
        table[column] = table[column].map(form.format)
    table.columns = [
        "environment",
        "episodes",
        "steps",
        "µs per step",
        "time per step, last tenth ÷ second",
        "MB after the second tenth",
        "MB at the end",
    ]
    return markdown(table, table.columns[1:])


def workflow_table(results: pd.DataFrame, jobs: pd.DataFrame, planning: pd.DataFrame) -> str:
    """What the small workflow took, what that means for the paper's, and the planning time."""
    small = overhead(jobs, CORES)
    study = paper_budget(results, small, STUDY_SEEDS, CORES)
    plan = planning.iloc[0]
    rows = [
        ("small workflow: training jobs", f"{len(jobs)}"),
        ("small workflow: wall time", f"{small['wall']:.1f} s"),
        ("before the first training: imports, planning", f"{small['before']:.1f} s"),
        ("after the last training: metrics, tables, figure", f"{small['after']:.1f} s"),
        ("per training job: imports, start and end", f"{small['per_job']:.1f} s"),
        ("paper's budgets: training jobs", f"{study['jobs']:.0f}"),
        ("paper's budgets: training, core time", f"{study['training'] / 3600:.2f} h"),
        (f"paper's budgets: wall time on {CORES} cores", f"{study['wall'] / 3600:.2f} h"),
        ("paper's budgets: share of core time outside training", f"{study['share']:.2%}"),
        (f"planning {plan['runs']:.0f} runs, `snakemake -n`", f"{plan['seconds']:.1f} s"),
    ]
    return markdown(pd.DataFrame(rows, columns=["what", "measured"]), ["measured"])
