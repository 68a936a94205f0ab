"""Which reading of the paper's "slope of the moving average becomes minimal" is steadiest?

    .venv/bin/python -m tools.convergence_simulation [FOLDER_OF_RUNS ...]

Each reading is applied to 300 simulated learning curves of four shapes, whose mean is the same and
known, with the noise of the three environments; and to 300 that begin to learn a tenth of the
budget later. Printed, in % of the budget: the median error (where the mean comes within 5 % of its
end for good is true) ± the standard deviation; then how often, in %, a late curve comes out later
than another (50: the reading does not see a difference). A folder of runs, such as results/runs,
adds the median ± the standard deviation over seeds of each environment and variant in it.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from mace_rl.config.reading import read_yaml
from mace_rl.config.results import MetricsConfig
from mace_rl.config.section import ConfigError
from mace_rl.results import metrics as m

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = MetricsConfig.model_validate(read_yaml(ROOT / "config.yaml")["metrics"])
REPEATS, LATER = 300, 0.1

Returns = np.ndarray  # float64 [episodes]
Generator = np.random.Generator


def rise(episodes: int, middle: float, width: float) -> np.ndarray:
    """From 0 to 1 along the logistic curve, [episodes]."""
    return 1 / (1 + np.exp(-(np.arange(episodes) - middle) / width))


def acrobot(level: np.ndarray, generator: Generator) -> Returns:
    """-500 until it is first solved; then skewed, with a long bad episode now and then."""
    competence, n = (level + 500) / 415, len(level)
    returns = -60 - generator.gamma(2, 12.5, n) / np.maximum(competence, 0.05)
    returns = np.where(generator.random(n) < 0.02, -generator.uniform(150, 500, n), returns)
    return np.where(generator.random(n) < 1.1 * competence, np.maximum(returns, -500), -500)


def cartpole(level: np.ndarray, generator: Generator) -> Returns:
    """As noisy as it is high, until 500 is kept; then four collapses of 15 to 80 episodes."""
    n = len(level)
    returns = np.where(level > 490, 500, generator.gamma(3, level * 1.15 / 3))
    for start in generator.integers(n, size=4):
        end = min(n, start + generator.integers(15, 80))
        if level[start] > 400:
            returns[start:end] = generator.gamma(4, generator.uniform(150, 350) / 4, end - start)
    return np.floor(np.minimum(returns, 500))


def hopper(level: np.ndarray, generator: Generator) -> Returns:
    """Noise in proportion to the level, early falls, and a drift over some 200 episodes."""
    n = len(level)
    drift = np.convolve(generator.normal(size=n + 199), np.full(200, 200**-0.5), "valid")
    fall = np.where(generator.random(n) < 0.15, generator.uniform(0.2, 0.9, n), 1)
    return level * (1 + 0.08 * drift) * fall * (1 + 0.1 * generator.normal(size=n))


def steps(level: np.ndarray, generator: Generator) -> Returns:
    """Noise in proportion to what has been gained."""
    return level + generator.normal(size=len(level)) * (5 + 0.15 * (level + 200))


SHAPES = {  # noise, mean return of each episode, mean return of random actions
    "Acrobot": (acrobot, -500 + 415 * rise(2000, 200, 33), -499.1),
    "CartPole": (cartpole, 20 + 480 * rise(2000, 200, 40), 22.1),
    "Hopper": (hopper, 20 + 1400 * (1 - np.exp(-np.arange(6000) / 720)), 20.0),
    "two steps": (steps, -200 + 100 * (rise(2000, 100, 20) + rise(2000, 400, 25)), -200.0),
}


def after_the_steepest(curve: m.LearningCurve, share: float) -> m.Episode:
    """First slope ≤ share of the steepest, after it."""
    window = curve.settings.moving_average
    slopes = curve.slopes
    place = int(np.argmax(slopes))
    return curve.first(slopes[place:] <= share * slopes[place], 2 * window + place)


def for_good(curve: m.LearningCurve, share: float) -> m.Episode:
    """From here on no slope > share of the steepest."""
    window = curve.settings.moving_average
    slopes = curve.slopes
    low = np.logical_and.accumulate((slopes <= share * slopes.max())[::-1])[::-1]
    return curve.first(low, 2 * window)


def with_settings(curve: m.LearningCurve, **changes: float) -> m.Episode:
    """The metric of Table 1 with other settings."""
    settings = curve.settings.model_copy(update=changes)
    return m.convergence_steps(
        m.LearningCurve(curve.returns, curve.final, curve.random_mean, settings)
    )


READINGS: dict[str, Callable[[m.LearningCurve], m.Episode]] = {
    "smallest absolute slope of all (flattest)": m.convergence_steps_flattest,
    "slope ≤ 0 after the steepest (steepest)": m.convergence_steps_steepest,
    "slope ≤ 10 % of the steepest, after it": partial(after_the_steepest, share=0.1),
    "slope ≤ 10 % of the steepest, for good": partial(for_good, share=0.1),
    "average within 10 % of final, for good (range)": m.convergence_steps_range,
    "public code": m.convergence_steps_public_code,
    "from 75 % of the way on: slope ≤ 0": partial(with_settings, convergence_slope=0),
    "… ≤ 5 % of the steepest so far": partial(with_settings, convergence_slope=0.05),
    "… ≤ 10 % (Table 1)": m.convergence_steps,
    "… ≤ 20 %": partial(with_settings, convergence_slope=0.2),
    "… ≤ 10 %, from 50 % of the way on": partial(with_settings, threshold=0.5),
    "… ≤ 10 %, from 90 % of the way on": partial(with_settings, threshold=0.9),
    "… ≤ 10 %, window 25": partial(with_settings, moving_average=25),
    "… ≤ 10 %, window 100": partial(with_settings, moving_average=100),
}


def curve_of(returns: Returns, random: float) -> m.LearningCurve:
    """What a metric sees of these returns."""
    final = m.final_return(returns, SETTINGS.final_fraction)
    return m.LearningCurve(returns, final, random, SETTINGS)


def simulate(shape: str) -> tuple[list[m.LearningCurve], list[m.LearningCurve], int]:
    """Curves of a shape, curves that begin later, and the episode at which the first have risen."""
    noise, level, random = SHAPES[shape]
    generator, delay = np.random.default_rng(0), int(LATER * len(level))
    late = np.concatenate([np.full(delay, level[0]), level[:-delay]])
    curves, delayed = (
        [curve_of(noise(mean, generator), random) for _ in range(REPEATS)] for mean in (level, late)
    )
    risen = level - level[0] >= 0.95 * (level[-1] - level[0])
    return curves, delayed, int(np.argmax(risen)) + 1


def column(shape: str) -> list[str]:
    """The cells of a shape, one for each of the `READINGS`."""
    curves, delayed, true = simulate(shape)
    budget, cells = len(curves[0].returns), []
    for reading in READINGS.values():
        found, later = (np.array([reading(c).number for c in group]) for group in (curves, delayed))
        order = np.mean(np.heaviside(later[:, None] - found, 0.5))
        error, spread = (100 * (np.median(found) - true) / budget, 100 * found.std() / budget)
        cells.append(f"{error:+.1f} ± {spread:.1f}, {100 * order:.0f}")
    return cells


def real_columns(folder: Path) -> dict[str, list[str]]:
    """The cells of the finished runs ENVIRONMENT/VARIANT/seedN in a folder.

    Raises `ConfigError` if there are none, or if one's mean return of random actions is unknown.
    """
    groups = {path.parents[1] for path in folder.glob("*/*/seed*/episodes.csv")}
    if not groups:
        raise ConfigError(f"{folder}: no ENVIRONMENT/VARIANT/seedN/episodes.csv in it")
    columns = {}
    for group in sorted(groups):
        random = SETTINGS.random_return_in(group.parent.name)
        curves = [
            curve_of(np.genfromtxt(path, delimiter=",", names=True)["extrinsic_return"], random)
            for path in sorted(group.glob("seed*/episodes.csv"))
        ]
        budget, cells = len(curves[0].returns), []
        for reading in READINGS.values():
            found = 100 * np.array([reading(curve).number for curve in curves]) / budget
            cells.append(f"{np.median(found):.1f} ± {found.std(ddof=1):.1f}")
        columns[f"{group.parent.name} {group.name} ({len(curves)})"] = cells
    return columns


def main() -> None:
    """Print the table, as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.convergence_simulation results/runs",
    )
    parser.add_argument("folders", type=Path, nargs="*", help="of runs")
    folders: list[Path] = parser.parse_args().folders
    real: dict[str, list[str]] = {}
    try:
        for folder in folders:
            columns = real_columns(folder)
            if both := real.keys() & columns.keys():
                raise ConfigError(f"{folder}: another folder has {min(both)} too")
            real |= columns
    except ConfigError as error:
        sys.exit(f"convergence_simulation: {error}")
    columns = {shape: column(shape) for shape in SHAPES} | real
    print("|", " | ".join(["", *columns]), "|")
    print("|---" * (1 + len(columns)) + "|")
    for name, *cells in zip(READINGS, *columns.values(), strict=True):
        print("|", " | ".join([name, *cells]), "|")


if __name__ == "__main__":
    main()
