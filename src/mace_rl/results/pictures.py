"""Pictures of all runs at once: every seed, performance profiles, and the regret of a learned β."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from mace_rl.config.results import FigureConfig, MetricsConfig, RegretConfig
from mace_rl.results.aggregate import SCORED, scores
from mace_rl.results.figures import LEGEND_HEIGHT, PANEL_HEIGHT, WIDTH, style
from mace_rl.results.metrics import METRICS
from mace_rl.results.statistics import draws, mean_interval, percentiles

if TYPE_CHECKING:  # drawing is imported where it is used, as in figures
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PROFILE_POINTS = 201  # of τ, from the lowest score of any run to 1
LABELS = {metric.name: metric.label for metric in METRICS}


def profiles(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """Performance profiles: which share of a variant's runs has a score of at least τ.

    table: the frame of metrics.csv; scores as in `aggregate`. Columns: metric, variant, score (τ),
    share, low, high: the pointwise interval from resampling seeds within environments, NaN if one
    of these has one seed. (Agarwal et al. 2021, section 4.2.)
    """
    every, frames = scores(table, settings), []
    for (metric, variant), runs in every.groupby(["metric", "variant"], sort=False):
        lowest = every.loc[every["metric"] == metric, "score"].min()
        tau = np.linspace(lowest, 1, PROFILE_POINTS)
        generator = np.random.default_rng(settings.bootstrap_seed)
        strata = [group["score"].to_numpy() for _, group in runs.groupby("env", sort=False)]
        reached = np.zeros(len(tau))  # runs, of which those drawn are [repetitions, τ]
        resampled = np.zeros((settings.bootstrap_repetitions, len(tau)))
        for values in strata:
            high_enough = (values[:, None] >= tau).astype(np.float64)  # [seeds, τ]
            reached += high_enough.sum(axis=0)
            resampled += draws(len(values), len(resampled), generator) @ high_enough
        bounds = percentiles(resampled, settings.confidence, min(map(len, strata))) / len(runs)
        columns = {"score": tau, "share": reached / len(runs), "low": bounds[0], "high": bounds[1]}
        frames.append(pd.DataFrame({"metric": metric, "variant": variant} | columns))
    return pd.concat(frames, ignore_index=True)


def draw_profiles(
    curves: pd.DataFrame,
    confidence: float,
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> "Figure":
    """A panel per metric from `profiles`; a curve that lies higher belongs to better runs."""
    from matplotlib.figure import Figure

    metrics = list(curves["metric"].unique())
    with style():
        figure = Figure(figsize=(WIDTH, PANEL_HEIGHT + LEGEND_HEIGHT), layout="constrained")
        panels = list(figure.subplots(1, len(metrics), sharey=True, squeeze=False).flat)
        for metric, axes in zip(metrics, panels, strict=True):
            for variant, curve in curves[curves["metric"] == metric].groupby("variant", sort=False):
                name = str(variant)
                axes.plot(curve["score"], curve["share"], color=colours[name], label=labels[name])
                band = curve["score"], curve["low"], curve["high"]
                axes.fill_between(*band, color=colours[name], alpha=0.2, linewidth=0)
            axes.set_title(LABELS[str(metric)])
            axes.set_xlabel("Score τ (0: random, 1: the best run)")
            axes.set_ylim(0, 1.02)
        panels[0].set_ylabel("Share of runs ≥ τ")
        _legend(figure, panels[0], f"Band: {100 * confidence:g} % interval.")
    return figure


def draw_every_seed(
    table: pd.DataFrame, labels: Mapping[str, str], colours: Mapping[str, str]
) -> "Figure":
    """A dot per run of the frame of metrics.csv, a dash at their mean; `SCORED` by environment."""
    from matplotlib.figure import Figure

    environments, variants = list(table["env"].unique()), list(table["variant"].unique())
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(table))
    with style():
        height = len(environments) * PANEL_HEIGHT * 0.9 + LEGEND_HEIGHT
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        grid = figure.subplots(len(environments), len(SCORED), squeeze=False)
        for environment, row in zip(environments, grid, strict=True):
            for metric, axes in zip(SCORED, row, strict=True):
                for place, variant in enumerate(variants):
                    own = (table["env"] == environment) & (table["variant"] == variant)
                    values = table.loc[own, metric]
                    if values.empty:
                        continue
                    dots = axes.scatter(place + jitter[own], values, s=6, color=colours[variant])
                    dots.set(alpha=0.7, linewidth=0, label=labels[variant])
                    axes.hlines(values.mean(), place - 0.4, place + 0.4, color=colours[variant])
                axes.set_xticks([])
                axes.set_title(f"{environment}:\n{LABELS[metric].lower()}")
        _legend(figure, grid[0, 0], "Dot: one seed. Line: their mean.")
    return figure


def draw_regret(
    table: pd.DataFrame,
    regret: RegretConfig,
    layout: FigureConfig,
    settings: MetricsConfig,
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> "Figure":
    """The mean return of training under every constant β, and that of the variants beside it.

    A panel per environment of the frame of metrics.csv. The constants, in their order, are joined
    by a line with intervals; the other variants are dots with intervals to the right.
    """
    from matplotlib.figure import Figure

    environments = list(table["env"].unique())
    others = [name for name in table["variant"].unique() if name not in regret.constants]
    columns = min(layout.columns, len(environments))
    rows = math.ceil(len(environments) / columns)
    with style():
        height = rows * PANEL_HEIGHT * 1.1 + LEGEND_HEIGHT
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for environment, axes in zip(environments, panels, strict=False):
            runs = table[table["env"] == environment]
            for place, name in enumerate([*regret.constants, *others]):
                values = runs.loc[runs["variant"] == name, "area_under_curve"].to_numpy()
                low, high = mean_interval(
                    values,
                    settings.confidence,
                    settings.bootstrap_repetitions,
                    np.random.default_rng(settings.bootstrap_seed),
                )
                own = name in regret.constants
                axes.errorbar(
                    place + 0.7 * (not own),
                    values.mean(),
                    # Of equal values a bound and the mean may differ in the last bit.
                    yerr=np.maximum(0, [[values.mean() - low], [high - values.mean()]]),
                    fmt="o",
                    markersize=3,
                    color="dimgray" if own else colours[name],
                    label=None if own else labels[name],
                )
            means = runs.groupby("variant")["area_under_curve"].mean()[regret.constants]
            ticks = [labels[name].removeprefix("β = ").partition(" (")[0] for name in means.index]
            axes.plot(range(len(means)), means, color="dimgray", linewidth=0.8)
            axes.set_xticks(range(len(means)), ticks, rotation=45)  # "PPO" runs into its neighbour
            axes.set_title(environment)
            axes.set_xlabel("constant β")
        for axes in panels[len(environments) :]:
            axes.remove()
        for axes in panels[: len(environments) : columns]:
            axes.set_ylabel("Mean return of training")
        _legend(
            figure,
            panels[0],
            f"Dot: mean over seeds. Bar: its {100 * settings.confidence:g} % interval.",
        )
    return figure


def _legend(figure: "Figure", panel: "Axes", title: str | None = None) -> None:
    """One legend for all panels, below them."""
    handles, names = panel.get_legend_handles_labels()
    columns = min(len(names), 4)
    figure.legend(handles, names, loc="outside lower center", ncols=columns, title=title)
