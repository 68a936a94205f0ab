"""The paper's Figure 1: learning curves, as data and as a picture.

The picture is drawn from its data alone, and the same data gives the same file, byte for byte.
"""

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import PositiveInt

from mace_rl.hyperparameters import Section
from mace_rl.metrics import MetricsConfig, moving_average
from mace_rl.records import RecordError, Run
from mace_rl.statistics import mean_interval

if TYPE_CHECKING:  # imported where they are used: every job imports FigureConfig
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_POINTS = 1000  # per curve: closer than a printer's dots, and a PDF of a bearable size
DOTS_PER_INCH = 300
WIDTH, PANEL_HEIGHT, LEGEND_HEIGHT = 7.2, 2.1, 0.5  # inches; a page's text is about as wide
BAND_SEEDS = 3  # with two, t's interval covers the whole panel and hides the lines
_TICKS = {"size": 3, "width": 0.8}  # points


class FigureConfig(Section):
    """How Figure 1 is laid out."""

    columns: PositiveInt  # panels side by side, one panel per environment


def seed_curves(frames: "Mapping[Run, pd.DataFrame]", window: int) -> "pd.DataFrame":
    """The learning curve of every run: the moving average of the extrinsic return.

    `frames` are the records (`read_episodes`) of each run (environment, variant, seed). The average
    is over the last `window` episodes; over all there are so far in the first `window` - 1. Of
    E > 1000 episodes only every ⌈E / 1000⌉-th is kept, counted back from the last: more could not
    be seen.
    Columns: env, variant, seed, episode, moving_average.
    """
    import pandas as pd

    curves = []
    for (environment, variant, seed), frame in frames.items():
        returns = frame["extrinsic_return"].to_numpy()
        head = returns[: window - 1]
        average = np.concatenate(
            [np.cumsum(head) / np.arange(1, len(head) + 1), moving_average(returns, window)]
        )
        stride = math.ceil(len(returns) / MAX_POINTS)
        kept = np.arange(len(returns) - 1, -1, -stride)[::-1]
        curves.append(
            pd.DataFrame(
                {
                    "env": environment,
                    "variant": variant,
                    "seed": seed,
                    "episode": kept + 1,
                    "moving_average": average[kept],
                }
            )
        )
    return pd.concat(curves, ignore_index=True)


def learning_curves(single_seeds: "pd.DataFrame", settings: MetricsConfig) -> "pd.DataFrame":
    """The mean over seeds of `seed_curves`, with its pointwise interval.

    Columns: env, variant, episode, mean, lower, upper (both NaN with one seed), n (seeds).
    Raises `RecordError` if the seeds of a variant have not the same episodes.
    """
    import pandas as pd

    curves = []
    for (environment, variant), runs in single_seeds.groupby(["env", "variant"], sort=False):
        wide = runs.pivot(index="episode", columns="seed", values="moving_average")
        values = wide.to_numpy().T  # [seeds, episodes]
        if np.isnan(values).any():
            raise RecordError(f"the seeds of {environment}, {variant} differ in their episodes")
        lower, upper = mean_interval(
            values,
            settings.confidence,
            settings.bootstrap_repetitions,
            np.random.default_rng(settings.bootstrap_seed),
        )
        curves.append(
            pd.DataFrame(
                {
                    "env": environment,
                    "variant": variant,
                    "episode": wide.index.to_numpy(),
                    "mean": values.mean(axis=0),
                    "lower": lower,
                    "upper": upper,
                    "n": len(values),
                }
            )
        )
    return pd.concat(curves, ignore_index=True)


