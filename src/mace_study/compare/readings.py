"""What decides the ranking: Table 1 under every reading of its two metrics (docs/metrics.md).

Beside the runs stand the same runs with their returns in random order, in which nothing is learned.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from mace_rl.training.records import RunKey
from mace_study.compare.claims_config import Table1Config
from mace_study.compare.comparisons import reached_within
from mace_study.compare.statistics import logrank
from mace_study.compare.summary import summary
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import Metric, all_metrics
from mace_study.measure.metrics_csv import metrics_table

PAPER, RUNS, SHUFFLED = "paper", "runs", "shuffled"
COLUMNS = ["env", "kind", "reading", "source", "variant", "mean", "low", "high", "seeds"]
COLUMNS += ["censored", "rank", "p_value"]  # of readings.csv
LEVEL = 0.05  # of the log-rank test that the first is really ahead


def kinds(settings: MetricsConfig, table1: Table1Config) -> list[tuple[str, Metric]]:
    """Every reading, in episodes, with the one of the paper's metrics that it reads."""
    both = itertools.product(table1.metrics, all_metrics(settings))
    return [
        (kind, metric)
        for kind, metric in both
        if metric.unit == "episodes" and table1.metric_of(metric.name) == kind
    ]


def shuffled(
    frames: Mapping[RunKey, pd.DataFrame], settings: MetricsConfig
) -> dict[RunKey, pd.DataFrame]:
    """The same runs, the returns of each in random order."""
    mixed = np.random.default_rng(settings.bootstrap_seed).permutation
    return {
        run: frame.assign(extrinsic_return=mixed(frame["extrinsic_return"]))
        for run, frame in frames.items()
    }


def readings(
    frames: Mapping[RunKey, pd.DataFrame],
    table: pd.DataFrame,
    settings: MetricsConfig,
    table1: Table1Config,
) -> pd.DataFrame:
    """The data of readings.csv: one row per environment, reading, source and variant.

    frames: `FinishedRun.episodes` of each run (environment, variant, seed); table: their frame of
    metrics.csv. Columns: env, kind (of the paper's metrics), reading, source (`RUNS`, `SHUFFLED`,
    or `PAPER`: its Table 1), variant, mean, low, high (its interval; NaN of the paper), seeds,
    censored, rank (1: the lowest mean, if training ended with the shortest budget of the
    environment's variants) and p_value: of the log-rank test, not corrected, of this variant
    against that of rank 1.
    """
    asked = kinds(settings, table1)
    rules = [metric for _, metric in asked if metric.name in table1.public_code]
    mixed = metrics_table(shuffled(frames, settings), settings, rules)
    runs = {RUNS: table, SHUFFLED: mixed}
    means = {source: summary(rows, settings, table1) for source, rows in runs.items()}
    parts = []
    for environment in dict.fromkeys(name for name, _, _ in frames):
        for kind in dict.fromkeys(kind for kind, _ in asked):
            parts.append(_published(environment, kind, list(frames), table1))
        for (kind, metric), source in itertools.product(asked, (RUNS, SHUFFLED)):
            if source == RUNS or metric in rules:
                both = means[source], runs[source]
                rows, of_runs = (frame[frame["env"] == environment] for frame in both)
                rows = _measured(rows[rows["metric"] == metric.name], of_runs, metric, settings)
                parts.append(rows.assign(kind=kind, source=source))
    found = pd.concat(parts).rename(columns={"metric": "reading"})
    return found[COLUMNS].reset_index(drop=True)


def _published(
    environment: str, kind: str, runs: Sequence[RunKey], table1: Table1Config
) -> pd.DataFrame:
    """The numbers of the paper's Table 1, of the variants that are there."""
    variants = list(dict.fromkeys(variant for _, variant, _ in runs))
    values = [table1.value(environment, name, kind) for name in variants]
    rows = pd.DataFrame({"variant": variants, "mean": np.array(values, np.float64)}).dropna()
    rows = rows.assign(env=environment, kind=kind, metric=kind, source=PAPER, low=np.nan)
    rows = rows.assign(high=np.nan, seeds=0, censored=0, p_value=np.nan)
    return rows.assign(rank=rows["mean"].rank(method="min").astype(int))


def _measured(
    rows: pd.DataFrame, runs: pd.DataFrame, metric: Metric, settings: MetricsConfig
) -> pd.DataFrame:
    """The rows of one reading in a `summary`, with the rank and the test of each variant."""
    variants = rows["variant"].to_list()
    budget = int(runs["episodes"].min())
    reached = {
        name: reached_within(runs[runs["variant"] == name], [metric], budget)[:, 0]
        for name in variants
    }
    means = pd.Series([np.minimum(reached[name], budget).mean() for name in variants], rows.index)
    first = variants[int(means.argmin())]
    p_values = [np.nan] * len(variants)
    for place, name in enumerate(variants):
        if name != first:
            how = settings.bootstrap_repetitions, np.random.default_rng(settings.bootstrap_seed)
            p_values[place] = logrank(reached[first], reached[name], *how)
    return rows.assign(rank=means.rank(method="min").astype(int), p_value=p_values)


def title(kind: str, reading: str, source: str, names: Mapping[str, str]) -> str:
    """A reading as a row of the table or the figure is called; `names` are the metrics' labels."""
    if source == PAPER:
        return f"{names[kind]}: the paper's Table 1"
    return names[reading] + (", returns shuffled" if source == SHUFFLED else "")


def in_order(table: pd.DataFrame) -> list[tuple[tuple[str, str, str], pd.DataFrame]]:
    """The rows of each line of the table: by metric; the paper's first, shuffled runs last."""
    order = [*table["kind"].unique()], [PAPER, RUNS, SHUFFLED]
    lines: Any = table.groupby(["kind", "reading", "source"], sort=False)
    return sorted(lines, key=lambda line: (order[0].index(line[0][0]), order[1].index(line[0][2])))


def ranked(rows: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], bool]:
    """The rows in the order of their ranks, and whether the first place is more than chance."""
    ordered = sorted(rows, key=lambda row: row["rank"])
    others = [row["p_value"] for row in ordered[1:]]
    alone = [row["rank"] for row in rows].count(1) == 1
    return ordered, bool(others) and alone and all(p < LEVEL for p in others)
