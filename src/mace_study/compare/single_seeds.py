"""The paper's Table 1 as a draw: could it be one seed of each variant in this study?

Both metrics are read by the public code's rules (reference/worlds/protocol.md, "The table as a
draw"). Whatever is asked is exact: over all seeds that could have been drawn.
"""

import math
from collections.abc import Iterable, Mapping
from functools import reduce
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from mace_study.compare.claims_config import Table1Config

CENTRAL = 0.9  # a number that is not within so much of the seeds is unusual
LEVEL = 0.05  # a study in which fewer draws have as many unusual numbers is unlike the paper's


class Draw(NamedTuple):
    """What one seed of each variant would give; chances are of draws of this study."""

    unusual: int  # of the paper's numbers
    numbers: int  # how many it has
    chance_unusual: float  # that a draw has as many, among the study's other seeds
    limit: int  # so many are seen in fewer than `LEVEL` of the draws
    favoured: str  # the variant that is first in most columns of the paper's table
    first: int  # in so many columns of the environments that the study has
    chance_first: float  # that it is first in as many
    chance_any: float  # the same of a variant chosen at random, in each environment by itself


def numbers(runs: pd.DataFrame, table1: Table1Config) -> pd.DataFrame:
    """Where each of the paper's numbers stands among the seeds.

    runs: the frame of metrics.csv. Columns: env, variant, metric (as it is read), paper, seeds,
    low, median, high (low to high: the central `CENTRAL` of the seeds), place (`places`) and
    unusual (0 or 1). Environments that `runs` lacks are left out.
    """
    names = ["env", "variant", "metric", "paper", "seeds", "low", "median", "high", "place"]
    rows = []
    for (env, variant), seeds in _cells(runs, table1).items():
        paper = np.array(table1.values[env][variant], np.float64)
        ends = (1 - CENTRAL) / 2, 0.5, (1 + CENTRAL) / 2
        found = *np.quantile(seeds, ends, axis=0), places(paper, seeds)
        for column, metric in enumerate(table1.public_code):
            of_column = (values[column] for values in found)
            rows.append((env, variant, metric, paper[column], len(seeds), *of_column))
    table = pd.DataFrame(rows, columns=names)
    return table.assign(unusual=_unusual(table["place"].to_numpy()).astype(int))


def draw(runs: pd.DataFrame, table1: Table1Config) -> Draw:
    """What one seed of each variant gives, and how the paper's table compares; as in `numbers`."""
    cells = _cells(runs, table1)
    environments = list(dict.fromkeys(env for env, _ in cells))
    found = int(numbers(runs, table1)["unusual"].sum())
    unusual = at_least(_unusual_when_drawn(seeds) for seeds in cells.values())
    paper = {env: first_in(_paper(env, table1)) for env in table1.values}
    led = {name: sum(leads[name].argmax() for leads in paper.values()) for name in table1.variants}
    favoured = max(led, key=led.__getitem__)
    first = sum(int(paper[env][favoured].argmax()) for env in environments)
    by_env = [{name: cells[env, name] for name in table1.variants} for env in environments]
    firsts = [first_in(seeds) for seeds in by_env]
    favoured_first = at_least(shares[favoured] for shares in firsts)
    anyone = at_least(np.mean(list(shares.values()), axis=0) for shares in firsts)
    return Draw(
        unusual=found,
        numbers=len(cells) * len(table1.public_code),
        chance_unusual=float(unusual[found]),
        limit=int(np.argmax(np.append(unusual, 0.0) < LEVEL)),
        favoured=favoured,
        first=first,
        chance_first=float(favoured_first[first]),
        chance_any=float(anyone[first]),
    )


def places(values: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The place of each value among `seeds`, [n, ...], from 0 to 1: its mid-rank over n + 1."""
    less, equal = (seeds < values).sum(axis=0), (seeds == values).sum(axis=0)
    return (less + (equal + 1) / 2) / (len(seeds) + 1)


def first_in(cells: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The share of all draws, a row each, in which a variant alone is lowest in 0, 1, ... columns.

    cells: by variant its rows, [seeds, columns]. Returns [columns + 1] by variant.
    """
    draws, found = math.prod(map(len, cells.values())), {}
    for name, rows in cells.items():
        columns = range(rows.shape[1])
        # By size: draws in which it is lowest in all of a set of columns, summed over the sets.
        lowest = [0] * (len(columns) + 1)
        for size in range(len(columns) + 1):
            for chosen in map(list, combinations(columns, size)):
                beaten = [
                    (rows[:, None, chosen] < other[None][..., chosen]).all(axis=-1).sum(axis=1)
                    for key, other in cells.items()
                    if key != name
                ]
                lowest[size] += int(np.prod(beaten, axis=0).sum())
        exactly = [  # by inclusion and exclusion
            sum((-1) ** (size - k) * math.comb(size, k) * n for size, n in enumerate(lowest))
            for k in range(len(lowest))
        ]
        found[name] = np.array(exactly) / draws
    return found


def at_least(shares: Iterable[np.ndarray]) -> np.ndarray:
    """The chance that a sum of independent counts is at least 0, 1, ...; shares: of 0, 1, ..."""
    return np.minimum(np.cumsum(reduce(np.convolve, shares)[::-1])[::-1], 1.0)


def _cells(runs: pd.DataFrame, table1: Table1Config) -> dict[tuple[str, str], np.ndarray]:
    """By environment and variant the two metrics of every seed, float64 [seeds, 2]."""
    return {
        (env, variant): runs.loc[
            (runs["env"] == env) & (runs["variant"] == variant), table1.public_code
        ].to_numpy(np.float64)
        for env in table1.values
        for variant in table1.variants
        if env in set(runs["env"])
    }


def _paper(env: str, table1: Table1Config) -> dict[str, np.ndarray]:
    return {name: np.array([table1.values[env][name]], np.float64) for name in table1.variants}


def _unusual(place: np.ndarray) -> np.ndarray:
    return np.abs(place - 0.5) >= CENTRAL / 2 - 1e-9


def _unusual_when_drawn(seeds: np.ndarray) -> np.ndarray:
    """How often 0, 1, ... columns of a seed are unusual among the others, [columns + 1]."""
    others = (np.delete(seeds, seed, axis=0) for seed in range(len(seeds)))
    place = np.array([places(row, rest) for row, rest in zip(seeds, others, strict=True)])
    return _shares(_unusual(place).sum(axis=1), seeds.shape[1])


def _shares(counts: np.ndarray, most: int) -> np.ndarray:
    """Which share of `counts` is 0, 1, ..., `most`."""
    return np.array([np.mean(counts == value) for value in range(most + 1)])
