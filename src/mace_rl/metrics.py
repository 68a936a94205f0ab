"""What is measured on one run: how well it ends, and how soon it gets there.

Every metric is a pure function of `returns`, float64 [E]: the extrinsic return of each of the E
training episodes. Episodes are numbered from 1. An `Episode` metric that a run never attains is
reported as E and flagged as censored, never dropped; E is then a lower bound.

The paper's definitions ("Detail of Evaluation Metrics") are `final_return`, `sample_efficiency`
and `convergence_steps`; Table 1 uses these. The others show what another reading changes.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt

from mace_rl.hyperparameters import ConfigError, Section
from mace_rl.records import RecordError, Run, read_rows

if TYPE_CHECKING:  # pandas is imported where a frame is built: every job imports MetricsConfig
    import pandas as pd

PUBLIC_CODE_WINDOW = 50  # [R] episodes of the moving average, and over which it is to be flat
PUBLIC_CODE_FLOOR = 0.3  # [R] of training is skipped
PUBLIC_CODE_SLOPE = 0.05  # [R] return per episode

METRICS_COLUMNS: Mapping[str, type] = {  # of metrics.csv, one row per run
    "env": str,
    "variant": str,
    "seed": int,
    "episodes": int,
    "env_steps": int,
    "final_return": float,
    "sample_efficiency": int,
    "convergence_steps": int,
    "area_under_curve": float,
    "sample_efficiency_range": int,
    "convergence_steps_range": int,
    "convergence_steps_flattest": int,
    "convergence_steps_public_code": int,
    "sample_efficiency_censored": int,
    "convergence_steps_censored": int,
    "sample_efficiency_range_censored": int,
    "convergence_steps_range_censored": int,
    "convergence_steps_flattest_censored": int,
    "convergence_steps_public_code_censored": int,
}


class MetricsConfig(Section):
    """How runs are measured and summarised."""

    final_fraction: float = Field(gt=0, le=1)  # the last part of training, for the final return
    threshold: float = Field(gt=0, lt=1)  # of the final return, for sample efficiency
    moving_average: PositiveInt  # W, episodes
    convergence_band: float = Field(gt=0, lt=1)  # of the learning range, around the final return
    confidence: float = Field(gt=0, lt=1)  # of every interval
    bootstrap_repetitions: int = Field(ge=100)
    bootstrap_seed: NonNegativeInt
    random_return: dict[str, float]  # mean return of uniformly random actions, per environment


class Episode(NamedTuple):
    """The episode (from 1) at which something is attained; E and censored if it never is."""

    number: int
    censored: bool


def final_return(returns: np.ndarray, fraction: float) -> float:
    """Mean return of the last `fraction` of the episodes (paper: the last 10 %).

    Where that is no whole number of episodes it is rounded up: 15 episodes end with the last 2.
    """
    last = math.ceil(Fraction(repr(fraction)) * len(returns))  # 0.07 of 100 is 7, not 7.000…001
    return float(np.mean(returns[-last:]))


def moving_average(returns: np.ndarray, window: int) -> np.ndarray:
    """Mean of each `window` consecutive returns, [E - window + 1]; empty if E < window.

    Entry i is the average after episode `window` + i.
    """
    return _moving_sum(returns, window) / window


def slope(returns: np.ndarray, window: int) -> np.ndarray:
    """Slope of the moving average in return per episode, [E - 2 · window + 1] or empty.

    Entry i belongs to episode 2 · `window` + i and compares the last `window` episodes with the
    `window` before them. (From one episode to the next, a moving average changes by the difference
    of two single episodes: that slope is noise, and 0 wherever two returns happen to be equal.)
    """
    total = _moving_sum(returns, window)
    return (total[window:] - total[:-window]) / window**2


def sample_efficiency(returns: np.ndarray, threshold: float, final: float) -> Episode:
    """The first episode with a return ≥ `threshold` · `final` (paper, literally).

    A single lucky episode is enough. Where returns are negative the bar lies *above* the final
    return (75 % of -85 is -63.75) and may never be reached.
    """
    return _first(returns >= threshold * final, 1, len(returns))


def convergence_steps(returns: np.ndarray, window: int) -> Episode:
    """The point where the slope of the moving average becomes minimal (paper).

    Our reading: while the agent learns the average rises; training "yields diminishing returns"
    where it stops to. So: the first episode after the steepest rise at which the slope is no longer
    positive, its magnitude having come down to its minimum, 0. On a curve that rises and stays,
    this is the first episode of smallest absolute slope after the rise. Searching the whole curve
    for the smallest absolute slope instead finds the flat start of a run that has yet to learn, or
    chance on the final plateau: `convergence_steps_flattest`.

    Censored: the average never rises, is still rising at the end, or E < 2 · `window`.
    """
    slopes = slope(returns, window)
    if not (slopes > 0).any():
        return Episode(len(returns), True)
    steepest = int(np.argmax(slopes))  # the first of equals
    return _first(slopes[steepest:] <= 0, 2 * window + steepest, len(returns))


def convergence_steps_flattest(returns: np.ndarray, window: int) -> Episode:
    """The first episode at which the absolute slope is smallest in all of training.

    The most literal reading of the paper's sentence. Censored only if E < 2 · `window`.
    """
    magnitude = np.abs(slope(returns, window))
    return _first(magnitude == magnitude.min(initial=np.inf), 2 * window, len(returns))


def convergence_steps_public_code(returns: np.ndarray) -> Episode:
    """The rule of the authors' public code, whatever the window configured here.

    The first 50-episode window past 30 % of training after which the moving average changes by less
    than 0.05 per episode over 50 episodes. As in that code, the number is the window's own (its
    first episode): never less than 586 of 2000 and 1786 of 6000, whatever has been learnt.
    """
    floor = int(PUBLIC_CODE_FLOOR * (len(returns) - PUBLIC_CODE_WINDOW + 1))
    flat = np.abs(slope(returns, PUBLIC_CODE_WINDOW)[floor:]) < PUBLIC_CODE_SLOPE
    return _first(flat, floor + 1, len(returns))


def sample_efficiency_range(
    returns: np.ndarray, threshold: float, final: float, window: int, random_mean: float
) -> Episode:
    """The first episode whose moving average has come `threshold` of the way from random to final.

    The bar is random + `threshold` · (final - random), with the mean return of uniformly random
    actions, `random_mean`: it means the same for negative returns, and one lucky episode does not
    reach it. Censored: never reached, or the run ends no better than random.
    """
    reached = moving_average(returns, window) >= random_mean + threshold * (final - random_mean)
    return _first(reached & (final > random_mean), window, len(returns))


def convergence_steps_range(
    returns: np.ndarray, band: float, final: float, window: int, random_mean: float
) -> Episode:
    """The first episode from which on the moving average stays near the final return.

    Near is within `band` · (final - random). Censored: the average ends outside that band, or the
    run ends no better than random.
    """
    average = moving_average(returns, window)
    outside = np.abs(average - final) > band * (final - random_mean)
    settled = np.logical_and.accumulate(~outside[::-1])[::-1]
    return _first(settled & (final > random_mean), window, len(returns))


def area_under_curve(returns: np.ndarray) -> float:
    """Area under the learning curve per episode: the mean return over all of training."""
    return float(np.mean(returns))


def random_return(settings: MetricsConfig, environment: str) -> float:
    """The configured mean return of random actions; a `ConfigError` where there is none."""
    if environment not in settings.random_return:
        raise ConfigError(
            f"the key 'metrics.random_return.{environment}' is missing: the mean return of"
            f" uniformly random actions in {environment}"
        )
    return settings.random_return[environment]


def metrics_of_run(
    frame: "pd.DataFrame", environment: str, variant: str, seed: int, settings: MetricsConfig
) -> dict[str, str | int | float]:
    """The row of metrics.csv of one run, from its records (`read_episodes`)."""
    returns = frame["extrinsic_return"].to_numpy()
    window, threshold = settings.moving_average, settings.threshold
    random_mean = random_return(settings, environment)
    final = final_return(returns, settings.final_fraction)
    paper = {
        "sample_efficiency": sample_efficiency(returns, threshold, final),
        "convergence_steps": convergence_steps(returns, window),
    }
    companions = {
        "sample_efficiency_range": sample_efficiency_range(
            returns, threshold, final, window, random_mean
        ),
        "convergence_steps_range": convergence_steps_range(
            returns, settings.convergence_band, final, window, random_mean
        ),
        "convergence_steps_flattest": convergence_steps_flattest(returns, window),
        "convergence_steps_public_code": convergence_steps_public_code(returns),
    }
    attained = paper | companions
    row = {
        "env": environment,
        "variant": variant,
        "seed": seed,
        "episodes": len(returns),
        "env_steps": int(frame["env_steps"].iloc[-1]),
        "final_return": final,
        **{name: episode.number for name, episode in paper.items()},
        "area_under_curve": area_under_curve(returns),
        **{name: episode.number for name, episode in companions.items()},
        **{f"{name}_censored": int(episode.censored) for name, episode in attained.items()},
    }
    return {name: row[name] for name in METRICS_COLUMNS}


def metrics_table(
    runs: Mapping[Run, "pd.DataFrame"],
    environments: Sequence[str],
    variants: Sequence[str],
    seeds: Sequence[int],
    settings: MetricsConfig,
) -> "pd.DataFrame":
    """One row of `METRICS_COLUMNS` per run, in the configured order.

    Raises `RecordError` unless `runs` holds exactly every environment, variant and seed.
    """
    import pandas as pd

    wanted = list(product(environments, variants, seeds))
    _check_runs("the records", runs, wanted)
    rows = [metrics_of_run(runs[run], *run, settings) for run in wanted]
    table = pd.DataFrame(rows, columns=list(METRICS_COLUMNS))
    _check_budgets("the records", table)
    return table


def read_metrics(
    path: str | Path,
    environments: Sequence[str],
    variants: Sequence[str],
    seeds: Sequence[int],
) -> "pd.DataFrame":
    """Read metrics.csv; `RecordError` unless it is `metrics_table` of exactly these runs."""
    import pandas as pd

    table = pd.DataFrame(read_rows(path, METRICS_COLUMNS), columns=list(METRICS_COLUMNS))
    found = list(zip(table["env"], table["variant"], table["seed"].tolist(), strict=True))
    wanted = list(product(environments, variants, seeds))
    _check_runs(str(path), found, wanted)
    for line, (run, right) in enumerate(zip(found, wanted, strict=True), start=2):
        if run != right:
            raise RecordError(
                f"{path}: line {line}: {_name(run)} stands where {_name(right)} belongs"
            )
    _check_attained(path, table)
    _check_budgets(str(path), table)
    return table


def _moving_sum(returns: np.ndarray, window: int) -> np.ndarray:
    """Sum of each `window` consecutive returns: exact for whole numbers, so that ties are ties."""
    if len(returns) < window:
        return np.empty(0)
    return np.lib.stride_tricks.sliding_window_view(returns, window).sum(axis=-1)


def _first(reached: np.ndarray, offset: int, episodes: int) -> Episode:
    """The first true entry of `reached`, whose entry 0 belongs to episode `offset`."""
    if not reached.any():
        return Episode(episodes, True)
    return Episode(offset + int(np.argmax(reached)), False)


def _check_runs(origin: str, found: Iterable[Run], wanted: Sequence[Run]) -> None:
    """Refuse a set of runs that is not exactly the configured one."""
    counts = Counter(iter(found))
    for run in wanted:
        if counts[run] != 1:
            problem = "stands more than once in" if counts[run] else "is missing from"
            raise RecordError(f"{_name(run)} {problem} {origin}")
    for run in counts.keys() - set(wanted):
        raise RecordError(f"{_name(run)} in {origin} is not in the configuration")


def _check_budgets(origin: str, table: "pd.DataFrame") -> None:
    """Refuse seeds of different lengths, which must not be averaged."""
    for (environment, variant), group in table.groupby(["env", "variant"], sort=False):
        if group["episodes"].nunique() != 1:
            counts = sorted(set(group["episodes"]))
            raise RecordError(
                f"{origin}: the seeds of {environment}, {variant} have different numbers of"
                f" episodes: {counts}"
            )


def _check_attained(path: str | Path, table: "pd.DataFrame") -> None:
    """Refuse episodes outside of training, and flags that contradict them."""
    for flag in (name for name in METRICS_COLUMNS if name.endswith("_censored")):
        metric = flag.removesuffix("_censored")
        right = table[metric].between(1, table["episodes"]) & table[flag].isin((0, 1))
        right &= (table[flag] == 0) | (table[metric] == table["episodes"])
        if not right.all():
            row = int(np.argmin(right))
            raise RecordError(
                f"{path}: line {row + 2}: {metric} is {table[metric][row]} of"
                f" {table['episodes'][row]} episodes with {flag} = {table[flag][row]}"
            )


def _name(run: Run) -> str:
    environment, variant, seed = run
    return f"the run {environment}, {variant}, seed {seed}"
