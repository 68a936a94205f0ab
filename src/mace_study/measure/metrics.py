"""What is measured on one run: how well it ends, and how soon (docs/metrics.md).

A metric is a pure function of a `LearningCurve`. A run that never attains a metric in episodes
counts with E, its number of episodes, and is flagged as censored: E is then a lower bound.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from mace_rl.config.plugins import load
from mace_rl.config.section import ConfigError
from mace_study.config.metrics import GOALS, MetricsConfig

PUBLIC_CODE_WINDOW = 50  # [R] episodes of the moving average, and over which it is to be flat
PUBLIC_CODE_FLOOR = 0.3  # [R] of training is skipped
PUBLIC_CODE_SLOPE = 0.05  # [R] return per episode
PUBLIC_CODE_LAST = 10  # [R] episodes whose mean sets the bar of sample efficiency

# Of betas.csv, which claims are judged by beside metrics.csv: in all of training, before and after
# the common bar.
CORRELATION = "stagnation_correlation"
BEFORE, AFTER = f"{CORRELATION}_before", f"{CORRELATION}_after"
CORRELATIONS = (CORRELATION, BEFORE, AFTER)
OF_BETAS = ("beta_end", "beta_lowest", "beta_highest", *CORRELATIONS)
COLUMN_TYPES = {"episodes": int, "return": float, "share": float}  # of metrics.csv, by unit


class Attained(NamedTuple):
    """The episode (from 1) at which something is attained; E and censored if it never is."""

    number: int
    censored: bool


@dataclass(frozen=True)
class LearningCurve:
    """What a metric sees of one run."""

    returns: np.ndarray  # float64 [E], the extrinsic return of each training episode
    final: float  # `final_return` of these
    random_mean: float  # mean return of uniformly random actions in this environment
    settings: MetricsConfig
    reference: float = math.nan  # `reference_return` and `solved_return` in this environment,
    solved: float = math.nan  # where the study has them

    @cached_property
    def learned(self) -> bool:
        """Whether the run ends better than random actions, by more than two standard errors.

        If not, a bar that depends on how it ends says nothing: 75 % of 0 is reached in episode 1.
        """
        last = last_part(self.returns, self.settings.final_fraction)
        return bool(self.final - 2 * last.std() / math.sqrt(len(last)) > self.random_mean)

    @cached_property
    def total(self) -> np.ndarray:
        """The sum of each `window` consecutive returns, [E - window + 1]."""
        return _moving_sum(self.returns, self.settings.moving_average)

    @property
    def average(self) -> np.ndarray:
        """The `moving_average`, [E - window + 1]."""
        return self.total / self.settings.moving_average

    @property
    def slopes(self) -> np.ndarray:
        """Its `slope`, [E - 2 · window + 1]."""
        return _slope(self.total, self.settings.moving_average)

    @cached_property
    def growing_slopes(self) -> np.ndarray:
        """`slopes` from episode 2 · ceil(window / 10) on: single episodes side by side are noise.

        While there are no 2 windows, the halves of the episodes so far are compared.
        """
        returns, window = self.returns, self.settings.moving_average
        first = 2 * math.ceil(window / 10)
        ends = range(first, min(2 * window, len(returns) + 1))
        halves = ((returns[t % 2 : t - t // 2], returns[t - t // 2 : t]) for t in ends)
        growing = [(later.sum() - earlier.sum()) / len(later) ** 2 for earlier, later in halves]
        return np.concatenate([growing, self.slopes])

    def bar(self, goal: float) -> float:
        """The return `threshold` of the way from random actions to `goal`."""
        return self.random_mean + self.settings.threshold * (goal - self.random_mean)

    def first(self, reached: np.ndarray, episode: int = 1) -> Attained:
        """The first true entry of `reached` [n], whose entry 0 belongs to episode `episode`."""
        if not reached.any():
            return Attained(len(self.returns), True)
        return Attained(episode + int(np.argmax(reached)), False)


@dataclass(frozen=True)
class Metric:
    """One thing measured on each run."""

    name: str  # of its column in metrics.csv
    label: str  # in tables
    unit: Literal["episodes", "return", "share"]  # of episodes fewer are better, else more is
    function: Callable[[LearningCurve], Attained | float]  # an Attained if the unit is episodes
    needs: str | None = None  # one of `GOALS`: a study that has none is without this metric
    # In comparisons.csv, where each metric makes the correction stricter.
    compared: bool = field(default=True, kw_only=True)
    # Of the moving average's window and E, the first episode that it can be; above E if none.
    earliest: Callable[[int, int], int] = field(default=lambda window, _: 1, kw_only=True)
    window: int | None = field(default=None, kw_only=True)  # its own; None: the study's

    @property
    def flag(self) -> str:
        """The column that tells which episodes are censored."""
        return f"{self.name}_censored"


def last_part(returns: np.ndarray, fraction: float) -> np.ndarray:
    """The last `fraction` of the episodes, rounded up (paper: the last 10 %)."""
    last = math.ceil(Fraction(repr(fraction)) * len(returns))  # 0.07 of 100 is 7, not 7.000…001
    return returns[-last:]


def final_return(returns: np.ndarray, fraction: float) -> float:
    """Mean return of `last_part`."""
    return float(np.mean(last_part(returns, fraction)))


def moving_average(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of each `window` consecutive values, [E - window + 1]; empty if E < window."""
    return _moving_sum(values, window) / window


