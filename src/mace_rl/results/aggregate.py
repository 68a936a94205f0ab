"""All environments together: scores between random and the best run (Agarwal et al. 2021).

The score of a run is (A - r₀) / (A* - r₀), where A is its final return or its mean return over all
of training, r₀ the random policy's and A* the best run's of the study in that environment.
"""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
import scipy

from mace_rl.config.results import MetricsConfig
from mace_rl.results.statistics import percentiles

SCORED = ("final_return", "area_under_curve")


def scores(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """Long frame env, variant, seed, metric, score of `SCORED`, from the frame of metrics.csv."""
    parts = []
    for environment, runs in table.groupby("env", sort=False):
        random = settings.random_return_in(str(environment))
        for metric in SCORED:
            part = runs[["env", "variant", "seed"]].assign(metric=metric)
            best = runs[metric].max()
            # Where no run beats random actions there is nothing to be shared out.
            part["score"] = (runs[metric] - random) / (best - random) if best > random else 0.0
            parts.append(part)
    return pd.concat(parts, ignore_index=True)


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half of the last axis; [..., n] → [...]."""
    return scipy.stats.trim_mean(values, 0.25, axis=-1)


def score_interval(
    strata: Sequence[np.ndarray],
    estimate: Callable[[np.ndarray], np.ndarray],
    confidence: float,
    repetitions: int,
    generator: np.random.Generator,
) -> tuple[float, float]:
    """Interval of an `estimate` over all runs, whose seeds are resampled within strata [seeds].

    NaN if a stratum has one seed only.
    """
    drawn = [
        values[generator.integers(len(values), size=(repetitions, len(values)))]
        for values in strata
    ]
    smallest = min(len(values) for values in strata)
    low, high = percentiles(estimate(np.concatenate(drawn, axis=1)), confidence, smallest)
    return float(low), float(high)


def aggregate(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The data of aggregate.csv: of each metric and variant the mean and interquartile mean score.

    Columns: metric, variant, runs, then for mean and iqm the estimate and its interval. Every
    environment weighs as much as it has runs.
    """
    rows = []
    for (metric, variant), runs in scores(table, settings).groupby(
        ["metric", "variant"], sort=False
    ):
        strata = [group["score"].to_numpy() for _, group in runs.groupby("env", sort=False)]
        row = {"metric": metric, "variant": variant, "runs": len(runs)}
        for name, estimate in (("mean", _mean), ("iqm", interquartile_mean)):
            low, high = score_interval(
                strata,
                estimate,
                settings.confidence,
                settings.bootstrap_repetitions,
                np.random.default_rng(settings.bootstrap_seed),
            )
            value = float(estimate(np.concatenate(strata)))
            row |= {name: value, f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    return pd.DataFrame(rows)


def _mean(values: np.ndarray) -> np.ndarray:
    return np.mean(values, axis=-1)
