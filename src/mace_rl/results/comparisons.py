"""Is one variant better than another? Compared by environment and metric (docs/metrics.md)."""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
import pandas as pd

from mace_rl.config.results import MetricsConfig
from mace_rl.results.metrics import Metric, all_metrics
from mace_rl.results.statistics import (
    draws,
    holm,
    logrank,
    paired_comparison,
    percentiles,
    probability_of_improvement,
)

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


class Regret(NamedTuple):
    """A row of regret.csv: what a variant loses against the best constant."""

    env: str
    variant: str
    best_constant: str  # by the mean of `area_under_curve` over all seeds
    best_area: float  # that mean
    variant_area: float
    regret: float  # (best - variant) / (best - random return); NaN if no constant beats random
    low: float  # of its interval; NaN if in a resample no constant beats random
    high: float
    seeds: int


def comparisons(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The data of comparisons.csv from the frame of metrics.csv.

    One `Comparison` per environment, metric and configured pair of variants that are both there;
    then one per metric and pair for all environments together, if there are several.
    """
    variants = set(table["variant"])
    pairs = [pair for pair in settings.comparisons if variants.issuperset(pair)]
    by_environment = {
        str(env): {str(name): own for name, own in runs.sort_values("seed").groupby("variant")}
        for env, runs in table.groupby("env", sort=False)
    }
    groups = [{env: runs} for env, runs in by_environment.items()]
    if len(groups) > 1:
        groups.append(by_environment)
    rows: list[Comparison] = []
    for environments in groups:
        compared = [_compare(environments, pair, settings) for pair in pairs]
        rows.extend(chain.from_iterable(zip(*compared, strict=True)))  # metric by metric
    frame = pd.DataFrame(rows, columns=Comparison._fields)
    tested = frame["p_value"].notna()
    frame.loc[tested, "p_holm"] = holm(frame.loc[tested, "p_value"].to_list())
    return frame


def _compare(
    environments: dict[str, dict[str, pd.DataFrame]],
    pair: list[str],
    settings: MetricsConfig,
) -> list[Comparison]:
    """A row for each metric, but for `p_holm`, from metrics.csv by environment and variant.

    All runs are censored at the same episode E. Restricted to E, the mean ∫₀ᴱ S(t) dt of Kaplan's
    and Meier's estimate S is then the mean of the runs, with E for those that never got there.
    """
    (variant, baseline), metrics = pair, all_metrics(settings)
    how = (settings.confidence, settings.bootstrap_repetitions)
    seed = settings.bootstrap_seed  # of a generator for each: no row depends on another
    signs = [-1 if metric.unit == "episodes" else 1 for metric in metrics]  # greater is better
    reached, restricted = [], []  # of each environment: both variants' [seeds, metrics]
    for runs in environments.values():
        both = runs[variant], runs[baseline]
        budget = min(int(own["episodes"].min()) for own in both)
        x, y = (_reached(own, metrics, budget) for own in both)
        reached.append((x, y))
        restricted.append((np.where(np.isinf(x), budget, x), np.where(np.isinf(y), budget, y)))
    better = probability_of_improvement(
        [(x * signs, y * signs) for x, y in restricted], *how, np.random.default_rng(seed)
    )
    censored = sum(np.isinf(values).sum(axis=0) for both in reached for values in both)
    seeds = min(len(x) for x, _ in reached)
    rows = [
        Comparison(ALL, metric.name, variant, baseline, seeds, int(never), *UNTESTED, np.nan, *one)
        for metric, never, *one in zip(metrics, censored, *better, strict=True)
    ]
    if len(environments) > 1:
        return rows
    [environment], [(x, y)], [events] = environments, restricted, reached
    compared = paired_comparison(x - y, *how, np.random.default_rng(seed))
    for place, (metric, *found) in enumerate(zip(metrics, *compared, strict=True)):
        test = "sign-flip"
        if metric.unit == "episodes":
            mine, theirs = (values[:, place] for values in events)
            test, found[-1] = "log-rank", logrank(mine, theirs, how[1], np.random.default_rng(seed))
        difference, low, high, p_value = found
        rows[place] = rows[place]._replace(
            env=environment, difference=difference, low=low, high=high, test=test, p_value=p_value
        )
    return rows


def _reached(runs: pd.DataFrame, metrics: Sequence[Metric], budget: int) -> np.ndarray:
    """The metrics of one variant, [seeds, metrics]; episodes beyond the budget are np.inf."""
    values = runs[[metric.name for metric in metrics]].to_numpy(np.float64)
    for place, metric in enumerate(metrics):
        if metric.unit == "episodes":
            never = (values[:, place] > budget) | (runs[metric.flag] == 1)
            values[never, place] = np.inf
    return values


def regret(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The data of regret.csv from the frame of metrics.csv, as `metrics.regret` configures it.

    One `Regret` per environment and, of several, their mean. The interval is the bootstrap over
    seeds, of all variants together, in which the best constant is chosen anew each time. The best
    of several noisy means is on average better than the best of the true ones: the regret errs
    upward, against the variant, and its interval with it.
    """
    assert settings.regret is not None  # or nobody asks
    variant, constants = settings.regret.variant, settings.regret.constants
    areas, randoms, rows = [], [], []
    for environment, runs in table.groupby("env", sort=False):
        wide = runs.pivot(index="seed", columns="variant", values="area_under_curve")
        areas.append(wide[[variant, *constants]].to_numpy())  # [seeds, 1 + constants]
        randoms.append(settings.random_return_in(str(environment)))
        own, *others = areas[-1].mean(axis=0)
        best = constants[int(np.argmax(others))], max(others), own
        losses = _regret(areas[-1:], randoms[-1:], settings)
        rows.append(Regret(*(str(environment), variant, *best, *losses)))
    if len(rows) > 1:
        nothing = "", np.nan, np.nan
        rows.append(Regret(*(ALL, variant, *nothing, *_regret(areas, randoms, settings))))
    return pd.DataFrame(rows)


def _regret(
    areas: list[np.ndarray], randoms: list[float], settings: MetricsConfig
) -> tuple[float, float, float, int]:
    """Mean regret, its interval and the seeds, from [seeds, 1 + constants] of each environment.

    The seeds are those of the environment that has fewest.
    """
    generator = np.random.default_rng(settings.bootstrap_seed)
    fewest = min(len(area) for area in areas)
    regrets = []  # of each environment: [repetitions + 1], the seeds as they are first
    for area, random in zip(areas, randoms, strict=True):
        seeds = len(area)
        drawn = draws(seeds, settings.bootstrap_repetitions, generator)
        means = np.vstack([np.ones(seeds), drawn]) @ area / seeds
        best = means[:, 1:].max(axis=1)
        regrets.append((best - means[:, 0]) / np.where(best > random, best - random, np.nan))
    mean, *resampled = np.mean(regrets, axis=0)
    if fewest == 1:
        return mean, np.nan, np.nan, fewest
    return mean, *percentiles(np.array(resampled), settings.confidence, fewest), fewest
