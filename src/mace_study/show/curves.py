"""The figures: what runs do over training, as data and as pictures; equal data, equal files."""

import io
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
import seaborn
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from mace_rl.training.records import RunKey
from mace_study.compare.statistics import interval
from mace_study.compare.summary import from_to
from mace_study.config.metrics import FigureConfig, MetricsConfig
from mace_study.measure.metrics import metric_labels, moving_average

MAX_POINTS = 300  # per curve: a panel of three in a row is hardly twice as many dots wide
DOTS_PER_INCH = 300
WIDTH, PANEL_HEIGHT, LEGEND_HEIGHT = 7.2, 2.1, 0.5  # inches; a page's text is about as wide
LETTERS = 140  # about as many as stand side by side in a legend
SAMPLE = 6  # a legend's line and the space beside it, in letters
BAND_SEEDS = 3  # with two, t's interval covers the whole panel and hides the lines
INSET = (0.4, 0.14, 0.58, 0.56)  # left, bottom, width and height, in the panel
MOSTLY = 0.75  # of the way from the lowest to the highest mean, for an inset of the beginning
SINGLE_SEEDS = 10  # with more, lines of single seeds hide the mean and its band
# Of the variants, in their order: colours alone are not told apart in grey, nor by everybody.
DASHES = ("-", (0, (6, 1.5)), (0, (2, 1)), (0, (6, 1, 1, 1)), (0, (1, 1.5)))
_TICKS = {"size": 3, "width": 0.8}  # points


@dataclass(frozen=True)
class Quantity:
    """What a figure shows of every run, over its training episodes."""

    column: str  # of episodes.csv
    window: int  # episodes of its moving average; 1: the values as they are
    name: str  # of the moving average in the data of single seeds
    label: str  # of the y axis
    # Of the y axis, and further up where seeds are; None: what the single seeds span.
    limits: tuple[float, float] | None = None
    zero_is_shown: bool = True  # whether a variant has a curve that is 0 throughout


class PlotStyle(NamedTuple):
    """What the configuration says of how pictures look."""

    layout: FigureConfig
    confidence: float  # of the intervals
    labels: Mapping[str, str]  # of variants
    colours: Mapping[str, str]  # of variants
    metrics: Mapping[str, str]  # labels


def plot_style(
    settings: MetricsConfig,
    layout: Mapping[str, Any],
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> PlotStyle:
    """The style of a study that is measured by these settings; `layout`: of a `FigureConfig`."""
    names = metric_labels(settings)
    return PlotStyle(FigureConfig(**layout), settings.confidence, labels, colours, names)


def quantity(figure: str, settings: MetricsConfig) -> Quantity:
    """What the figure of this number, "1" or "2", shows."""
    if figure == "2":
        return Quantity("beta", 1, "beta", "β", limits=(0, 1), zero_is_shown=False)
    window = settings.moving_average
    label = f"Extrinsic return\n(mean of up to {window} episodes)"
    return Quantity("extrinsic_return", window, "moving_average", label)


def seed_curves(frames: Mapping[RunKey, pd.DataFrame], shown: Quantity) -> pd.DataFrame:
    """The curve of every run: the moving average of the `shown` column.

    `frames` are `FinishedRun.episodes` of each run (environment, variant, seed). The average
    is over the last `window` episodes, or over all there are so far. Of E > 300 episodes only every
    ⌈E / 300⌉-th is kept, counted back from the last: more could not be seen. Curves of a variant
    end with its shortest run.
    Columns: env, variant, seed, episode and the average by its name.
    """
    columns = ["env", "variant", "seed", "episode", shown.name]
    every = shown.zero_is_shown
    variants = {run[1] for run, frame in frames.items() if every or frame[shown.column].any()}
    keys: list[tuple[Any, ...]] = []
    episodes, averages = [], []
    shortest: dict[tuple[str, str], int] = {}
    for (environment, variant, _), frame in frames.items():
        known = shortest.get((environment, variant), len(frame))
        shortest[environment, variant] = min(known, len(frame))
    for (environment, variant, seed), frame in frames.items():
        values = frame[shown.column].to_numpy()[: shortest[environment, variant]]
        head = values[: shown.window - 1]
        growing = np.cumsum(head) / np.arange(1, len(head) + 1)
        average = np.concatenate([growing, moving_average(values, shown.window)])
        stride = math.ceil(len(values) / MAX_POINTS)
        kept = np.arange(len(values) - 1, -1, -stride)[::-1]
        if variant in variants:
            keys.append((environment, variant, seed))
            episodes.append(kept + 1)
            averages.append(average[kept])
    if not keys:
        return pd.DataFrame(columns=columns)
    rows = np.repeat(np.arange(len(keys)), list(map(len, episodes)))
    curves = pd.DataFrame(keys, columns=columns[:3]).take(rows).reset_index(drop=True)
    return curves.assign(episode=np.concatenate(episodes), **{shown.name: np.concatenate(averages)})


def mean_curves(
    single_seeds: pd.DataFrame, shown: Quantity, settings: MetricsConfig
) -> pd.DataFrame:
    """The mean over seeds of `seed_curves`, with its pointwise interval.

    Columns: env, variant, episode, mean, lower, upper (both NaN with one seed), n (seeds).
    """
    columns = ["env", "variant", "episode", "mean", "lower", "upper", "n"]
    curves = []
    for (environment, variant), runs in single_seeds.groupby(["env", "variant"], sort=False):
        by_seed = runs.sort_values("seed", kind="stable")
        values = by_seed[shown.name].to_numpy().reshape(runs["seed"].nunique(), -1)
        values = np.asfortranarray(values)  # seeds side by side: means round less
        episodes = by_seed["episode"].to_numpy()[: values.shape[1]]
        ends = interval(values, settings)
        if shown.limits is not None:  # where the mean lies, the ends of its interval do
            ends = np.clip(ends, *reaching(shown.limits, values))
        row = (environment, variant, episodes, values.mean(axis=0), *ends, len(values))
        curves.append(pd.DataFrame(dict(zip(columns, row, strict=True))))
    return pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=columns)