def figure1(
    curves: "pd.DataFrame",
    single_seeds: "pd.DataFrame",
    layout: FigureConfig,
    metrics: MetricsConfig,
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> "Figure":
    """Figure 1 from `learning_curves` and `seed_curves`: one panel per environment.

    The mean over seeds is a line, its interval a band (from three seeds on), and the single seeds
    are faint lines behind; the panels show the range of these. `labels` and `colours` are those of
    the variants.
    """
    from matplotlib.figure import Figure

    environments, variants = list(curves["env"].unique()), list(curves["variant"].unique())
    columns = min(layout.columns, len(environments))
    rows = math.ceil(len(environments) / columns)
    with _style():
        height = rows * PANEL_HEIGHT + LEGEND_HEIGHT
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for place, (environment, axes) in enumerate(zip(environments, panels, strict=False)):
            for order, variant in enumerate(variants):
                _draw(
                    axes,
                    _select(curves, environment, variant),
                    _select(single_seeds, environment, variant),
                    colours.get(variant, f"C{order}"),
                    labels.get(variant, variant),
                )
            shown = single_seeds.loc[single_seeds["env"] == environment, "moving_average"]
            margin = 0.05 * (shown.max() - shown.min() or 1)
            axes.set_ylim(shown.min() - margin, shown.max() + margin)
            axes.set_xlim(0, curves.loc[curves["env"] == environment, "episode"].max())
            axes.locator_params(nbins=5)
            axes.set_title(environment)
            if place % columns == 0:
                axes.set_ylabel(f"Extrinsic return\n(mean of {metrics.moving_average} episodes)")
            if place + columns >= len(environments):
                axes.set_xlabel("Training episodes")
        for axes in panels[len(environments) :]:
            axes.remove()
        legend = figure.legend(
            *panels[0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=min(len(variants), 3),
            title=_explanation(curves["n"].max(), metrics.confidence),
        )
        for line in legend.get_lines():
            line.set_linewidth(2)
    return figure


def save_figure(figure: "Figure", path: str | Path) -> None:
    """Write a figure of this module as PDF (fonts embedded as TrueType) or as PNG.

    Without date and version, so that an equal figure gives an equal file.
    """
    fields = (
        ("CreationDate", "Creator", "Producer") if Path(path).suffix == ".pdf" else ("Software",)
    )
    with _style():
        figure.savefig(path, dpi=DOTS_PER_INCH, metadata=dict.fromkeys(fields))


def _style() -> AbstractContextManager[None]:
    """The settings to draw and to save with: text is laid out on saving."""
    import matplotlib
    import seaborn

    fonts = {"font.family": "DejaVu Sans", "pdf.fonttype": 42}  # this font comes with matplotlib
    return matplotlib.rc_context(
        seaborn.axes_style("ticks", {"axes.spines.right": False, "axes.spines.top": False})
        | seaborn.plotting_context("paper", font_scale=0.9)
        | {"legend.frameon": False, "legend.title_fontsize": "small", "axes.linewidth": 0.8}
        | {f"{axis}tick.major.{part}": size for axis in "xy" for part, size in _TICKS.items()}
        | fonts
    )


def _draw(
    axes: "Axes", curve: "pd.DataFrame", runs: "pd.DataFrame", colour: str, label: str
) -> None:
    """One variant in one panel: every variant's single seeds are behind every band and line."""
    episodes, seeds = curve["episode"], curve["n"].max()
    if seeds > 1:
        faint = {"color": colour, "linewidth": 0.5, "alpha": 0.6 / np.sqrt(seeds), "zorder": 1}
        for _, run in runs.groupby("seed"):
            axes.plot(run["episode"], run["moving_average"], **faint)
    if seeds >= BAND_SEEDS:
        band = {"color": colour, "alpha": 0.25, "linewidth": 0, "zorder": 2}
        axes.fill_between(episodes, curve["lower"], curve["upper"], **band)
    axes.plot(episodes, curve["mean"], color=colour, linewidth=1.3, label=label, zorder=3)


def _select(frame: "pd.DataFrame", environment: str, variant: str) -> "pd.DataFrame":
    return frame[(frame["env"] == environment) & (frame["variant"] == variant)]


def _explanation(seeds: int, confidence: float) -> str:
    """The legend's title: what lines and bands are."""
    if seeds == 1:
        return "One seed"
    band = f" Band: its {100 * confidence:g} % interval." if seeds >= BAND_SEEDS else ""
    return f"Line: mean over {seeds} seeds.{band} Faint lines: single seeds."