def slope(returns: np.ndarray, window: int) -> np.ndarray:
    """Slope of the moving average in return per episode, [E - 2 · window + 1] or empty.

    Entry i belongs to episode 2 · `window` + i and compares the last `window` episodes with the
    `window` before them. (From one episode to the next the average's change is noise.)
    """
    return _slope(_moving_sum(returns, window), window)


def sample_efficiency(curve: LearningCurve) -> Attained:
    """The first episode with a return ≥ threshold · final (paper), of a run that has `learned`.

    Negative returns: the bar is above the final return. Censored: never reached, or not learned.
    """
    reached = curve.returns >= curve.settings.threshold * curve.final
    return curve.first(reached & curve.learned)


def convergence_steps(curve: LearningCurve) -> Attained:
    """The point where the slope of the moving average becomes minimal (paper).

    Our reading: the first episode, once the average has come threshold of the way from random to
    final, at which its slope is down to `convergence_slope` of the steepest so far. Censored:
    never, or not `learned`.
    """
    settings, window = curve.settings, curve.settings.moving_average
    high = curve.average >= curve.bar(curve.final)
    learned = np.logical_or.accumulate(high)[window:]  # [E - 2 · window + 1], as the slopes
    steepest = np.maximum.accumulate(curve.slopes)
    minimal = curve.slopes <= settings.convergence_slope * steepest
    return curve.first(learned & minimal & curve.learned, 2 * window)


def convergence_steps_public_code(curve: LearningCurve) -> Attained:
    """The rule of the authors' public code, whatever the window configured here.

    The first episode of the first 50-episode window past 30 % of training after which the moving
    average changes by less than 0.05 per episode over 50 episodes: never less than 586 of 2000.
    """
    first = _public_code_first(PUBLIC_CODE_WINDOW, len(curve.returns))
    flat = np.abs(slope(curve.returns, PUBLIC_CODE_WINDOW)[first - 1 :]) < PUBLIC_CODE_SLOPE
    return curve.first(flat, first)


def sample_efficiency_public_code(curve: LearningCurve) -> Attained:
    """The rule of the authors' public code: the paper's, whose bar is of the last 10 episodes.

    It asks no more of a run: one that has learned nothing may reach its bar in episode 1.
    """
    bar = curve.settings.threshold * np.mean(curve.returns[-PUBLIC_CODE_LAST:])
    return curve.first(curve.returns >= bar)


def sample_efficiency_common(curve: LearningCurve) -> Attained:
    """The first episode whose moving average has come threshold of the way to the reference.

    The bar is the same for every variant: ending worse does not lower it. Censored: never reached.
    """
    reached = curve.average >= curve.bar(curve.reference)
    return curve.first(reached, curve.settings.moving_average)


def sample_efficiency_range(curve: LearningCurve) -> Attained:
    """The first episode whose moving average has come threshold of the way from random to final.

    Censored: not `learned`.
    """
    reached = curve.average >= curve.bar(curve.final)
    return curve.first(reached & curve.learned, curve.settings.moving_average)


def early_return(curve: LearningCurve) -> float:
    """Mean return of the first episodes, as many as `last_part` has: how steep the curve begins."""
    count = len(last_part(curve.returns, curve.settings.final_fraction))
    return float(np.mean(curve.returns[:count]))


def solved(curve: LearningCurve) -> float:
    """The share of the last episodes (`last_part`) whose return is at least `solved_return`."""
    return float(np.mean(last_part(curve.returns, curve.settings.final_fraction) >= curve.solved))


def _public_code_first(window: int, episodes: int) -> int:
    first = max(1, int(PUBLIC_CODE_FLOOR * (episodes - PUBLIC_CODE_WINDOW + 1)) + 1)
    slopes = episodes - 2 * PUBLIC_CODE_WINDOW + 1
    return first if first <= slopes else episodes + 1


