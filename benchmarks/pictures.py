"""The pictures of docs/performance.md."""

from functools import partial

import matplotlib
import pandas as pd

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from benchmarks.breakdown import ALL_SECTIONS
from benchmarks.settings import (
    ENVIRONMENTS,
    LABELS,
    OURS,
    REFERENCE,
    Scale,
)

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
    for axes in (times, memory):
        axes.locator_params(axis="x", nbins=5)
    figure.savefig(scale.pictures / "growth.png", dpi=150)
