"""Pictures of all runs at once, each drawn from data that stands beside it as CSV."""

import itertools
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import seaborn
from matplotlib.figure import Figure

from mace_study.compare.aggregate import SCORED
from mace_study.compare.claims_config import ClaimsConfig
from mace_study.compare.estimates import CONFIDENCE
from mace_study.compare.ledger import Answer, Finding
from mace_study.compare.readings import PAPER, in_order, title
from mace_study.compare.statistics import interval
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import metric_labels
from mace_study.show.curves import LEGEND_HEIGHT, PlotStyle, grid, legend, style
from mace_study.show.tables import SOLVED

FIXED_BETA, LEARNED, OTHER = "fixed", "learned", "other"
# Of parts, and of the verdicts alike; from seaborn's palette that the colour-blind can tell apart.
OUTCOMES = {
    "shown": ("#029e73", "shown"),
    "open": ("#767676", "open"),
    "absent": ("#0173b2", "absent: no effect worth mentioning"),
    "reversed": ("#d55e00", "reversed"),
    "no_room": ("#cc78bc", "no room for an effect worth mentioning"),
}
INK = "#262626"  # as seaborn draws axes
LINE = 0.6  # the height of a line of words, where a part has 1
FEW_ENVIRONMENTS = 4  # in a picture with a row for each
SMALL_LETTERS = 141  # of the smallest words, as many as stand side by side in a picture


class Source(NamedTuple):
    """What the data of pictures are made of."""

    data: Mapping[str, pd.DataFrame]  # by the name of the CSV file: metrics, readings
    answers: Sequence[Answer]  # the ledger
    settings: MetricsConfig
    claims: ClaimsConfig


def every_seed(source: Source) -> pd.DataFrame:
    """`SCORED` of every run of metrics.csv. Columns: env, variant, seed, metric, value."""
    runs = source.data["metrics"]
    long = runs.melt(["env", "variant", "seed"], list(SCORED), "metric", ignore_index=False)
    return long.sort_index(kind="stable").reset_index(drop=True)  # run by run


def draw_every_seed(table: pd.DataFrame, look: PlotStyle) -> Figure:
    """A dot per run, a dash at the mean of a variant; the panels of an environment abreast."""
    jitter = pd.Series(np.random.default_rng(0).uniform(-0.3, 0.3, len(table)), table.index)
    places = {name: place for place, name in enumerate(table["variant"].unique())}
    with style():
        groups = table.groupby(["env", "metric"], sort=False)
        many = table["env"].nunique() > FEW_ENVIRONMENTS  # two abreast, lest it be a long strip
        small: dict[str, Any] = {"fontsize": "x-small"} if many else {}
        figure, panels = grid(groups.ngroups, (1 + many) * table["metric"].nunique())
        for ((environment, metric), shown), axes in zip(groups, panels, strict=True):
            for variant, runs in shown.groupby("variant", sort=False):
                name, place, values = str(variant), places[variant], runs["value"]
                colour = look.colours[name]
                dots = axes.scatter(place + jitter[runs.index], values, s=6, color=colour)
                dots.set(alpha=0.7, linewidth=0, label=look.labels[name])
                axes.hlines(values.mean(), place - 0.4, place + 0.4, color=colour)
            axes.set_xticks([])
            title = f"{environment}:\n{look.metrics[str(metric)].lower()}"
            axes.set_title(title, **small)
        legend(figure, "Dot: one seed. Line: their mean.")
    return figure


def constants(source: Source) -> pd.DataFrame:
    """The mean return of training of every variant, with its role, from metrics.csv's frame."""
    runs, settings = source.data["metrics"], source.settings
    assert settings.constants is not None  # `Plan.pictures` has asked
    roles = dict.fromkeys(settings.constants.fixed, FIXED_BETA)
    roles |= dict.fromkeys(runs["variant"].unique(), OTHER) | roles
    roles[settings.constants.learned] = LEARNED
    areas = {key: of_key["area_under_curve"] for key, of_key in runs.groupby(["env", "variant"])}
    rows = []
    pairs = itertools.product(runs["env"].unique(), roles)
    for environment, variant in (pair for pair in pairs if pair in areas):
        values = areas[environment, variant].to_numpy()
        found = values.mean(), *interval(values, settings), len(values)
        rows.append((environment, variant, roles[variant], *found))
    return pd.DataFrame(rows, columns=["env", "variant", "role", "mean", "low", "high", "seeds"])


