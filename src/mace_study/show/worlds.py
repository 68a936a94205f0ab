"""Pictures of several studies of the same claims: each a *world* (reference/worlds/protocol.md)."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from mace_study.compare.ceiling import LAST
from mace_study.compare.claims_config import Table1Config
from mace_study.compare.estimates import CONFIDENCE
from mace_study.compare.ledger import Answer, Judgement
from mace_study.show.curves import (
    LEGEND_HEIGHT,
    PlotStyle,
    Quantity,
    draw_means,
    grid,
    legend,
    style,
)
from mace_study.show.pictures import INK, OUTCOMES, wrapped
from mace_study.show.tables import number

LINE = 0.15  # inches
NUMBER = "the part with the smallest p of those that decide, its difference and 95 % interval"
SEVERAL = 3  # times the least number as the greatest: from there on a logarithmic axis
# From seaborn's palette that the colour-blind can tell apart; none is a verdict's.
COLOURS = ("#949494", "#56b4e9", "#ca9161")


def verdicts(worlds: Mapping[str, Sequence[Answer]]) -> pd.DataFrame:
    """A row per way of measuring, claim and world.

    Columns: measured (in which way), claim, statement, world, outcome, verdict; difference, low,
    high and p_holm of the part with the smallest p, of those that decide.
    """
    rows = [
        (how, answer.claim, answer.statement, world, *_decisive(judged))
        for world, answers in worlds.items()
        for answer in answers
        for how, judged in answer.ways.items()
    ]
    names = ["measured", "claim", "statement", "world", "outcome", "verdict"]
    return pd.DataFrame(rows, columns=[*names, "difference", "low", "high", "p_holm"])


def _decisive(judged: Judgement) -> tuple[Any, ...]:
    """Outcome and verdict; difference, low, high and p_holm of the part that decides.

    A part reversed beside one shown makes a claim absent, too.
    """
    decide = {"absent", "reversed"} if judged.outcome == "absent" else {judged.outcome}
    deciding = [part for part in judged.parts if part.outcome in decide]
    part = min(deciding, key=lambda part: (part.p_holm, -abs(part.difference)))
    verdict = judged.outcome, judged.verdict
    return *verdict, part.difference, part.low, part.high, part.p_holm


def difference(value: float, low: float, high: float) -> str:
    """With its interval, in as many digits as its size asks for."""
    largest = max(abs(low), abs(high))
    digits = 0 if largest >= 10 else 1 if largest >= 1 else 3
    return f"{number(value, digits)} ({number(low, digits)} to {number(high, digits)})"


def draw_verdicts(table: pd.DataFrame) -> Figure:
    """A cell per claim and world in the verdict's colour, with the difference that decides."""
    claims = table.drop_duplicates("claim")
    named = zip(claims["claim"], claims["statement"], strict=True)
    said = {claim: wrapped(f"{claim} {statement}", 46) for claim, statement in named}
    heights = np.array([max(2, text.count("\n") + 1) + 0.5 for text in said.values()])
    tops = dict(zip(said, np.cumsum(heights) - heights, strict=True))
    small: dict[str, Any] = {"fontsize": "x-small", "va": "center"}
    worlds = list(table["world"].unique())
    with style():
        figure, (axes,) = grid(1, 1, height=LINE * heights.sum() + LEGEND_HEIGHT)
        for place, (claim, text) in enumerate(said.items()):
            axes.text(-0.03, tops[claim] + heights[place] / 2, text, ha="right", **small)
        rows: Any = table.itertuples()
        for row in rows:
            left, height = worlds.index(row.world), heights[list(said).index(row.claim)]
            colour, label = OUTCOMES[row.outcome]
            verdict = row.verdict.replace(" (", "\n(")
            lines = f"{verdict}\n{difference(row.difference, row.low, row.high)}"
            area = (
                (left, left + 0.97),
                (tops[row.claim] + 0.05,) * 2,
                (tops[row.claim] + height,) * 2,
            )
            axes.fill_between(*area, color=colour, alpha=0.25, linewidth=0, label=label)
            axes.text(left + 0.485, tops[row.claim] + height / 2, lines, ha="center", **small)
        axes.set(xlim=(-1.6, len(worlds)), ylim=(heights.sum(), 0), yticks=[])
        axes.set_xticks(np.arange(len(worlds)) + 0.485, worlds)
        axes.tick_params(top=False, labeltop=True, bottom=False, labelbottom=False)
        axes.spines[:].set_visible(False)
        legend(figure, f"Number: {NUMBER}. Colour: what decides.")
    return figure


