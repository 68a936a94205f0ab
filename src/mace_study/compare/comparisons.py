"""Is one variant better than another? Compared by environment and metric (docs/metrics.md)."""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
import pandas as pd

from mace_study.compare import statistics
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import Metric, all_metrics

ALL = "all"  # in the place of an environment: the mean over all of them
UNTESTED = (np.nan, np.nan, np.nan, "", np.nan)  # difference to p_value of that


class Comparison(NamedTuple):
    """A row of comparisons.csv: `variant` against `baseline`, over the seeds that both have."""

    env: str
    metric: str
    variant: str
    baseline: str
    seeds: int  # of all environments, in that which has fewest
    censored: int  # runs of both that never got there
    difference: float  # mean of variant - baseline; of episodes, of restricted means
    low: float  # of its interval, of differences paired by seed
    high: float
    test: str  # "log-rank" of episodes, else "sign-flip"; none of the mean over environments
    p_value: float  # two-sided; of the sign-flip test with n seeds never below 2 / 2ⁿ
    p_holm: float  # adjusted for all rows of the table, the more the stricter
    probability: float  # that a run of the variant is better than one of the baseline
    probability_low: float  # of its interval
    probability_high: float


def comparisons(
    table: pd.DataFrame, settings: MetricsConfig, together: bool = True
) -> pd.DataFrame:
    """The data of comparisons.csv from the frame of metrics.csv.

    One `Comparison` per environment, metric that is compared and configured pair of variants that
    are both there; then, with `together`, one per metric and pair for all environments, if there
    are several and all have both.
    """
    by_environment = {
        str(env): {str(name): own for name, own in runs.sort_values("seed").groupby("variant")}
        for env, runs in table.groupby("env", sort=False)
    }
    groups = [{env: runs} for env, runs in by_environment.items()]
    if together and len(groups) > 1:
        groups.append(by_environment)
    rows: list[Comparison] = []
    for environments in groups:
        compared = [
            _compare(environments, pair, settings)
            for pair in settings.comparisons
            if all(runs.keys() >= {*pair} for runs in environments.values())
        ]
        rows.extend(chain.from_iterable(zip(*compared, strict=True)))  # metric by metric
    frame = pd.DataFrame(rows, columns=Comparison._fields)
    tested = frame["p_value"].notna()
    frame.loc[tested, "p_holm"] = statistics.holm(frame.loc[tested, "p_value"].to_list())
    return frame


def _compare(
    environments: dict[str, dict[str, pd.DataFrame]], pair: list[str], settings: MetricsConfig
) -> list[Comparison]:
    """A row for each metric, but for `p_holm`, from metrics.csv by environment and variant.

    All runs are censored at the same episode E. Restricted to E, the mean ∫₀ᴱ S(t) dt of Kaplan's
    and Meier's estimate S is then the mean of the runs, with E for those that never got there.
    """
    variant, baseline = pair
    metrics = [metric for metric in all_metrics(settings) if metric.compared]
    how = (settings.confidence, settings.bootstrap_repetitions)
    seed = settings.bootstrap_seed  # of a generator for each: no row depends on another
    signs = [-1 if metric.unit == "episodes" else 1 for metric in metrics]  # greater is better
    reached, restricted = [], []  # of each environment: both variants' [seeds, metrics]
    for runs in environments.values():
        both = runs[variant], runs[baseline]
        budget = min(int(own["episodes"].min()) for own in both)
        x, y = (reached_within(own, metrics, budget) for own in both)
        reached.append((x, y))
        restricted.append((np.where(np.isinf(x), budget, x), np.where(np.isinf(y), budget, y)))
    signed = [(x * signs, y * signs) for x, y in restricted]
    better = statistics.probability_of_improvement(signed, *how, np.random.default_rng(seed))
    censored = sum(np.isinf(values).sum(axis=0) for both in reached for values in both)
    seeds = min(len(x) for x, _ in reached)
    rows = [
        Comparison(ALL, metric.name, variant, baseline, seeds, int(n), *UNTESTED, np.nan, *chances)
        for metric, n, *chances in zip(metrics, censored, *better, strict=True)
    ]
    if len(environments) > 1:
        return rows
    [environment], [(x, y)], [events] = environments, restricted, reached
    tested = [metric.unit != "episodes" for metric in metrics]
    compared = statistics.paired_comparison(x - y, *how, np.random.default_rng(seed), tested)
    for place, (metric, *found) in enumerate(zip(metrics, *compared, strict=True)):
        test = "sign-flip"
        if metric.unit == "episodes":
            mine, theirs = (values[:, place] for values in events)
            test, seeded = "log-rank", np.random.default_rng(seed)
            found[-1] = statistics.logrank(mine, theirs, how[1], seeded)
        difference, low, high, p_value = found
        rows[place] = rows[place]._replace(
            env=environment, difference=difference, low=low, high=high, test=test, p_value=p_value
        )
    return rows


def reached_within(runs: pd.DataFrame, metrics: Sequence[Metric], budget: int) -> np.ndarray:
    """The metrics of one variant, [seeds, metrics]; episodes beyond the budget are np.inf."""
    values = runs[[metric.name for metric in metrics]].to_numpy(np.float64, copy=True)
    for place, metric in enumerate(metrics):
        if metric.unit == "episodes":
            never = (values[:, place] > budget) | (runs[metric.flag] == 1)
            values[never, place] = np.inf
    return values
