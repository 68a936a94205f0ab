"""The figures: what runs do over training, as data and as pictures.

Figure 1 is the paper's, the extrinsic return; Figure 2 shows β. A picture is drawn from its data
alone, and the same data gives the same file, byte for byte.
"""

import io
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mace_rl.config.results import FigureConfig, MetricsConfig
from mace_rl.results.metrics import moving_average
from mace_rl.results.records import RecordError, RunKey
from mace_rl.results.statistics import mean_interval

if TYPE_CHECKING:  # imported where they are used: planning the workflow does without
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_POINTS = 500  # per curve: a panel of three in a row has hardly more dots
DOTS_PER_INCH = 300
WIDTH, PANEL_HEIGHT, LEGEND_HEIGHT = 7.2, 2.1, 0.5  # inches; a page's text is about as wide
BAND_SEEDS = 3  # with two, t's interval covers the whole panel and hides the lines
MOSTLY = 0.75  # of the way from the lowest to the highest mean, for an inset of the beginning
_TICKS = {"size": 3, "width": 0.8}  # points


@dataclass(frozen=True)
class Quantity:
    """What a figure shows of every run, over its training episodes."""

    column: str  # of episodes.csv
    window: int  # episodes of its moving average; 1: the values as they are
    name: str  # of the moving average in the data of single seeds
    label: str  # of the y axis
    limits: tuple[float, float] | None = None  # of the y axis; None: what the single seeds span
    zero_is_shown: bool = True  # whether a variant has a curve that is 0 throughout


def quantity(figure: str, settings: MetricsConfig) -> Quantity:
    """What the figure of this number, "1" or "2", shows."""
    if figure == "2":
        return Quantity("beta", 1, "beta", "β", limits=(0, 1), zero_is_shown=False)
    window = settings.moving_average
    label = f"Extrinsic return\n(mean of up to {window} episodes)"
    return Quantity("extrinsic_return", window, "moving_average", label)


def seed_curves(frames: "Mapping[RunKey, pd.DataFrame]", shown: Quantity) -> "pd.DataFrame":
    """The curve of every run: the moving average of the `shown` column.

    `frames` are the records (`read_episodes`) of each run (environment, variant, seed). The average
    is over the last `window` episodes; over all there are so far in the first `window` - 1. Of
    E > 500 episodes only every ⌈E / 500⌉-th is kept, counted back from the last: more could not
    be seen.
    Columns: env, variant, seed, episode and the average by its name.
    """
    import pandas as pd

    columns = ["env", "variant", "seed", "episode", shown.name]
    variants = {
        variant
        for (_, variant, _), frame in frames.items()
        if shown.zero_is_shown or frame[shown.column].any()
    }
    curves = []
    for (environment, variant, seed), frame in frames.items():
        values = frame[shown.column].to_numpy()
        head = values[: shown.window - 1]
        average = np.concatenate(
            [np.cumsum(head) / np.arange(1, len(head) + 1), moving_average(values, shown.window)]
        )
        stride = math.ceil(len(values) / MAX_POINTS)
        kept = np.arange(len(values) - 1, -1, -stride)[::-1]
        if variant in variants:
            row = (environment, variant, seed, kept + 1, average[kept])
            curves.append(pd.DataFrame(dict(zip(columns, row, strict=True))))
    return pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=columns)


def mean_curves(
    single_seeds: "pd.DataFrame", shown: Quantity, settings: MetricsConfig
) -> "pd.DataFrame":
    """The mean over seeds of `seed_curves`, with its pointwise interval.

    Columns: env, variant, episode, mean, lower, upper (both NaN with one seed), n (seeds).
    Raises `RecordError` if the seeds of a variant have not the same episodes.
    """
    import pandas as pd

    columns = ["env", "variant", "episode", "mean", "lower", "upper", "n"]
    curves = []
    for (environment, variant), runs in single_seeds.groupby(["env", "variant"], sort=False):
        wide = runs.pivot(index="episode", columns="seed", values=shown.name)
        values = wide.to_numpy().T  # [seeds, episodes]
        if np.isnan(values).any():
            raise RecordError(f"the seeds of {environment}, {variant} differ in their episodes")
        interval = mean_interval(
            values,
            settings.confidence,
            settings.bootstrap_repetitions,
            np.random.default_rng(settings.bootstrap_seed),
        )
        if shown.limits is not None:  # where the mean lies, the ends of its interval do
            interval = np.clip(interval, *shown.limits)
        row = (environment, variant, wide.index, values.mean(axis=0), *interval, len(values))
        curves.append(pd.DataFrame(dict(zip(columns, row, strict=True))))
    return pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=columns)