def draw_constants(table: pd.DataFrame, look: PlotStyle) -> Figure:
    """The constants joined by a line, the learned β across them, the others on the right."""
    with style():
        names = "Constant β", "Mean return of training"
        figure, panels = grid(table["env"].nunique(), look.layout.columns, *names)
        for (environment, rows), axes in zip(table.groupby("env", sort=False), panels, strict=True):
            fixed = rows[rows["role"] == FIXED_BETA]
            for place, (_, row) in enumerate(rows[rows["role"] != LEARNED].iterrows()):
                constant, name = row["role"] == FIXED_BETA, row["variant"]
                dot: dict[str, Any] = {"color": "dimgray"}
                if not constant:
                    dot = {"color": look.colours[name], "label": look.labels[name]}
                # Of equal values a bound and the mean may differ in the last bit.
                ends = np.maximum(0, [[row["mean"] - row["low"]], [row["high"] - row["mean"]]])
                at = place + 0.5 * (not constant), row["mean"]
                axes.errorbar(*at, ends, fmt="o", markersize=3, **dot)
            axes.plot(range(len(fixed)), fixed["mean"], color="dimgray", linewidth=0.8)
            for _, row in rows[rows["role"] == LEARNED].iterrows():
                colour, label = look.colours[row["variant"]], look.labels[row["variant"]]
                axes.axhspan(row["low"], row["high"], color=colour, alpha=0.2, linewidth=0)
                axes.axhline(row["mean"], color=colour, linewidth=1.3, label=label, zorder=1)
            labels = (look.labels[name].removeprefix("β = ") for name in fixed["variant"])
            ticks = [label.partition(" (")[0] for label in labels]
            axes.set_xticks(range(len(fixed)), ticks, rotation=90)
            axes.set_title(str(environment))
        level = f"{100 * look.confidence:g} % interval"
        legend(figure, f"Dot or line: mean over seeds; bar or band: its {level}. Grey: constants.")
    return figure


def solved(source: Source) -> pd.DataFrame:
    """How many seeds solve at least `SOLVED` of their last episodes, from metrics.csv's frame."""
    runs = source.data["metrics"]
    counted = runs.assign(solved=runs["solved"] >= SOLVED).groupby(["env", "variant"], sort=False)
    return counted["solved"].agg(solved="sum", seeds="size").reset_index()


def draw_solved(table: pd.DataFrame, look: PlotStyle) -> Figure:
    """A cell per variant and environment: the darker, the more seeds solve it; in it how many."""
    table = table.assign(
        share=table["solved"] / table["seeds"],
        text=table["solved"].astype(str) + "/" + table["seeds"].astype(str),
    )
    wide = table.pivot(index="variant", columns="env").loc[table["variant"].unique()]
    share, text = (wide[name][table["env"].unique()] for name in ("share", "text"))
    text = text.fillna("")  # where a variant has no runs
    with style():
        figure, (axes,) = grid(1, 1, height=0.24 * len(share) + 2 * LEGEND_HEIGHT)
        blues = seaborn.light_palette("#4a90c8", as_cmap=True)  # on which one colour can be read
        how: dict[str, Any] = {"vmin": 0, "vmax": 1, "cmap": blues, "linewidths": 1, "cbar": False}
        cells = {"size": "small", "color": "#111111"}
        seaborn.heatmap(share, ax=axes, annot=text, fmt="", annot_kws=cells, **how)
        axes.set(xlabel="", ylabel="")
        axes.set_yticks(axes.get_yticks(), [look.labels[name] for name in share.index], rotation=0)
        axes.set_xticks(axes.get_xticks(), share.columns, rotation=25, ha="left")
        axes.tick_params(top=False, labeltop=True, bottom=False, labelbottom=False, left=False)
        explained = f"solve at least {100 * SOLVED:g} % of the last episodes"
        legend(figure, f"How many seeds, of how many, {explained}. Darker: a larger share.")
    return figure


