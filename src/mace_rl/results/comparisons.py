"""Is one variant better than another? Compared on shared seeds, by environment and metric."""

from typing import NamedTuple

import numpy as np
import pandas as pd

from mace_rl.config.results import MetricsConfig
from mace_rl.results.metrics import Metric, all_metrics
from mace_rl.results.statistics import holm, paired_comparison, probability_of_improvement


class Comparison(NamedTuple):
    """A row of comparisons.csv: `variant` against `baseline`, over the seeds that both have."""

    env: str
    metric: str
    variant: str
    baseline: str
    seeds: int
    censored: int  # runs of both that never got there: they count with the budget
    difference: float  # mean of variant - baseline, in episodes or return
    low: float  # of its interval
    high: float
    p_value: float  # two-sided, sign-flip test; with n seeds never below 2 / 2ⁿ
    p_holm: float  # adjusted for all rows of the table, the more the stricter
    probability: float  # that a run of the variant is better than one of the baseline
    probability_low: float  # of its interval
    probability_high: float


def comparisons(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The data of comparisons.csv from the frame of metrics.csv.

    One `Comparison` per environment, metric and configured pair of variants that are both there.
    """
    rows = [
        _compare(runs, metric, pair, settings)
        for _, runs in table.groupby("env", sort=False)
        for metric in all_metrics(settings)
        for pair in settings.comparisons
        if set(pair) <= set(runs["variant"])
    ]
    p_values = [row.p_value for row in rows]
    if not np.isnan(p_values).any():  # as with one seed
        adjusted = holm(p_values)
        rows = [row._replace(p_holm=p) for row, p in zip(rows, adjusted, strict=True)]
    return pd.DataFrame(rows, columns=Comparison._fields)


def _compare(
    runs: pd.DataFrame, metric: Metric, pair: list[str], settings: MetricsConfig
) -> Comparison:
    """One row, but for `p_holm`, from the rows of metrics.csv of one environment."""
    runs = runs[runs["variant"].isin(pair)]
    wide = runs.pivot(index="seed", columns="variant", values=metric.name).astype(np.float64)
    x, y = (wide[variant].to_numpy() for variant in pair)  # [seeds] each
    sign = -1 if metric.unit == "episodes" else 1  # greater is better
    how = (settings.confidence, settings.bootstrap_repetitions)
    seed = settings.bootstrap_seed  # of a generator for each: no cell depends on another
    difference = paired_comparison(x, y, *how, np.random.default_rng(seed))
    better = probability_of_improvement(sign * x, sign * y, *how, np.random.default_rng(seed))
    censored = int(runs[metric.flag].sum()) if metric.flag in runs else 0
    environment = str(runs["env"].iloc[0])
    return Comparison(
        environment, metric.name, *pair, len(x), censored, *difference, np.nan, *better
    )
