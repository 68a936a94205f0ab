"""benchmarks/README.md of benchmarks/measurements.csv: tables of each section, and a picture."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import pandas as pd

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from benchmarks import breakdown, purejaxrl, speed
from benchmarks.measuring import ENVIRONMENTS, FILE
from mace_rl.base.files import write_atomically

HEAD = """# Measurements

Written by `python -m benchmarks` (`make bench`) from [measurements.csv](measurements.csv): change
neither by hand. [docs/performance.md](../docs/performance.md) explains them.

Rates and ratios are medians over the repeats, with their range in brackets. The line below each
section's tables names its commit, which can be another one. An environment alone takes random
actions. `ppo_2048` is our PPO with 2048 steps and 4 full-batch epochs. Beside PureJaxRL everybody
was compiled for AVX2. Before commit 8a48ade `mace_full` was another variant.
"""
RATE = "environment steps per CPU second"


def write(folder: Path) -> Path:
    """Write the page of the folder's measurements, and return its path."""
    matplotlib.rcdefaults()  # not the user's
    rows = pd.read_csv(folder / FILE)
    text = HEAD
    for section, (title, tables) in SECTIONS.items():
        own = rows[rows["section"] == section].dropna(axis="columns", how="all")
        if len(own):
            machine = "; ".join(own["machine"].unique())
            text += f"\n## {title}\n\n{tables(own)}\n\n{machine}\n"
            if section in PICTURES:
                PICTURES[section](own).savefig(folder / f"{section}.png", dpi=120)
                text += f"\n![{title}]({section}.png)\n"
    write_atomically(folder / "README.md", text)
    return folder / "README.md"


def speed_section(rows: pd.DataFrame) -> str:
    """Steps per CPU second of everybody, with the ratio to the reference within each repeat."""
    share = (rows["cpu_seconds"] / rows["seconds"]).median()
    note = f"The measured processes had the processor for {share:.0%} of the time (median)."
    return f"{rates_table(rows, speed.LABELS)}\n\n{note}"


def purejaxrl_section(rows: pd.DataFrame) -> str:
    """The same with PureJaxRL, and ours relative to each of its; or why it was left out."""
    if "contestant" not in rows:
        return f"PureJaxRL was left out: {rows['note'].iloc[0]}"
    labels = {name: speed.LABELS[name] for name in (speed.REFERENCE, *speed.OURS)}
    labels |= purejaxrl.LABELS
    found, lines = rates(rows), []
    for environment in purejaxrl.ENVIRONMENTS:
        for ours in speed.OURS:
            ratios = (
                found[environment, ours] / found[environment, its] for its in purejaxrl.LABELS
            )
            cells = [median_and_range(ratio, ".2f") for ratio in ratios]
            lines.append([f"{labels[ours]}, {environment}", *cells])
    against = [f"÷ {label}" for label in purejaxrl.LABELS.values()]
    table = markdown(pd.DataFrame(lines, columns=[f"ratio of {RATE}", *against]), against)
    [packages] = rows["note"].dropna().unique()
    return f"{rates_table(rows, labels)}\n\n{table}\n\n{packages}"


def breakdown_section(rows: pd.DataFrame) -> str:
    """µs per step: parts of the program by environment and contestant."""
    columns = [(environment, name) for environment in ENVIRONMENTS for name in speed.OURS]
    rows = rows.assign(time=1e6 * rows["seconds"] / rows["steps"])
    table = rows.pivot(index="part", columns=["env", "contestant"], values="time")[columns]
    table.columns = [" ".join(column) for column in columns]
    table = table.loc[breakdown.ALL_SECTIONS]
    table.loc["sum"] = table.sum()
    return markdown(table.map("{:.1f}".format).reset_index(names="µs per step"), table.columns)


SECTIONS = {
    "speed": ("Speed", speed_section),
    "purejaxrl": ("Beside PureJaxRL", purejaxrl_section),
    "breakdown": ("Where a step's time goes", breakdown_section),
}


def draw_speed(rows: pd.DataFrame) -> plt.Figure:
    """Steps per CPU second, logarithmic: medians as bars, ranges as whiskers."""
    figure, panels = plt.subplots(
        1, 3, figsize=(13, 3.4), sharex=True, sharey=True, layout="constrained"
    )
    for panel, environment in zip(panels, ENVIRONMENTS, strict=True):
        by = rates(rows)[environment].groupby("contestant")
        median, low, high = (
            by.agg(name).reindex(speed.LABELS) for name in ("median", "min", "max")
        )
        panel.barh(list(speed.LABELS.values()), median, xerr=[median - low, high - median])
        panel.set(xscale="log", xlim=(1e3, 5e5), title=environment, xlabel=RATE)
        panel.grid(axis="x", alpha=0.3)
    panels[0].invert_yaxis()
    return figure


PICTURES = {"speed": draw_speed}


def rates(rows: pd.DataFrame) -> pd.Series:
    """Steps per CPU second by environment, contestant and repeat."""
    by = rows.set_index(["env", "contestant", "repeat"]).sort_index()
    return by["steps"] / by["cpu_seconds"]


def rates_table(rows: pd.DataFrame, labels: dict[str, str]) -> str:
    """Median and range over the repeats, and the median ratio to the reference in a repeat."""
    cells = {}
    for (environment, contestant), rate in rates(rows).groupby(level=["env", "contestant"]):
        reference = rates(rows)[environment, speed.REFERENCE]
        ratio = (rate.droplevel(["env", "contestant"]) / reference).median()
        cells[contestant, environment] = f"{median_and_range(rate, ',.0f')}, {ratio:.1f}×"
    table = pd.Series(cells).unstack().reindex(labels).rename(index=labels).fillna("–")
    there = [environment for environment in ENVIRONMENTS if environment in table]
    name = f"{RATE} (× {labels[speed.REFERENCE]})"
    return markdown(table[there].reset_index(names=name), there)


def median_and_range(values: pd.Series, form: str) -> str:
    """Over the repeats."""
    numbers = (format(value, form) for value in (values.median(), values.min(), values.max()))
    return "{} ({} to {})".format(*numbers)


def markdown(table: pd.DataFrame, numbers: Sequence[str]) -> str:
    """A Markdown table without the index; the columns `numbers` are right-aligned."""
    rows = [
        list(table.columns),
        ["--:" if column in numbers else "---" for column in table.columns],
        *table.astype(str).to_numpy().tolist(),
    ]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
