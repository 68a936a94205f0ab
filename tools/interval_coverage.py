"""How often do the intervals of the tables hold the true value? By simulation.

    .venv/bin/python -m tools.interval_coverage [REPEATS]

For 10 and 20 seeds and several distributions over seeds: the share of REPEATS (2000) simulated
studies whose nominal 95 % interval holds the truth, in %, for the mean, the interquartile mean and
the probability of improvement over a variant of the same distribution (truth: one half).
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import scipy

from mace_rl.results.aggregate import interquartile_mean, score_interval
from mace_rl.results.statistics import mean_interval, probability_of_improvement

HOW = (0.95, 1000)  # confidence, and bootstrap resamples: fewer than in the tables, for the time


class Distribution(NamedTuple):
    """What one seed gives."""

    name: str
    draw: Callable[[np.random.Generator, int], np.ndarray]


DISTRIBUTIONS = (
    Distribution("normal", lambda draws, n: draws.normal(size=n)),
    Distribution("heavy tails (Laplace)", lambda draws, n: draws.laplace(size=n)),
    Distribution("skewed (log-normal, σ = 0.5)", lambda draws, n: draws.lognormal(0, 0.5, n)),
    Distribution("very skewed (exponential)", lambda draws, n: draws.exponential(size=n)),
    Distribution(
        "one seed in ten fails", lambda draws, n: draws.normal(size=n) - 8 * (draws.random(n) < 0.1)
    ),
)


def covered(distribution: Distribution, seeds: int, repeats: int) -> Iterator[float]:
    """The shares for the three estimates."""
    draws = np.random.default_rng(0)
    many = distribution.draw(draws, 2_000_000)
    truths = many.mean(), scipy.stats.trim_mean(many, 0.25), 0.5
    hits = np.zeros(3)
    for _ in range(repeats):
        x, y = distribution.draw(draws, seeds), distribution.draw(draws, seeds)
        bounds = (
            mean_interval(x, *HOW, draws),
            score_interval([x], interquartile_mean, *HOW, draws),
            probability_of_improvement([(x, y)], *HOW, draws)[1:],
        )
        hits += [low <= truth <= high for truth, (low, high) in zip(truths, bounds, strict=True)]
    yield from 100 * hits / repeats


def main(repeats: int) -> None:
    """Print the table."""
    print("| seeds | distribution | mean | interquartile mean | probability of improvement |")
    print("|---|---|---|---|---|")
    for seeds in (10, 20):
        for distribution in DISTRIBUTIONS:
            shares = " | ".join(f"{share:.1f}" for share in covered(distribution, seeds, repeats))
            print(f"| {seeds} | {distribution.name} | {shares} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.interval_coverage 500"
    )
    parser.add_argument("repeats", type=int, nargs="?", default=2000, help="(default: 2000)")
    count = parser.parse_args().repeats
    if count < 1:
        sys.exit(f"interval_coverage: REPEATS is {count}, but should be at least 1")
    main(count)
