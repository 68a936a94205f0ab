"""metrics.csv: a row of `metrics` for each run, made from records or read back; and betas.csv."""

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from numbers import Real
from pathlib import Path

import numpy as np
import pandas as pd

from mace_rl.config.section import ConfigError
from mace_rl.records import RecordError, RunKey, read_table
from mace_rl.study.measure import metrics as measured
from mace_rl.study.measure.metrics import LearningCurve, Metric, all_metrics, metrics_columns
from mace_rl.study.metrics_config import MetricsConfig


def betas_columns(settings: MetricsConfig) -> dict[str, type]:
    """The columns of betas.csv; without a common bar nothing is before or after it."""
    correlations = measured.CORRELATIONS if settings.reference_return else [measured.CORRELATION]
    values = dict.fromkeys(["beta_end", "beta_lowest", "beta_highest", *correlations], float)
    return {"env": str, "variant": str, "seed": int} | values


def metrics_of_run(
    frame: pd.DataFrame, run: RunKey, settings: MetricsConfig
) -> dict[str, str | int | float]:
    """The row of metrics.csv of one run, from its records (`read_episodes`)."""
    environment, variant, seed = run
    curve = _curve(frame, environment, settings)
    row: dict[str, str | int | float] = {"env": environment, "variant": variant, "seed": seed}
    row |= {"episodes": len(curve.returns), "env_steps": int(frame["env_steps"].iloc[-1])}
    metrics = all_metrics(settings)
    for metric in metrics:
        value = metric.function(curve)
        if metric.unit == "episodes" and isinstance(value, measured.Attained):
            row |= {metric.name: int(value.number), metric.flag: int(value.censored)}
        elif metric.unit != "episodes" and isinstance(value, Real) and math.isfinite(value):
            row[metric.name] = float(value)
        else:
            kind = "an Attained" if metric.unit == "episodes" else "a finite number"
            raise ConfigError(f"{metric.name} of the run {run} is {value!r}, but should be {kind}")
    return {name: row[name] for name in metrics_columns(metrics)}


def _curve(frame: pd.DataFrame, environment: str, settings: MetricsConfig) -> LearningCurve:
    returns = frame["extrinsic_return"].to_numpy()
    final = measured.final_return(returns, settings.final_fraction)
    random = settings.random_return_in(environment)
    goals = [goal[environment] if goal else math.nan for goal in settings.goals]
    return LearningCurve(returns, final, random, settings, *goals)


def metrics_table(runs: Mapping[RunKey, pd.DataFrame], settings: MetricsConfig) -> pd.DataFrame:
    """One row of `metrics_columns` per run, in the order of `runs`."""
    table = pd.DataFrame([metrics_of_run(frame, run, settings) for run, frame in runs.items()])
    _check_attained("the table of metrics", table, all_metrics(settings))
    return table


def betas_table(runs: Mapping[RunKey, pd.DataFrame], settings: MetricsConfig) -> pd.DataFrame:
    """The data of betas.csv: of each run β at its end, its range, its stagnation correlations."""
    rows = []
    for run, frame in runs.items():
        beta, curve = frame["beta"].to_numpy(), _curve(frame, run[0], settings)
        end = measured.final_return(beta, settings.final_fraction)
        found = [measured.stagnation_correlation(curve.returns, beta, settings.moving_average)]
        found += measured.stagnation_correlations(curve, beta) if settings.reference_return else []
        rows.append([*run, end, beta.min(), beta.max(), *found])
    return pd.DataFrame(rows, columns=list(betas_columns(settings)))


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
