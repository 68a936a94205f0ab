"""What the seeds say of one part of a claim: estimates, intervals and tests."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy

from mace_rl.base.tables import RecordError
from mace_study.compare.claims_config import Part
from mace_study.compare.ledger import Finding
from mace_study.compare.statistics import (
    equivalence,
    probability_of_improvement,
    stratified_comparison,
)
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import Metric, all_metrics, metric_units

CONFIDENCE = 0.95  # of the intervals, whatever those of the tables have
LEVEL = 0.05  # of the corrected p values
WORTH_MENTIONING = 0.05  # of everything: of reference - random, of a correlation of 1
POWER = 0.8  # of the smallest difference that could have been shown, before correction


class Pair(NamedTuple):
    """A part in one environment; greater is better, so episodes are negative.

    Where the part is about several environments, all of it is in shares of `everything`.
    """

    variant: np.ndarray  # its metric, [seeds] in the order of seeds
    baseline: np.ndarray  # [seeds]; 0 where there is none
    everything: float  # all that a difference could be
    best: float  # what no run can exceed, or none does
    resolution: float  # of episodes: how many of them the metric looks at, at least


def pairs_of(part: Part, table: pd.DataFrame, settings: MetricsConfig) -> list[Pair]:
    """Both variants of a part in each of its environments.

    table: the frame of metrics.csv with a column for each of `CORRELATIONS` that is asked for.
    Raises `RecordError` for a seed that one of the two variants lacks.
    """
    metric = {metric.name: metric for metric in all_metrics(settings)}.get(part.metric)
    pairs = [_pair(part, table[table["env"] == env], metric, settings) for env in part.environments]
    shares = [Pair._make(value / pair.everything for value in pair) for pair in pairs]
    return shares if len(pairs) > 1 else pairs


def find(part: Part, pairs: Sequence[Pair], margin: float, settings: MetricsConfig) -> Finding:
    """Estimates and tests of one part; `margin` is the smallest difference worth mentioning."""
    unit = metric_units(settings).get(part.metric, "correlation")
    unit = "share of everything" if len(pairs) > 1 else unit
    differences = [pair.variant - pair.baseline for pair in pairs]
    how = CONFIDENCE, settings.bootstrap_repetitions
    seed = settings.bootstrap_seed
    columns = [(pair.variant[:, None], pair.baseline[:, None]) for pair in pairs]
    compared = stratified_comparison(differences, *how, np.random.default_rng(seed))
    difference, low, high, p_value = map(float, compared)
    improved = probability_of_improvement(columns, *how, np.random.default_rng(seed))
    chance, lowest, highest = (bound.item() for bound in improved)
    return Finding(
        *part[:4],
        unit,
        min(map(len, differences)),
        *(difference, low, high, p_value),
        *(chance, lowest, highest),
        _detectable(differences),
        margin,
        -part.in_paper if unit == "episodes" else part.in_paper,
        equivalence(differences, margin, how[1], np.random.default_rng(seed)),
    )


def _pair(part: Part, runs: pd.DataFrame, metric: Metric | None, settings: MetricsConfig) -> Pair:
    """runs: those in one environment. Episodes beyond the shorter budget count as it."""
    environment = str(runs["env"].iloc[0])
    both = {
        name: runs[runs["variant"] == name].set_index("seed")
        for name in (part.variant, part.baseline)
        if name
    }
    values = {name: rows[part.metric] for name, rows in both.items()}
    wide = pd.DataFrame(values).astype(np.float64)  # by seed
    lacking = wide.isna().to_numpy()
    if lacking.any():
        row, column = np.argwhere(lacking)[0]
        run = f"{environment}, {wide.columns[column]}, seed {wide.index[row]}"
        raise RecordError(f"{run}: there is no {part.metric}")
    budget = min(int(rows["episodes"].min()) for rows in both.values())
    if metric and metric.unit == "episodes":
        wide = -wide.clip(upper=budget)
    variant = wide[part.variant].to_numpy()
    baseline = wide[part.baseline].to_numpy() if part.baseline else np.zeros_like(variant)
    if metric and metric.unit == "episodes":
        earliest = metric.earliest(settings.moving_average, budget)
        resolution = (metric.window or settings.moving_average) if earliest > 1 else 1
        return Pair(variant, baseline, float(budget), -earliest, resolution)
    if metric and metric.unit == "return":
        reference = settings.reference_return[environment]
        everything = reference - settings.random_return_in(environment)
        return Pair(variant, baseline, everything, max(reference, runs[part.metric].max()), 0)
    return Pair(variant, baseline, 1.0, 1.0, 0)


def _detectable(differences: Sequence[np.ndarray]) -> float:
    """The smallest mean difference that is significant with a probability of `POWER`."""
    if min(map(len, differences)) == 1:
        return np.nan
    freedom = sum(len(values) - 1 for values in differences)
    variances = [np.var(values, ddof=1) / len(values) for values in differences]
    error = np.sqrt(np.sum(variances)) / len(differences)
    quantiles = scipy.special.stdtrit(freedom, [(1 + CONFIDENCE) / 2, POWER])
    return float(quantiles.sum() * error)