def shows_seeds(curves: pd.DataFrame) -> bool:
    """Whether a figure of these `mean_curves` shows single seeds somewhere."""
    return bool((curves["n"] <= SINGLE_SEEDS).any())


def reaching(limits: tuple[float, float], values: Any) -> tuple[float, float]:
    """`limits`, the upper one raised to the largest of `values`: β may be above 1."""
    return limits[0], max(limits[1], values.max())


def draw_figure(
    curves: pd.DataFrame, single_seeds: pd.DataFrame, shown: Quantity, look: PlotStyle
) -> Figure:
    """A figure from `mean_curves` and `seed_curves`: one panel per environment.

    single_seeds: at least those of variants with up to `SINGLE_SEEDS`, which alone are drawn.
    """
    environments = list(curves["env"].unique())
    with style():
        names = ("Training episodes", shown.label) if environments else ("", "")
        figure, panels = grid(max(len(environments), 1), look.layout.columns, *names)
        if not environments:
            panels[0].text(0.5, 0.5, f"{shown.label} is 0 in every run", ha="center", va="center")
            panels[0].set_axis_off()
            return figure
        uneven = curves["n"].nunique() > 1
        for environment, axes in zip(environments, panels, strict=True):
            means, runs = (frame[frame["env"] == environment] for frame in (curves, single_seeds))
            values = runs[shown.name]
            if means["n"].max() > SINGLE_SEEDS:
                values = means[["mean", "lower", "upper"]].stack()
            margin = 0.05 * (values.max() - values.min() or 1)
            spanned = values.min() - margin, values.max() + margin
            axes.set_ylim(reaching(shown.limits, values) if shown.limits else spanned)
            axes.set_xlim(0, means["episode"].max())
            axes.locator_params(nbins=4)
            axes.set_title(environment + (f" ({means['n'].max()} seeds)" if uneven else ""))
            draw_means(axes, means, look)
            seeds = means.groupby("variant")["n"].max()
            few = seeds.index[seeds.between(2, SINGLE_SEEDS)]  # the line of one is the mean's
            lines = runs[runs["variant"].isin(few)].groupby(["variant", "seed"], sort=False)
            for (variant, _), run in lines:
                faint: dict[str, Any] = {"color": look.colours[variant], "linewidth": 0.5}
                faint |= {"alpha": 0.6 / math.sqrt(seeds[variant]), "zorder": 1}
                axes.plot(run["episode"], run[shown.name], **faint)
            share = look.layout.inset
            if share and shown.limits is None and _is_early(means, share) and _is_free(axes, means):
                inset = axes.inset_axes(INSET)
                draw_means(inset, means[means["episode"] <= share * means["episode"].max()], look)
                inset.set_xlim(0, share * means["episode"].max())
                inset.locator_params(nbins=3)
                inset.tick_params(labelsize="x-small")
        most, explained = curves["n"].max(), "One seed."
        if most > 1:
            band = f" Band: its {100 * look.confidence:g} % interval." if most >= BAND_SEEDS else ""
            line = f"Line: mean over {from_to(curves['n'])} seeds."
            explained = line + band
            if curves["n"].between(2, SINGLE_SEEDS).any():
                explained += " Faint lines: single seeds."
        if look.layout.inset and any(axes.child_axes for axes in panels):
            explained += f" Inset: the first {100 * look.layout.inset:g} %."
        legend(figure, explained)
    return figure