def forest(source: Source) -> pd.DataFrame:
    """Every part of every claim of the ledger, measured in what would be worth mentioning.

    Columns: measured (in which way), claim, statement, verdict and answer (of the claim, in its
    own words and in those of parts), part (what tells it from the claim's others), metric, seeds,
    difference, low, high, paper (the same in the paper's Table 1; NaN where that has none), outcome
    and size (of the part). More is in the claim's favour.
    """
    rows = []
    judgements = ((answer, way) for answer in source.answers for way in answer.ways.items())
    for answer, (how, judged) in judgements:
        common = (how, answer.claim, answer.statement, judged.verdict, judged.outcome)
        for part in judged.parts:
            values = part.difference, part.low, part.high, part.in_paper
            scaled = [value / part.worth_mentioning for value in values]
            measured = (_what(part, judged.parts, source), part.metric, part.seeds)
            rows.append((*common, *measured, *scaled, part.outcome, part.size))
    ways = list(dict.fromkeys(how for how, *_ in rows))
    rows.sort(key=lambda row: ways.index(row[0]))
    columns = ["measured", "claim", "statement", "verdict", "answer", "part", "metric", "seeds"]
    columns += ["difference", "low", "high", "paper", "outcome", "size"]
    return pd.DataFrame(rows, columns=columns)


def _what(part: Finding, parts: Sequence[Finding], source: Source) -> str:
    """What tells a part from the others of its claim; the metric where it has no others."""
    words = []
    metric = metric_labels(source.settings).get(part.metric, part.metric).lower()
    if any(other.environments != part.environments for other in parts):
        words += [_short(name, parts) for name in part.environments]
    if any(other.metric != part.metric for other in parts):
        words.append(metric)
    called = source.claims.variants
    variant = called.get(part.variant, part.variant)
    differ = [variant] if any(other.variant != part.variant for other in parts) else []
    over = [f"over {called.get(part.baseline, part.baseline)}"] if part.baseline else []
    words += [" ".join([*differ, *over])] if differ or over else []
    return ", ".join(words) or metric


def _short(environment: str, parts: Sequence[Finding]) -> str:
    """Without module and version, unless these tell it from another of the claim."""
    names = dict.fromkeys(name for part in parts for name in part.environments)
    short = {name: re.sub(r"^.*:|-v\d+$", "", name) for name in names}
    alike = list(short.values()).count(short[environment]) > 1
    return environment if alike else short[environment]


