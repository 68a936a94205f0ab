"""metrics.csv: every metric of every run of a study, made and read again."""

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mace_rl.base.tables import RecordError, read_table
from mace_rl.config.section import ConfigError
from mace_rl.training.records import RunKey
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import (
    Attained,
    Metric,
    all_metrics,
    learning_curve,
    metrics_columns,
)

WANTED = {  # of a metric, by its unit
    "episodes": "an Attained, at a whole number",
    "return": "a finite number",
    "share": "a finite number from 0 to 1",
}


def metrics_table(
    runs: Mapping[RunKey, pd.DataFrame],
    settings: MetricsConfig,
    metrics: Sequence[Metric] | None = None,
) -> pd.DataFrame:
    """One row of `metrics_columns` per run, in the order of `runs`, with all metrics or these."""
    metrics = all_metrics(settings) if metrics is None else metrics
    rows = [metrics_of_run(frame, run, settings, metrics) for run, frame in runs.items()]
    table = pd.DataFrame(rows)
    _check_attained("the table of metrics", table, metrics)
    return table


def metrics_of_run(
    frame: pd.DataFrame, run: RunKey, settings: MetricsConfig, metrics: Sequence[Metric]
) -> dict[str, str | int | float]:
    """The row of metrics.csv of one run, from its records."""
    environment, variant, seed = run
    curve = learning_curve(frame["extrinsic_return"].to_numpy(), environment, settings)
    row: dict[str, str | int | float] = {"env": environment, "variant": variant, "seed": seed}
    row |= {"episodes": len(curve.returns), "env_steps": int(frame["env_steps"].iloc[-1])}
    for metric in metrics:
        value: Any = metric.function(curve)
        if not _fits(value, metric.unit):
            wanted = f"{metric.name} of the run {run} is {value!r}, but should be"
            raise ConfigError(f"{wanted} {WANTED[metric.unit]}")
        if metric.unit == "episodes":
            row |= {metric.name: int(value.number), metric.flag: int(value.censored)}
        else:
            row[metric.name] = float(value)
    return {name: row[name] for name in metrics_columns(metrics)}


def _fits(value: Any, unit: str) -> bool:
    if unit == "episodes":
        return isinstance(value, Attained) and value.number % 1 == 0
    real = isinstance(value, Real) and math.isfinite(value)
    return bool(real and (unit != "share" or 0 <= float(value) <= 1))


def read_metrics(
    path: str | Path, runs: Sequence[Sequence[str | int]], settings: MetricsConfig
) -> pd.DataFrame:
    """Read metrics.csv; `RecordError` unless it has a possible row for each of `runs`, in order.

    runs: of each its environment, variant, seed and number of episodes.
    """
    metrics = all_metrics(settings)
    table = read_table(path, metrics_columns(metrics))
    found = table[["env", "variant", "seed", "episodes"]].itertuples(index=False, name=None)
    for line, (run, right) in enumerate(zip_longest(found, map(tuple, runs)), start=2):
        if run != right:
            raise RecordError(f"{path}: line {line}: the run {run} stands where {right} belongs")
    _check_attained(str(path), table, metrics)
    return table


def _check_attained(origin: str, table: pd.DataFrame, metrics: Sequence[Metric]) -> None:
    """Refuse episodes outside of training, and flags that contradict them."""
    for metric in (metric for metric in metrics if metric.unit == "episodes"):
        episode, flag, last = table[metric.name], table[metric.flag], table["episodes"]
        right = episode.between(1, last) & flag.isin((0, 1)) & ((flag == 0) | (episode == last))
        if not right.all():
            row = int(np.argmin(right))
            raise RecordError(
                f"{origin}: line {row + 2}: {metric.name} is {episode[row]} of"
                f" {last[row]} episodes with {metric.flag} = {flag[row]}"
            )
