"""betas.csv: where β ends, its range, and whether it is larger where learning stagnates."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import pandas as pd
import scipy  # loads what is used of it when it is

from mace_rl.training.records import RunKey
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import (
    AFTER,
    BEFORE,
    CORRELATION,
    OF_BETAS,
    LearningCurve,
    final_return,
    learning_curve,
    sample_efficiency_common,
)

LABELS = {  # of columns, in tables
    "beta_end": "β at the end",
    "beta_lowest": "lowest β",
    CORRELATION: "with stagnation",
    BEFORE: "before the common bar",
    AFTER: "after it",
}


def betas_columns(settings: MetricsConfig) -> dict[str, type]:
    """The columns of betas.csv; without a common bar nothing is before or after it."""
    columns = OF_BETAS if settings.reference_return else OF_BETAS[:-2]
    return {"env": str, "variant": str, "seed": int} | dict.fromkeys(columns, float)


def betas_table(
    runs: Mapping[RunKey, pd.DataFrame],
    settings: MetricsConfig,
    columns: Iterable[str] | None = None,
) -> pd.DataFrame:
    """The data of betas.csv: a row for each run, with all of its `columns` or these of `OF_BETAS`.

    runs: the records of each.
    """
    all_columns = list(betas_columns(settings))
    key, wanted = all_columns[:3], all_columns[3:] if columns is None else list(columns)
    rows = []
    for run, frame in runs.items():
        curve = learning_curve(frame["extrinsic_return"].to_numpy(), run[0], settings)
        betas = frame["beta"].to_numpy()
        rows.append([*run, *(MEASURES[name](curve, betas) for name in wanted)])
    return pd.DataFrame(rows, columns=[*key, *wanted])


def in_all(curve: LearningCurve, betas: np.ndarray) -> float:
    """Spearman's correlation of stagnation with the β of the next episode; 0 if either is constant.

    betas: [E]. Stagnation is minus the `slopes`.
    """
    return 0.0 if np.ptp(betas) == 0 else _correlation(-curve.slopes, betas)


def before(curve: LearningCurve, betas: np.ndarray) -> float:
    """The same, by the `growing_slopes`, before `sample_efficiency_common`.

    betas: [E]. An episode's stagnation and the next one's β are before that episode if both are.
    0, too, for a time of which there are fewer than two.
    """
    if np.ptp(betas) == 0:
        return 0.0
    reached = sample_efficiency_common(curve).number
    return _correlation(-curve.growing_slopes[: _place(curve, reached)], betas[:reached])


def after(curve: LearningCurve, betas: np.ndarray) -> float:
    """The same after `sample_efficiency_common`; 0 if it is never reached."""
    reached = sample_efficiency_common(curve)
    if np.ptp(betas) == 0 or reached.censored:
        return 0.0
    return _correlation(-curve.growing_slopes[max(0, _place(curve, reached.number) - 1) :], betas)


MEASURES: Mapping[str, Callable[[LearningCurve, np.ndarray], float]] = {  # by `OF_BETAS`
    "beta_end": lambda curve, betas: final_return(betas, curve.settings.final_fraction),
    "beta_lowest": lambda _, betas: betas.min(),
    "beta_highest": lambda _, betas: betas.max(),
    CORRELATION: in_all,
    BEFORE: before,
    AFTER: after,
}


def _place(curve: LearningCurve, episode: int) -> int:
    """How many of the `growing_slopes` come before the one of this episode."""
    return max(0, episode - len(curve.returns) + len(curve.growing_slopes))


def _correlation(stagnation: np.ndarray, betas: np.ndarray) -> float:
    """Of each entry but the last with the β after it; both end with the same episode."""
    following = betas[len(betas) - len(stagnation) + 1 :]
    if len(following) < 2 or np.ptp(stagnation[:-1]) == 0 or np.ptp(following) == 0:
        return 0.0
    return float(scipy.stats.spearmanr(stagnation[:-1], following).statistic)