def draw_specification(table: pd.DataFrame, readings: Sequence[str]) -> Figure:
    """A cell per claim and of these readings in the colour of what came out, a panel per world.

    table: of `mace_study.compare.specification`, with the column world. Pale: a claim that is cut
    to the environments that are there.
    """
    claims = table.drop_duplicates("claim")
    claims = claims.iloc[claims["claim"].str[1:].astype(int).argsort()]
    named = zip(claims["claim"], claims["statement"], strict=True)
    said = {claim: wrapped(f"{claim} {statement}", 44) for claim, statement in named}
    groups = table.groupby("world", sort=False)
    small: dict[str, Any] = {"fontsize": "x-small", "va": "center"}
    with style():
        figure, panels = grid(groups.ngroups, groups.ngroups, height=LINE * (2.4 * len(said) + 8))
        for (world, answers), axes in zip(groups, panels, strict=True):
            rows: Any = answers.itertuples()
            for row in rows:
                left, top = readings.index(row.reading), list(said).index(row.claim)
                colour, label = OUTCOMES.get(row.outcome, ("#ffffff", "not asked: β does not move"))
                area = (left + 0.04, left + 0.96), (top + 0.06,) * 2, (top + 0.94,) * 2
                look: dict[str, Any] = {"color": colour, "edgecolor": "#b0b0b0", "linewidth": 0.4}
                axes.fill_between(*area, alpha=0.75 if row.whole else 0.2, **look)
                axes.fill_between([0], [0], alpha=0.75, label=label, **look)  # for the legend
            axes.set(xlim=(0, len(readings)), ylim=(len(said), 0), title=str(world))
            names = [name.removeprefix("mace_").replace("_", "\n") for name in readings]
            axes.set_xticks(np.arange(len(readings)) + 0.5, names, rotation=90, fontsize="x-small")
            axes.set_yticks(np.arange(len(said)) + 0.5, list(said.values()), **small)
            axes.tick_params(length=0)
            axes.spines[:].set_visible(False)
        for axes in panels[1:]:
            axes.set_yticks([])
        legend(figure, "Pale: without the claim's part in Hopper.")
    return figure