def _episodes(
    function: Callable[[LearningCurve], Attained], label: str, windows: int, *needs: str
) -> Metric:
    name, earliest = function.__name__, lambda window, _: max(1, windows * window)
    return Metric(name, label, "episodes", function, *needs, earliest=earliest)


METRICS = (  # the area is under the learning curve, per episode
    Metric("final_return", "Final return", "return", lambda curve: curve.final),
    _episodes(sample_efficiency, "Sample efficiency", 0),
    _episodes(convergence_steps, "Convergence", 2),
    Metric("area_under_curve", "Mean return of training", "return", lambda c: c.returns.mean()),
    Metric("early_return", "Mean return of the beginning", "return", early_return),
    Metric("solved", "Solved at the end", "share", solved, "solved_return"),
    _episodes(sample_efficiency_common, "Sample efficiency (common bar)", 1, "reference_return"),
    _episodes(sample_efficiency_range, "Sample efficiency (range)", 1),
    replace(
        _episodes(convergence_steps_public_code, "Convergence (public code)", 0),
        earliest=_public_code_first,
        window=PUBLIC_CODE_WINDOW,
    ),
    replace(
        _episodes(sample_efficiency_public_code, "Sample efficiency (public code)", 0),
        compared=False,
    ),
)


def all_metrics(settings: MetricsConfig) -> tuple[Metric, ...]:
    """Those of `METRICS` whose settings are there and, after them, those of `metrics.custom`.

    Raises `ConfigError` for what is no metric.
    """
    metrics = [
        metric for metric in METRICS if metric.needs is None or getattr(settings, metric.needs)
    ]
    for reference in settings.custom:
        metric, columns = load(reference, "metrics.custom"), metrics_columns([*METRICS, *metrics])
        if not isinstance(metric, Metric):
            problem = f"is no {__name__}.Metric but of type {type(metric).__name__}"
        elif not metric.name.isidentifier():
            problem = f"has the name {metric.name!r}, but a column's name should be a word"
        elif {metric.name, metric.flag} & {*columns, *OF_BETAS}:
            place = "betas.csv" if metric.name in OF_BETAS else "metrics.csv"
            problem = f"has the name {metric.name!r}, but {place} has a column of that name"
        elif metric.unit not in COLUMN_TYPES:
            units = ", ".join(COLUMN_TYPES)
            problem = f"has the unit {metric.unit!r}, but should have one of {units}"
        elif metric.needs not in (None, *GOALS):
            goals = " or ".join(GOALS)
            problem = f"needs {metric.needs!r}, but should need {goals} or None"
        else:
            metrics += [metric] if metric.needs is None or getattr(settings, metric.needs) else []
            continue
        raise ConfigError(f"metrics.custom has {reference!r}, which {problem}")
    return tuple(metrics)


def out_of_reach(settings: MetricsConfig, episodes: int) -> list[str]:
    """The metrics that no training of so many episodes attains, for it has too few to average."""
    counted = (metric for metric in all_metrics(settings) if metric.unit == "episodes")
    window = settings.moving_average
    return [metric.name for metric in counted if metric.earliest(window, episodes) > episodes]


def metric_units(settings: MetricsConfig) -> dict[str, str]:
    """Of each metric, by its name."""
    return {metric.name: metric.unit for metric in all_metrics(settings)}


def metric_labels(settings: MetricsConfig) -> dict[str, str]:
    """Of each metric, by its name."""
    return {metric.name: metric.label for metric in all_metrics(settings)}


def metrics_columns(metrics: Sequence[Metric]) -> dict[str, type]:
    """The columns of metrics.csv, one row per run, with these metrics."""
    run = {"env": str, "variant": str, "seed": int, "episodes": int, "env_steps": int}
    values = {metric.name: COLUMN_TYPES[metric.unit] for metric in metrics}
    return run | values | {metric.flag: int for metric in metrics if metric.unit == "episodes"}


def learning_curve(returns: np.ndarray, environment: str, settings: MetricsConfig) -> LearningCurve:
    """What the metrics see of a run with these extrinsic returns, float64 [E]."""
    final = final_return(returns, settings.final_fraction)
    random = settings.random_return_in(environment)
    goals = [goal[environment] if goal else math.nan for goal in settings.goals]
    return LearningCurve(returns, final, random, settings, *goals)


def _moving_sum(values: np.ndarray, window: int) -> np.ndarray:
    """Sum of each `window` consecutive values: exact for whole numbers, so that ties are ties."""
    if len(values) < window:
        return np.empty(0)
    return np.lib.stride_tricks.sliding_window_view(values, window).sum(axis=-1)


def _slope(total: np.ndarray, window: int) -> np.ndarray:
    return (total[window:] - total[:-window]) / window**2
