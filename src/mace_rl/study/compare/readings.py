"""What decides the ranking: Table 1 under every reading of its two metrics (docs/metrics.md).

Beside the runs as they are stand the same runs with their returns in random order. Whoever is first
there is first by chance and by how returns are distributed, since nothing is learned in that order.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from mace_rl.runs.records import RunKey
from mace_rl.study.compare.statistics import logrank
from mace_rl.study.compare.summary import summary
from mace_rl.study.measure.metrics import Metric, all_metrics
from mace_rl.study.measure.run_metrics import metrics_table
from mace_rl.study.metrics_config import MetricsConfig
from mace_rl.study.paper import PAPER_METRICS, PAPER_TABLE1
from mace_rl.study.show.curves import LEGEND_HEIGHT, PlotStyle, grid, legend, style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER, RUNS, SHUFFLED = "paper", "runs", "shuffled"
# The paper's words, and the rule of its public code: what is worth asking of noise too.
ASKED_OF_NOISE = ("sample_efficiency", "convergence_steps_public_code")
COLUMNS = ["env", "kind", "reading", "source", "variant", "mean", "low", "high", "seeds"]
COLUMNS += ["censored", "rank", "p_value"]  # of readings.csv
LEVEL = 0.05  # of the log-rank test that the first is really ahead


def kinds(settings: MetricsConfig) -> list[tuple[str, Metric]]:
    """Every reading with the one of the paper's metrics that it reads, in the order of tables."""
    found = [metric for metric in all_metrics(settings) if metric.unit == "episodes"]
    return [
        (kind, metric) for kind in PAPER_METRICS for metric in found if metric.name.startswith(kind)
    ]


def shuffled(
    frames: Mapping[RunKey, pd.DataFrame], settings: MetricsConfig
) -> dict[RunKey, pd.DataFrame]:
    """The same runs, the returns of each in random order."""
    generator = np.random.default_rng(settings.bootstrap_seed)
    return {
        run: frame.assign(extrinsic_return=generator.permutation(frame["extrinsic_return"]))
        for run, frame in frames.items()
    }


def readings(frames: Mapping[RunKey, pd.DataFrame], settings: MetricsConfig) -> pd.DataFrame:
    """The data of readings.csv: one row per environment, reading, source and variant.

    frames: the records (`read_episodes`) of each run (environment, variant, seed). Columns: env,
    kind (of the paper's metrics), reading, source (`RUNS`, `SHUFFLED`, or `PAPER`: its Table 1),
    variant, mean, low, high (its interval; NaN of the paper), seeds, censored, rank (1: the lowest
    mean) and p_value: of the log-rank test, not corrected, of this variant against that of rank 1.
    """
    found = kinds(settings)
    runs = {RUNS: metrics_table(frames, settings)}
    runs[SHUFFLED] = metrics_table(shuffled(frames, settings), settings)
    means = {source: summary(table, settings) for source, table in runs.items()}
    parts = []
    for environment in dict.fromkeys(name for name, _, _ in frames):
        parts += [_published(environment, kind, list(frames)) for kind in PAPER_METRICS]
        for (kind, metric), source in itertools.product(found, (RUNS, SHUFFLED)):
            if source == RUNS or metric.name in ASKED_OF_NOISE:
                table, own = means[source], runs[source]
                rows = table[(table["env"] == environment) & (table["metric"] == metric.name)]
                own = own[own["env"] == environment]
                parts.append(
                    _measured(rows, own, metric, settings).assign(kind=kind, source=source)
                )
    table = pd.concat(parts).rename(columns={"metric": "reading"})
    return table[COLUMNS].reset_index(drop=True)


def _published(environment: str, kind: str, runs: Sequence[RunKey]) -> pd.DataFrame:
    """The numbers of the paper's Table 1, of the variants that are there."""
    values = {
        name: float(PAPER_TABLE1[environment, name][PAPER_METRICS.index(kind)])
        for name in dict.fromkeys(variant for _, variant, _ in runs)
        if (environment, name) in PAPER_TABLE1
    }
    rows = pd.DataFrame({"variant": list(values), "mean": list(values.values())})
    rows = rows.assign(env=environment, kind=kind, metric=kind, source=PAPER, low=np.nan)
    rows = rows.assign(high=np.nan, seeds=0, censored=0, p_value=np.nan)
    return rows.assign(rank=rows["mean"].rank(method="min").astype(int))