def draw_forest(table: pd.DataFrame, look: PlotStyle) -> Figure:
    """A line per part, a panel per way of measuring; above a claim's parts it and its verdict."""
    small: dict[str, Any] = {"fontsize": "x-small"}
    hollow: dict[str, Any] = {"color": INK, "markerfacecolor": "white", "markersize": 4}
    hollow |= {"label": "the paper's Table 1", "zorder": 1.5}
    ends = table[["low", "high", "difference", "paper"]].abs()
    reach = 1.1 * max(1, np.nanmax(ends.to_numpy()))
    ways = table["measured"].unique()
    said, table, blocks = _placed(table, SMALL_LETTERS // (1 + len(ways)))
    count = max(end for _, end in blocks.values())
    with style():
        height = 0.2 * count + LEGEND_HEIGHT
        figure, (names, *panels) = grid(1 + len(ways), 1 + len(ways), height=height)
        for how, axes in zip(ways, panels, strict=True):
            measured = table[table["measured"] == how]
            for outcome, (colour, label) in OUTCOMES.items():
                parts = measured[measured["outcome"] == outcome]
                if parts.empty:
                    continue
                bars = parts["place"], parts["low"], parts["high"]
                axes.hlines(*bars, color=colour, linewidth=1.2)
                dots: dict[str, Any] = {"color": colour, "markersize": 3.5, "label": label}
                axes.plot(parts["difference"], parts["place"], "o", **dots)
            if measured["paper"].notna().any():
                axes.plot(measured["paper"], measured["place"], "d", **hollow)
            axes.axvline(0, color=INK, linewidth=0.8, zorder=1)
            for margin in (-1, 1):
                axes.axvline(margin, color=INK, linewidth=0.8, linestyle="--", zorder=1)
            axes.set(title=str(how).capitalize(), xlim=(-reach, reach), yticks=[])
            axes.set_xlabel("Difference in favour of what is said\n(1: the margin)")
            for name, claim in measured.groupby("claim", sort=False):
                (verdict, answer), *_ = claim[["verdict", "answer"]].to_numpy()
                top, colour = blocks[str(name)][0] + 0.2, OUTCOMES[answer][0]
                axes.text(reach, top, verdict, color=colour, ha="right", va="top", **small)
        for shade, (name, (top, end)) in enumerate(blocks.items()):
            for panel in (names, *panels):
                panel.axhspan(top, end, color="0.9" if shade % 2 else "white", zorder=0)
            names.text(0, top + 0.2, said[name], va="top", **small)
        for _, row in table.drop_duplicates(["claim", "part"]).iterrows():
            names.text(1, row["place"], row["words"], ha="right", va="center", **small)
        names.set_axis_off()
        for panel in (names, *panels):
            panel.set_ylim(count, 0)
        level = f"{100 * CONFIDENCE:g} % interval"
        legend(figure, f"Dot: mean over seeds. Bar: its {level}. Dashed: the margin.")
    return figure


def wrapped(words: str, width: int) -> str:
    """Lines of words, of which a name and its number stay together."""
    return textwrap.fill(words.replace(" β", "\u00a0β").replace(" = ", "\u00a0=\u00a0"), width)


def _placed(
    table: pd.DataFrame, width: int
) -> tuple[dict[str, str], pd.DataFrame, dict[str, tuple[float, float]]]:
    """What each claim says in lines of so many letters; the parts, and where they are; its ends.

    The parts have their `words`, in such lines too, and their `place` from the top.
    """
    table = table.assign(words=table["part"].map(lambda part: wrapped(part, width)))
    end, said, blocks, placed = 0.0, {}, {}, []
    for name, claim in table.groupby("claim", sort=False):
        said[str(name)] = wrapped(f"{name} {claim['statement'].iloc[0]}", width)
        start, end = end, end + 0.3 + LINE * len(said[str(name)].splitlines())
        for _, ways in claim.groupby("part", sort=False):
            height = max(1.0, LINE * len(ways["words"].iloc[0].splitlines()))
            placed.append(pd.Series(end + height / 2, ways.index))
            end += height
        blocks[str(name)] = start, end
    return said, table.assign(place=pd.concat(placed)), blocks


def draw_readings(table: pd.DataFrame, look: PlotStyle) -> Figure:
    """Every reading as a line of dots with intervals; the paper's are hollow."""
    environments, lines = list(table["env"].unique()), in_order(table)
    variants = list(table["variant"].unique())
    step = min(0.22, 0.8 / len(variants))  # of a line, from variant to variant
    with style():
        count, height = len(environments), 0.34 * len(lines) + LEGEND_HEIGHT
        figure, panels = grid(count, count, "Training episodes", height=height)
        for environment, axes in zip(environments, panels, strict=True):
            for place, ((_, _, source), rows) in enumerate(lines):
                by_variant = rows[rows["env"] == environment].set_index("variant")
                for name in by_variant.index:
                    row = by_variant.loc[name]
                    shift = step * (variants.index(name) - (len(variants) - 1) / 2)
                    colour = look.colours[name]
                    axes.hlines(place + shift, row["low"], row["high"], color=colour, linewidth=1)
                    dot: dict[str, Any] = {"color": colour, "markersize": 3.5}
                    dot["markerfacecolor"] = "white" if source == PAPER else colour
                    dot["label"] = None if source == PAPER else look.labels[name]
                    axes.plot(row["mean"], place + shift, "o", **dot)
            for place in range(len(lines) - 1):
                axes.axhline(place + 0.5, color="0.9", linewidth=0.6, zorder=0)
            axes.set_xlim(left=-0.03 * axes.get_xlim()[1])  # dots at 0 are whole
            axes.locator_params(axis="x", nbins=4)
            axes.set_title(environment)
        titles = [title(*key, look.metrics) for key, _ in lines]
        panels[0].set_yticks(range(len(lines)), titles, fontsize="small")
        panels[0].invert_yaxis()
        for axes in panels[1:]:
            axes.sharey(panels[0])
            axes.tick_params(labelleft=False)
        level = f"{100 * look.confidence:g} % interval"
        legend(figure, f"Dot: mean over seeds. Bar: its {level}. Hollow: the paper.")
    return figure


class Picture(NamedTuple):
    """What makes the data of a picture, and what draws it."""

    data: Callable[[Source], pd.DataFrame]
    draw: Callable[[pd.DataFrame, PlotStyle], Figure]


PICTURES = {
    "every_seed": Picture(every_seed, draw_every_seed),
    "constants": Picture(constants, draw_constants),
    "solved": Picture(solved, draw_solved),
    "forest": Picture(forest, draw_forest),
    "readings": Picture(lambda source: source.data["readings"], draw_readings),
}
