"""Each metric averaged over seeds: the data of table1.csv and supplement.csv."""

import math

import numpy as np
import pandas as pd

from mace_rl.study.compare.statistics import interval
from mace_rl.study.measure.metrics import all_metrics
from mace_rl.study.metrics_config import MetricsConfig
from mace_rl.study.paper import PAPER_METRICS, PAPER_TABLE1

DIGITS = {"episodes": 0, "return": 1, "share": 2}  # after the point, by a metric's unit, at least


def summary(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """All metrics averaged over seeds; `table` is the frame of metrics.csv.

    One row per environment, variant and metric, in the order of `table`: `mean`,
    the bounds `low` and `high` of its interval (NaN with one seed; cut to where its mean must lie,
    [1, E] for a metric in episodes and [0, 1] for a share), the number of `seeds`, how many of them
    are `censored` (counted with E, so the mean is a lower bound), the budget E in `episodes`, and
    the `paper`'s value (missing where it has none).
    """
    rows = []
    for (environment, variant), runs in table.groupby(["env", "variant"], sort=False):
        published = PAPER_TABLE1.get((str(environment), str(variant)), ())
        paper = dict(zip(PAPER_METRICS, published, strict=False))  # empty if it has none
        for metric in all_metrics(settings):
            values = runs[metric.name].to_numpy(np.float64)  # [seeds]
            low, high = interval(values, settings)
            limits = {"episodes": (1, runs["episodes"].iloc[0]), "share": (0, 1)}
            low, high = np.clip((low, high), *limits.get(metric.unit, (-np.inf, np.inf)))
            rows.append(
                {
                    "env": environment,
                    "variant": variant,
                    "metric": metric.name,
                    "mean": values.mean(),
                    "low": float(low),
                    "high": float(high),
                    "seeds": len(values),
                    "censored": int(runs[metric.flag].sum()) if metric.flag in runs else 0,
                    "episodes": int(runs["episodes"].iloc[0]),
                    "paper": paper.get(metric.name),
                }
            )
    return pd.DataFrame(rows).astype({"paper": "Int64"})


def table1(means: pd.DataFrame) -> pd.DataFrame:
    """The data of table1.csv: of a `summary` the paper's two metrics."""
    return means[means["metric"].isin(PAPER_METRICS)]


def supplement(means: pd.DataFrame) -> pd.DataFrame:
    """The data of supplement.csv: the other metrics."""
    return means[~means["metric"].isin(PAPER_METRICS)]


def digits_by_metric(table: pd.DataFrame, settings: MetricsConfig) -> dict[tuple[str, str], int]:
    """How many digits after the point a `summary` is shown with, by environment and metric.

    Of returns as many as give the largest mean three digits: some environments' are all below 1.
    """
    units = {metric.name: metric.unit for metric in all_metrics(settings)}
    found = {}
    for (environment, metric), rows in table.groupby(["env", "metric"], sort=False):
        unit, largest = units[str(metric)], rows["mean"].abs().max()
        digits = DIGITS[unit]
        if unit == "return" and largest > 0:
            digits = max(digits, 2 - math.floor(math.log10(largest)))
        found[str(environment), str(metric)] = digits
    return found


def from_to(counts: pd.Series) -> str:
    """A number, or from which to which."""
    low, high = counts.min(), counts.max()
    return str(low) if low == high else f"{low} to {high}"