def grid(
    count: int, columns: int, x: str = "", y: str = "", height: float = PANEL_HEIGHT
) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels of `height` inches; `x` stands below the lowest, `y` once."""
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(WIDTH, rows * height + LEGEND_HEIGHT), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels[count:]:
        axes.remove()
    for axes in panels[count - columns : count]:
        axes.set_xlabel(x)
    figure.supylabel(y, multialignment="center")
    return figure, panels[:count]


def legend(figure: Figure, explained: str) -> None:
    """One legend below all panels, with the explanation of dots, lines and bars as its title."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    longest = max(map(len, entries), default=0) + SAMPLE
    columns = max(1, min(len(entries), 4, LETTERS // longest))
    how: dict[str, Any] = {"loc": "outside lower center", "ncols": columns, "title": explained}
    for line in figure.legend(list(entries.values()), list(entries), **how).get_lines():
        line.set_linewidth(2)


def save_figure(figure: Figure, *paths: str | Path) -> None:
    """Write a figure as PDF or PNG, by the suffix of each path, without date and version.

    Each file's layout starts from that of the one before: the order of paths matters a little.
    """
    with style():
        for path in map(Path, paths):
            if path.suffix == ".pdf":
                unsaid = dict.fromkeys(("CreationDate", "Creator", "Producer"))
                figure.savefig(path, dpi=DOTS_PER_INCH, metadata=unsaid)
                continue
            drawn, width = io.BytesIO(), int(figure.get_figwidth() * DOTS_PER_INCH)
            figure.savefig(drawn, dpi=DOTS_PER_INCH, format="rgba")
            size = width, drawn.tell() // (4 * width)
            picture = Image.frombytes("RGBA", size, drawn.getvalue())
            few_colours(picture).save(path, optimize=True)


def few_colours(picture: Image.Image) -> Image.Image:
    """A picture in 256 colours that cover all of its own; as a PNG file it has half the bytes.

    Those that are nearest on average would leave out a dot of a colour that is nowhere else.
    """
    how = Image.Quantize.MAXCOVERAGE
    return picture.convert("RGB").quantize(256, how, dither=Image.Dither.NONE)


@contextmanager
def style() -> Iterator[None]:
    """The settings to draw and to save with, none of them the user's: saving lays text out."""
    fonts = {"font.family": "DejaVu Sans", "pdf.fonttype": 42}  # this font comes with matplotlib
    fonts |= {"text.parse_math": False}  # a label may have a $
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(
            seaborn.axes_style("ticks", {"axes.spines.right": False, "axes.spines.top": False})
            | seaborn.plotting_context("paper", font_scale=0.9)
            | {"legend.frameon": False, "legend.title_fontsize": "small", "axes.linewidth": 0.8}
            | {"axes.titlesize": "small", "figure.labelsize": "medium"}
            | {f"{axis}tick.major.{part}": size for axis in "xy" for part, size in _TICKS.items()}
            | fonts
        )
        yield


def _is_early(curves: pd.DataFrame, share: float) -> bool:
    """Whether every mean is most of its way up in the first `share` of the episodes."""
    early = curves[curves["episode"] <= share * curves["episode"].max()]
    means = curves.groupby("variant")["mean"]
    risen = early.groupby("variant")["mean"].max() - means.min()
    return bool((risen > MOSTLY * (means.max() - means.min())).all())


def _is_free(axes: Axes, curves: pd.DataFrame) -> bool:
    """Whether no mean and no band of one goes where the inset would be."""
    across, up, width, height = INSET
    to_axes = axes.transData + axes.transAxes.inverted()
    for column in ("mean", "lower", "upper"):
        x, y = to_axes.transform(curves[["episode", column]].dropna()).T
        if ((x > across) & (x < across + width) & (y > up) & (y < up + height)).any():
            return False
    return True


def draw_means(axes: Axes, curves: pd.DataFrame, look: PlotStyle) -> None:
    """Means and bands of one environment, each variant with its own dashes."""
    for place, (name, curve) in enumerate(curves.groupby("variant", sort=False)):
        variant, episodes, mean = str(name), curve["episode"], curve["mean"].to_numpy()
        colour = look.colours[variant]
        if curve["n"].max() >= BAND_SEEDS:
            band: dict[str, Any] = {"color": colour, "alpha": 0.25, "linewidth": 0, "zorder": 2}
            axes.fill_between(episodes, curve["lower"], curve["upper"], **band)
        line: dict[str, Any] = {"color": colour, "linewidth": 1.3, "zorder": 3}
        line["linestyle"] = DASHES[place % len(DASHES)]
        axes.plot(episodes, mean, label=look.labels[variant], **line)