def draw_gains(table: pd.DataFrame) -> Figure:
    """A panel per task: what each variant and the oracle earn over PPO, one axis for all.

    table: of `mace_study.compare.ceiling.over_ppo`, with the column world.
    """
    order = ["plain", "tuned"]
    ranked = table["world"].map(lambda world: order.index(world) if world in order else len(order))
    oracles = table["variant"].str.startswith("oracle")
    places = np.lexsort([~oracles, ranked])  # which keeps the order of what is alike
    groups = table.iloc[places].groupby(["world", "env"], sort=False)
    longest = groups.size().groupby(np.arange(groups.ngroups) // 2).max()  # by row of panels
    ends = table[["low", "high"]].to_numpy()
    margin = 0.05 * np.ptp(ends)
    with style():
        figure, panels = grid(groups.ngroups, 2, "Gain over PPO")
        heights = [LINE * (1.4 * most + 4) for most in longest]
        figure.set_figheight(sum(heights) + LEGEND_HEIGHT)
        rows: Any = panels[0].get_gridspec()
        rows.set_height_ratios(heights)
        for number, (((world, env), earned), axes) in enumerate(zip(groups, panels, strict=True)):
            axes.axvline(0, color=INK, linewidth=0.8, zorder=1)
            runs: Any = earned.itertuples()
            for place, row in enumerate(runs):
                oracle = row.variant.startswith("oracle")
                colour = COLOURS[2] if oracle else COLOURS[0]
                axes.hlines(place, row.low, row.high, color=colour, linewidth=1.2)
                label = "oracle" if oracle else "learned, fixed or constant β"
                dot: dict[str, Any] = {"color": colour, "markersize": 3.5, "label": label}
                axes.plot(row.gain, place, "o", **dot)
            axes.set(title=f"{env} ({world})", ylim=(longest[number // 2] - 0.5, -0.5))
            axes.set_xlim(ends.min() - margin, ends.max() + margin)
            axes.set_yticks(range(len(earned)), list(earned["variant"]), fontsize="x-small")
        shares = f"In the first {LAST} episodes, as shares of what solving gives."
        legend(figure, f"{shares} Bar: {100 * CONFIDENCE:g} % interval over seeds.")
    return figure


def draw_numbers(runs: Mapping[str, pd.DataFrame], table1: Table1Config, look: PlotStyle) -> Figure:
    """Every seed of every world as a dot, a strip for each; the paper's number across them.

    runs: by world the frame of metrics.csv.
    """
    seen = set().union(*(table["env"] for table in runs.values()))
    environments = [env for env in table1.values if env in seen]
    middles = np.arange(len(table1.variants)) * (len(runs) + 1) + (len(runs) - 1) / 2
    jitter = np.random.default_rng(0)
    with style():
        cells = list(itertools.product(environments, enumerate(table1.public_code)))
        width = len(table1.public_code)
        figure, panels = grid(len(cells), width, "Training episodes", height=2.0)
        for (env, (column, metric)), axes in zip(cells, panels, strict=True):
            for middle, variant in zip(middles, table1.variants, strict=True):
                for number, (world, table) in enumerate(runs.items()):
                    values = table[(table["env"] == env) & (table["variant"] == variant)][metric]
                    place = middle + number - (len(runs) - 1) / 2
                    dots: dict[str, Any] = {"s": 5, "linewidth": 0, "alpha": 0.7, "label": world}
                    places = place + jitter.uniform(-0.3, 0.3, len(values))
                    axes.scatter(values, places, color=COLOURS[number], **dots)
                ends = middle - len(runs) / 2, middle + len(runs) / 2
                paper = table1.values[env][variant][column]
                axes.vlines(paper, *ends, color=INK, linewidth=1.3, label="the paper's number")
            least, most = axes.dataLim.intervalx
            if most > SEVERAL * least:
                axes.set_xscale("log")
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.xaxis.set_major_formatter("{x:.0f}")
                axes.minorticks_off()
            else:
                axes.locator_params(axis="x", nbins=4)
            axes.set_title(f"{env}: {look.metrics[metric].lower()}")
            names = ["" if column else look.labels[name] for name in table1.variants]
            axes.set_yticks(middles, names)
            axes.invert_yaxis()
        legend(figure, "Dot: one seed.")
    return figure


def draw_curves(curves: Mapping[str, pd.DataFrame], shown: Quantity, look: PlotStyle) -> Figure:
    """The mean curves of Figure 1 with their intervals, a row per world; by world figure1.csv."""
    environments = list(
        dict.fromkeys(env for means in curves.values() for env in means["env"].unique())
    )
    with style():
        count = len(environments) * len(curves)
        names = "Training episodes", shown.label
        figure, panels = grid(count, len(environments), *names, height=1.7)
        places = iter(panels)
        for world, of_world in curves.items():
            for env in environments:
                axes, means = next(places), of_world[of_world["env"] == env]
                if means.empty:
                    axes.set_axis_off()
                    continue
                axes.set_title(f"{env}, {world}")
                axes.locator_params(nbins=4)
                draw_means(axes, means, look)
        for column, _ in enumerate(environments):
            first, *others = (axes for axes in panels[column :: len(environments)] if axes.axison)
            for axes in others:
                axes.sharey(first)
                axes.sharex(first)
        legend(figure, f"Line: mean over seeds. Band: its {100 * look.confidence:g} % interval.")
    return figure