def _measured(
    rows: pd.DataFrame, runs: pd.DataFrame, metric: Metric, settings: MetricsConfig
) -> pd.DataFrame:
    """The rows of one reading in a `summary`, with the rank and the test of each variant."""
    variants = rows["variant"].to_list()
    first = variants[int(rows["mean"].argmin())]
    reached = {
        str(name): np.where(own[metric.flag] == 1, np.inf, own[metric.name])
        for name, own in runs.groupby("variant")
    }
    p_values = [
        np.nan
        if name == first
        else logrank(
            reached[first],
            reached[name],
            settings.bootstrap_repetitions,
            np.random.default_rng(settings.bootstrap_seed),
        )
        for name in variants
    ]
    return rows.assign(rank=rows["mean"].rank(method="min").astype(int), p_value=p_values)


def title(kind: str, reading: str, source: str, settings: MetricsConfig) -> str:
    """A reading as a row of the table or the figure is called."""
    names = {metric.name: metric.label for _, metric in kinds(settings)}
    if source == PAPER:
        return f"{names[kind]}: the paper's Table 1"
    if source == SHUFFLED:
        return f"{names[reading]}, returns shuffled"
    return names[reading]


def in_order(
    table: pd.DataFrame,
) -> list[tuple[tuple[str, str, str], pd.DataFrame]]:
    """The rows of each line of the table: by metric; the paper's first, shuffled runs last."""
    found = [
        ((str(kind), str(reading), str(source)), rows)
        for (kind, reading, source), rows in table.groupby(
            ["kind", "reading", "source"], sort=False
        )
    ]
    sources = PAPER, RUNS, SHUFFLED
    return sorted(found, key=lambda one: (PAPER_METRICS.index(one[0][0]), sources.index(one[0][2])))


def ranked(rows: pd.DataFrame) -> tuple[pd.DataFrame, bool]:
    """The rows in the order of their means, and whether the first place is more than chance."""
    ordered = rows.sort_values("mean", kind="stable")
    others = ordered["p_value"].iloc[1:]
    sure = others.notna().any() and (others < LEVEL).all() and (ordered["rank"] == 1).sum() == 1
    return ordered, bool(sure)


def draw_readings(table: pd.DataFrame, settings: MetricsConfig, look: PlotStyle) -> "Figure":
    """Every reading as a line of dots with intervals, from `readings`; the paper's are hollow."""
    environments, lines = list(table["env"].unique()), in_order(table)
    variants = list(table["variant"].unique())
    step = min(0.22, 0.8 / len(variants))  # of a line, from variant to variant
    with style():
        count, height = len(environments), 0.34 * len(lines) + LEGEND_HEIGHT
        figure, panels = grid(count, count, "Training episodes", height=height)
        for environment, axes in zip(environments, panels, strict=True):
            for place, ((_, _, source), rows) in enumerate(lines):
                own = rows[rows["env"] == environment].set_index("variant")
                for name in own.index:
                    row = own.loc[name]
                    shift = step * (variants.index(name) - (len(variants) - 1) / 2)
                    colour = look.colours[name]
                    axes.hlines(place + shift, row["low"], row["high"], color=colour, linewidth=1)
                    axes.plot(
                        row["mean"],
                        place + shift,
                        "o",
                        markersize=3.5,
                        color=colour,
                        markerfacecolor="white" if source == PAPER else colour,
                        label=look.labels[name] if place == 1 else None,
                    )
            for place in range(len(lines) - 1):
                axes.axhline(place + 0.5, color="0.9", linewidth=0.6, zorder=0)
            axes.set_xlim(left=-0.03 * axes.get_xlim()[1])  # dots at 0 are whole
            axes.locator_params(axis="x", nbins=4)
            axes.set_title(environment)
        panels[0].set_yticks(
            range(len(lines)), [title(*key, settings) for key, _ in lines], fontsize="small"
        )
        panels[0].invert_yaxis()
        for axes in panels[1:]:
            axes.sharey(panels[0])
            axes.tick_params(labelleft=False)
        level = f"{100 * look.confidence:g} % interval"
        legend(figure, f"Dot: mean over seeds. Bar: its {level}. Hollow: the paper.")
    return figure
