"""All environments together: scores between random and the best run (Agarwal et al. 2021).

The score of a run is (A - r₀) / (A* - r₀), where A is its final return or its mean return over all
of training, r₀ the random policy's and A* the best run's of the study in that environment.
"""

from typing import Any

import numpy as np
import pandas as pd
import scipy

from mace_study.compare.statistics import percentiles
from mace_study.config.metrics import MetricsConfig

SCORED = ("final_return", "area_under_curve")


def scores(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """Long frame env, variant, seed, metric, score of `SCORED`, from the frame of metrics.csv."""
    long = table.melt(["env", "variant", "seed"], list(SCORED), "metric", "score")
    random = long["env"].map(settings.random_return_in)
    best = long.groupby(["env", "metric"])["score"].transform("max")
    # Where no run beats random actions there is nothing to be shared out.
    return long.assign(score=((long["score"] - random) / (best - random)).where(best > random, 0.0))


def interquartile_mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Mean of the middle half."""
    return scipy.stats.trim_mean(values, 0.25, axis=axis)


def aggregate(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The data of aggregate.csv: of each metric and variant the mean and interquartile mean score.

    Columns: metric, variant, runs, then for mean and iqm the estimate and its interval, NaN if an
    environment has fewer than 10 seeds. Every environment weighs as much as it has runs. Variants
    that do not have runs in all environments are left out.
    """
    rows: list[dict[str, Any]] = []
    repetitions = settings.bootstrap_repetitions
    everywhere = table.groupby("variant")["env"].nunique() == table["env"].nunique()
    scored = scores(table, settings)
    scored = scored[scored["variant"].map(everywhere)]
    for (metric, variant), runs in scored.groupby(["metric", "variant"], sort=False):
        strata = [group["score"].to_numpy() for _, group in runs.groupby("env", sort=False)]
        smallest = min(len(values) for values in strata)
        generator = np.random.default_rng(settings.bootstrap_seed)
        places = (generator.integers(len(own), size=(repetitions, len(own))) for own in strata)
        # The seeds of each environment resampled, [repetitions, runs].
        drawn = np.hstack([own[place] for own, place in zip(strata, places, strict=True)])
        row = {"metric": metric, "variant": variant, "runs": len(runs)}
        for name, estimate in (("mean", np.mean), ("iqm", interquartile_mean)):
            resampled = estimate(drawn, axis=-1)
            low, high = percentiles(resampled, settings.confidence, smallest)
            value = float(estimate(np.concatenate(strata), axis=-1))
            row |= {name: value, f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    ends = [f"{name}{end}" for name in ("mean", "iqm") for end in ("", "_low", "_high")]
    return pd.DataFrame(rows, columns=["metric", "variant", "runs", *ends])
