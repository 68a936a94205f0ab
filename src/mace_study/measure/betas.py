"""betas.csv: where β ends, its range, and whether it is larger where learning stagnates."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import scipy  # loads what is used of it when it is

from mace_rl.training.records import RunKey
from mace_study.config.metrics import MetricsConfig
from mace_study.measure import metrics

if TYPE_CHECKING:  # planning the workflow imports this module
    import pandas as pd

# Columns beside β's own: in all of training, before and after the common bar.
CORRELATIONS = CORRELATION, BEFORE, AFTER = metrics.CORRELATIONS
LABELS = {  # of columns, in tables
    "beta_end": "β at the end",
    "beta_lowest": "lowest β",
    CORRELATION: "with stagnation",
    BEFORE: "before the common bar",
    AFTER: "after it",
}


def correlation_columns(settings: MetricsConfig) -> tuple[str, ...]:
    """Those of `CORRELATIONS` that there are; without a common bar nothing is before or after."""
    return CORRELATIONS if settings.reference_return else (CORRELATION,)


def betas_columns(settings: MetricsConfig) -> dict[str, type]:
    """The columns of betas.csv."""
    values = dict.fromkeys([*metrics.OF_BETAS[:3], *correlation_columns(settings)], float)
    return {"env": str, "variant": str, "seed": int} | values


def betas_table(runs: Mapping[RunKey, "pd.DataFrame"], settings: MetricsConfig) -> "pd.DataFrame":
    """The data of betas.csv: of each run β at its end, its range, its stagnation correlations."""
    import pandas as pd

    rows = []
    for run, frame in runs.items():
        beta, returns = frame["beta"].to_numpy(), frame["extrinsic_return"].to_numpy()
        end = metrics.final_return(beta, settings.final_fraction)
        found = correlations(returns, beta, run[0], settings)
        rows.append([*run, end, beta.min(), beta.max(), *found])
    return pd.DataFrame(rows, columns=list(betas_columns(settings)))


def correlations(
    returns: np.ndarray, betas: np.ndarray, environment: str, settings: MetricsConfig
) -> list[float]:
    """The stagnation correlations of a run, as betas.csv has them; returns, betas: [E]."""
    if np.ptp(betas) == 0:
        return [0.0] * len(correlation_columns(settings))
    curve = metrics.learning_curve(returns, environment, settings)
    found = [stagnation_correlation(returns, betas, settings.moving_average)]
    return [*found, *(stagnation_correlations(curve, betas) if settings.reference_return else ())]


def stagnation_correlation(returns: np.ndarray, betas: np.ndarray, window: int) -> float:
    """Spearman's correlation of stagnation with the β of the next episode; 0 if either is constant.

    returns, betas: [E]. Stagnation is minus the `slope`.
    """
    return _correlation(-metrics.slope(returns, window), betas)


def stagnation_correlations(curve: metrics.LearningCurve, betas: np.ndarray) -> tuple[float, float]:
    """The same, by the `growing_slope`, before and after `sample_efficiency_common`.

    betas: [E]. An episode's stagnation and the next one's β are before that episode if both are.
    0, too, for a time of which there are fewer than two.
    """
    reached = metrics.sample_efficiency_common(curve)
    stagnation = -growing_slope(curve.returns, curve.settings.moving_average)
    until = max(0, reached.number - len(betas) + len(stagnation))  # in place of episodes
    before = _correlation(stagnation[:until], betas[: reached.number])
    after = _correlation(stagnation[max(0, until - 1) :], betas)
    return before, 0.0 if reached.censored else after


def growing_slope(returns: np.ndarray, window: int) -> np.ndarray:
    """`slope` from episode 2 · ceil(window / 10) on: single episodes side by side are noise.

    While there are no 2 windows, the halves of the episodes so far are compared.
    """
    first = 2 * math.ceil(window / 10)
    ends = range(first, min(2 * window, len(returns) + 1))
    halves = ((returns[t % 2 : t - t // 2], returns[t - t // 2 : t]) for t in ends)
    growing = [(later.sum() - earlier.sum()) / len(later) ** 2 for earlier, later in halves]
    return np.concatenate([growing, metrics.slope(returns, window)])


def _correlation(stagnation: np.ndarray, betas: np.ndarray) -> float:
    """Of each entry but the last with the β after it; both end with the same episode."""
    following = betas[len(betas) - len(stagnation) + 1 :]
    if len(following) < 2 or np.ptp(stagnation[:-1]) == 0 or np.ptp(following) == 0:
        return 0.0
    return float(scipy.stats.spearmanr(stagnation[:-1], following).statistic)
