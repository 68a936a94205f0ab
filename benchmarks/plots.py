"""The pictures of docs/performance.md, drawn from the data alone, as PNG and SVG."""

from pathlib import Path

import matplotlib
import pandas as pd

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.breakdown import SECTIONS
from benchmarks.settings import ENVIRONMENTS, LABELS, OURS

matplotlib.rcParams["svg.hashsalt"] = "mace-rl"  # the same data gives the same file
GREY, BLUE, ORANGE = "#9e9e9e", "#1f77b4", "#ff7f0e"


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write `name`.png and `name`.svg."""
    figure.savefig(folder / f"{name}.png", dpi=150)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    plt.close(figure)


def speed(summary: pd.DataFrame, folder: Path) -> None:
    """Steps per second, logarithmic: medians as bars, ranges as whiskers."""
    names = list(LABELS)
    figure, panels = plt.subplots(1, 3, figsize=(13, 4.2), sharey=True, layout="constrained")
    for panel, environment in zip(panels, ENVIRONMENTS, strict=True):
        rows = summary[summary["env"] == environment].drop_duplicates("contestant").copy()
        rows["y"] = [names.index(name) for name in rows["contestant"]]
        colours = [
            ORANGE if name in OURS else BLUE if name.startswith("sb3") else GREY
            for name in rows["contestant"]
        ]
        median = rows["steps_per_second"]
        whiskers = [median - rows["slowest"], rows["fastest"] - median]
        panel.barh(rows["y"], median, color=colours, xerr=whiskers, ecolor="black", capsize=2)
        for y, rate, ratio, end in rows[["y", "steps_per_second", "ratio", "fastest"]].to_numpy():
            panel.text(end * 1.15, y, f"{rate:,.0f}  ({ratio:.1f}×)", va="center", fontsize=8)
        panel.set(xscale="log", title=environment, xlabel="environment steps per second")
        panel.set_xlim(median.min() / 2, median.max() * 50)
        panel.grid(axis="x", alpha=0.3)
        panel.set_axisbelow(True)
    panels[0].set_yticks(range(len(names)), LABELS.values())
    panels[0].invert_yaxis()
    figure.suptitle(f"One core, from scratch; in brackets the ratio to {LABELS['sb3_2048x4']}")
    save(figure, folder, "speed")


def breakdown(times: pd.DataFrame, folder: Path) -> None:
    """µs per step by section, stacked."""
    figure, panels = plt.subplots(1, 3, figsize=(13, 4.5), layout="constrained")
    colours = plt.get_cmap("tab10").colors
    for panel, environment in zip(panels, ENVIRONMENTS, strict=True):
        table = times[times["env"] == environment].pivot(
            index="contestant", columns="section", values="microseconds_per_step"
        )
        stack(panel, table.loc[list(OURS), list(SECTIONS)].clip(lower=0), colours)
        panel.set(title=environment, ylabel="µs per environment step")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles[::-1], labels[::-1], loc="outside right center", fontsize=9)
    save(figure, folder, "breakdown")


def stack(panel: Axes, table: pd.DataFrame, colours: list) -> None:
    """One bar per row, its columns stacked, the sum on top."""
    bottom = pd.Series(0.0, table.index)
    for (section, values), colour in zip(table.items(), colours, strict=True):
        panel.bar(table.index, values, bottom=bottom, label=section, color=colour)
        bottom += values
    for x, total in enumerate(bottom):
        panel.text(x, total, f"{total:.0f}", ha="center", va="bottom", fontsize=9)
    panel.margins(y=0.1)
    panel.tick_params(axis="x", labelsize=8)


def growth(episodes: pd.DataFrame, folder: Path) -> None:
    """µs per step and memory over the steps of long `mace_full` runs."""
    figure, (times, memory) = plt.subplots(1, 2, figsize=(10, 3.5), layout="constrained")
    for walk, rows in episodes.groupby("env", sort=False):
        per_step = 1e6 * rows["cpu_seconds"].diff() / rows["env_steps"].diff()
        window = max(1, len(rows) // 20)
        times.plot(rows["env_steps"], per_step.rolling(window).mean(), label=walk)
        memory.plot(rows["env_steps"], rows["memory_mb"], label=walk)
    times.set(ylabel="µs per step, moving average", xlabel="environment steps", ylim=(0, None))
    memory.set(ylabel="resident memory, MB", xlabel="environment steps")
    memory.set_ylim(0, 1.3 * episodes["memory_mb"].max())
    memory.legend()
    save(figure, folder, "growth")
