"""Each metric averaged over seeds: the data of table1.csv and supplement.csv."""

import math

import numpy as np
import pandas as pd

from mace_study.compare.claims_config import Table1Config
from mace_study.compare.statistics import interval
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import all_metrics, metric_units

DIGITS = {"episodes": 0, "return": 1, "share": 2}  # after the point, by a metric's unit, at least

COLUMNS = ["env", "variant", "metric", "mean", "low", "high", "seeds", "censored", "episodes"]
COLUMNS += ["paper"]  # of table1.csv and supplement.csv


def summary(table: pd.DataFrame, settings: MetricsConfig, table1: Table1Config) -> pd.DataFrame:
    """The metrics of `table`, a frame of metrics.csv, averaged over seeds; `table1`: the paper's.

    One row per environment, variant and metric, in the order of `table`. The interval (NaN with one
    seed) is cut to where the mean must lie. `censored`: how many of the seeds count with the budget
    E, so that the mean is a lower bound. `episodes`: E, of the longest run. `paper`: its value, or
    none.
    """
    rows = []
    for (environment, variant), runs in table.groupby(["env", "variant"], sort=False):
        for metric in (known for known in all_metrics(settings) if known.name in runs):
            values = runs[metric.name].to_numpy(np.float64)  # [seeds]
            low, high = interval(values, settings)
            limits = {"episodes": (1, runs["episodes"].mean()), "share": (0, 1)}
            low, high = np.clip((low, high), *limits.get(metric.unit, (-np.inf, np.inf)))
            censored = int(runs[metric.flag].sum()) if metric.flag in runs else 0
            in_paper = table1.value(str(environment), str(variant), metric.name)
            found = environment, variant, metric.name, values.mean(), float(low), float(high)
            rows.append((*found, len(values), censored, int(runs["episodes"].max()), in_paper))
    fractions = any(isinstance(in_paper, float) for *_, in_paper in rows)
    frame = pd.DataFrame(rows, columns=COLUMNS)
    return frame.astype({"paper": "Float64" if fractions else "Int64"})


def split(means: pd.DataFrame, table1: Table1Config) -> tuple[pd.DataFrame, pd.DataFrame]:
    """A `summary` as the data of table1.csv, which has the paper's metrics, and supplement.csv."""
    papers = means["metric"].isin(table1.metrics)
    return means[papers], means[~papers]


def digits_by_metric(table: pd.DataFrame, settings: MetricsConfig) -> dict[tuple[str, str], int]:
    """How many digits after the point a `summary` is shown with, by environment and metric.

    Of returns as many as give the largest mean three digits: some environments' are all below 1.
    """
    found = {}
    for (environment, metric), rows in table.groupby(["env", "metric"], sort=False):
        unit, largest = metric_units(settings)[str(metric)], rows["mean"].abs().max()
        digits = DIGITS[unit]
        if unit == "return" and largest > 0:
            digits = max(digits, 2 - math.floor(math.log10(largest)))
        found[str(environment), str(metric)] = digits
    return found


def from_to(counts: pd.Series) -> str:
    """A number, or from which to which."""
    low, high = counts.min(), counts.max()
    return str(low) if low == high else f"{low} to {high}"
