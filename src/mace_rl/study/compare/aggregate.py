"""All environments together: scores between random and the best run (Agarwal et al. 2021).

The score of a run is (A - r₀) / (A* - r₀), where A is its final return or its mean return over all
of training, r₀ the random policy's and A* the best run's of the study in that environment.
"""

import numpy as np
import pandas as pd
import scipy

from mace_rl.study.compare.statistics import percentiles
from mace_rl.study.metrics_config import MetricsConfig

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


def interquartile_mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Mean of the middle half."""
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def aggregate(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The data of aggregate.csv: of each metric and variant the mean and interquartile mean score.

    Columns: metric, variant, runs, then for mean and iqm the estimate and its interval, NaN if an
    environment has one seed. Every environment weighs as much as it has runs.
    """
    rows, repetitions = [], settings.bootstrap_repetitions
    for (metric, variant), runs in scores(table, settings).groupby(
        ["metric", "variant"], sort=False
    ):
        strata = [group["score"].to_numpy() for _, group in runs.groupby("env", sort=False)]
        smallest = min(len(values) for values in strata)
        generator = np.random.default_rng(settings.bootstrap_seed)
        drawn = np.concatenate(  # the seeds of each environment resampled, [repetitions, runs]
            [
                values[generator.integers(len(values), size=(repetitions, len(values)))]
                for values in strata
            ],
            axis=1,
        )
        row = {"metric": metric, "variant": variant, "runs": len(runs)}
        for name, estimate in (("mean", np.mean), ("iqm", interquartile_mean)):
            resampled = estimate(drawn, axis=-1)
            low, high = percentiles(resampled, settings.confidence, smallest)
            value = float(estimate(np.concatenate(strata), axis=-1))
            row |= {name: value, f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    return pd.DataFrame(rows)