def draw_figure(
    curves: "pd.DataFrame",
    single_seeds: "pd.DataFrame",
    shown: Quantity,
    layout: FigureConfig,
    confidence: float,
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> "Figure":
    """A figure from `mean_curves` and `seed_curves`: one panel per environment.

    The mean over seeds is a line, its interval a band (from three seeds on), and the single seeds
    are faint lines behind. `labels` and `colours` are those of the variants. Where most is learned
    at the beginning, an inset shows that. Where there is nothing to show, the figure says so.
    """
    from matplotlib.figure import Figure

    environments, variants = list(curves["env"].unique()), list(curves["variant"].unique())
    columns = min(layout.columns, max(len(environments), 1))
    rows = math.ceil(max(len(environments), 1) / columns)
    with style():
        height = rows * PANEL_HEIGHT + LEGEND_HEIGHT
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        if not environments:
            panels[0].text(0.5, 0.5, f"{shown.label} is 0 in every run", ha="center", va="center")
            panels[0].set_axis_off()
            return figure
        uneven = curves["n"].nunique() > 1
        for place, (environment, axes) in enumerate(zip(environments, panels, strict=False)):
            for variant in variants:
                _draw(
                    axes,
                    _select(curves, environment, variant),
                    _select(single_seeds, environment, variant),
                    shown.name,
                    colours[variant],
                    labels[variant],
                )
            if shown.limits is None:
                values = single_seeds.loc[single_seeds["env"] == environment, shown.name]
                margin = 0.05 * (values.max() - values.min() or 1)
                axes.set_ylim(values.min() - margin, values.max() + margin)
            else:
                axes.set_ylim(*shown.limits)
            own = curves[curves["env"] == environment]
            axes.set_xlim(0, own["episode"].max())
            axes.locator_params(nbins=5)
            axes.set_title(environment + (f" ({own['n'].max()} seeds)" if uneven else ""))
            if layout.inset and shown.limits is None and _is_early(own, layout.inset):
                _draw_inset(axes, own, layout.inset, colours)
            if place % columns == 0:
                axes.set_ylabel(shown.label)
            if place + columns >= len(environments):
                axes.set_xlabel("Training episodes")
        for axes in panels[len(environments) :]:
            axes.remove()
        legend = figure.legend(
            *panels[0].get_legend_handles_labels(),
            loc="outside lower center",
            ncols=min(len(variants), 3),
            title=_explanation(
                *(curves["n"].min(), curves["n"].max(), confidence),
                layout.inset if any(axes.child_axes for axes in panels) else None,
            ),
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
    with style():
        figure.savefig(path, dpi=DOTS_PER_INCH, metadata=dict.fromkeys(fields))


def figure_as_svg(figure: "Figure") -> str:
    """A figure of this module as an SVG file without background, its text as text.

    An equal figure gives an equal file here too.
    """
    file = io.StringIO()
    fields = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with style():
        figure.savefig(file, format="svg", transparent=True, metadata=fields)
    return file.getvalue()


def style() -> AbstractContextManager[None]:
    """The settings to draw and to save with: text is laid out on saving."""
    import matplotlib
    import seaborn

    fonts = {"font.family": "DejaVu Sans", "pdf.fonttype": 42}  # this font comes with matplotlib
    fonts |= {"svg.fonttype": "none", "svg.hashsalt": "mace_rl"}  # text as text; ids that stay
    return matplotlib.rc_context(
        seaborn.axes_style("ticks", {"axes.spines.right": False, "axes.spines.top": False})
        | seaborn.plotting_context("paper", font_scale=0.9)
        | {"legend.frameon": False, "legend.title_fontsize": "small", "axes.linewidth": 0.8}
        | {f"{axis}tick.major.{part}": size for axis in "xy" for part, size in _TICKS.items()}
        | fonts
    )


def _is_early(curves: "pd.DataFrame", share: float) -> bool:
    """Whether every mean is most of its way up in the first `share` of the episodes."""
    early = curves[curves["episode"] <= share * curves["episode"].max()]
    lowest = curves.groupby("variant")["mean"].min()
    risen = early.groupby("variant")["mean"].max() - lowest
    return bool((risen > MOSTLY * (curves.groupby("variant")["mean"].max() - lowest)).all())


def _draw_inset(
    axes: "Axes", curves: "pd.DataFrame", share: float, colours: Mapping[str, str]
) -> None:
    """The first `share` of the episodes: means and bands."""
    end = share * curves["episode"].max()
    inset = axes.inset_axes((0.4, 0.14, 0.58, 0.56))
    for variant, curve in curves[curves["episode"] <= end].groupby("variant", sort=False):
        colour = colours[str(variant)]
        if curve["n"].max() >= BAND_SEEDS:
            band = curve["episode"], curve["lower"], curve["upper"]
            inset.fill_between(*band, color=colour, alpha=0.25, linewidth=0)
        inset.plot(curve["episode"], curve["mean"], color=colour, linewidth=1)
    inset.set_xlim(0, end)
    inset.locator_params(nbins=3)
    inset.tick_params(labelsize="x-small")


def _draw(
    axes: "Axes", curve: "pd.DataFrame", runs: "pd.DataFrame", name: str, colour: str, label: str
) -> None:
    """One variant in one panel: every variant's single seeds are behind every band and line."""
    episodes, seeds = curve["episode"], curve["n"].max()
    if seeds > 1:
        faint: dict[str, Any] = {
            "color": colour,
            "linewidth": 0.5,
            "alpha": 0.6 / np.sqrt(seeds),
            "zorder": 1,
        }
        for _, run in runs.groupby("seed"):
            axes.plot(run["episode"], run[name], **faint)
    if seeds >= BAND_SEEDS:
        band: dict[str, Any] = {"color": colour, "alpha": 0.25, "linewidth": 0, "zorder": 2}
        axes.fill_between(episodes, curve["lower"], curve["upper"], **band)
    axes.plot(episodes, curve["mean"], color=colour, linewidth=1.3, label=label, zorder=3)


def _select(frame: "pd.DataFrame", environment: str, variant: str) -> "pd.DataFrame":
    return frame[(frame["env"] == environment) & (frame["variant"] == variant)]


def _explanation(fewest: int, seeds: int, confidence: float, inset: float | None) -> str:
    """The legend's title: what lines, bands and insets are."""
    enlarged = f" Inset: the first {100 * inset:g} %." if inset else ""
    if seeds == 1:
        return f"One seed.{enlarged}" if inset else "One seed"
    count = f"{seeds}" if fewest == seeds else f"{fewest} to {seeds}"
    band = f" Band: its {100 * confidence:g} % interval." if seeds >= BAND_SEEDS else ""
    return f"Line: mean over {count} seeds.{band} Faint lines: single seeds.{enlarged}"
