"""What do both rules of verdicts say where the truth is known? By simulation (docs/metrics.md).

    python -m tools.rule_simulation [STUDIES]

First, of 10 · STUDIES parts whose true difference is the margin, how many in % are called absent:
by the test of equivalence alone, with the interval inside the margin too, and with the p value that
Holm gives the first of 24 parts. Then STUDIES (100) studies are drawn from the runs that
reference/tables/study has: how many in % give each of the paper's claims which verdict.
"""

import argparse
import os
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from itertools import product, repeat
from pathlib import Path

import numpy as np
import pandas as pd

from mace_rl.config.reading import read_yaml
from mace_rl.study.claims_config import ClaimsConfig, Part, parts_of
from mace_rl.study.compare import direction_and_size
from mace_rl.study.compare.estimates import LEVEL, Pair, find, pairs_of
from mace_rl.study.compare.ledger import SizedFinding
from mace_rl.study.compare.verdicts import ledger
from mace_rl.study.config import read_study
from mace_rl.study.measure.metrics import BEFORE, CORRELATION, CORRELATIONS, all_metrics

SETTINGS = read_study([Path("config.yaml"), Path("config/study.yaml")]).metrics
SETTINGS = SETTINGS.model_copy(update={"bootstrap_repetitions": 1000})  # for the time
EPISODES = {one.name: one for one in all_metrics(SETTINGS) if one.unit == "episodes"}
TABLES, WAY, SEEDS, PARTS, MARGIN = Path("reference/tables/study"), "robust", (20, 40), 24, 3.0
SPREADS = {"normal": 0, "one seed in 20 fails by 8 σ": 8, "one seed in 20 fails by 40 σ": 40}
BEST, TABLE1, NOTHING = "as good as can be", "Table 1", "nothing differs"
SAID = {"shown": "r", "reversed": "c", "absent": "n", "open": "i", "no_room": "x"}


def absences(spread: str, seeds: int, count: int) -> np.ndarray:
    """The first table's numbers, at that end of the margin where they are greater."""
    draws, part = np.random.default_rng(0), Part(("A-v0",), "final_return", "a", None, np.nan)
    found = np.zeros((2, 3))
    for end, _ in product((0, 1), range(count)):
        failed = SPREADS[spread] * ((draws.random(seeds) < 1 / 20) - 1 / 20)
        values = MARGIN * (-1) ** end + draws.normal(size=seeds) - failed
        one = find(part, [Pair(values, np.zeros(seeds), 1, np.inf, 0)], MARGIN, SETTINGS)
        found[end, 0] += one.p_equivalent < LEVEL
        for column, times in ((1, 1), (2, PARTS)):
            known = asdict(one) | {"p_equivalent_holm": times * one.p_equivalent}
            judged = direction_and_size.decided(SizedFinding(**known, room=np.inf))
            found[end, column] += judged.outcome == "absent"
    return 100 * found.max(axis=0) / count


def claims_by(rule: int) -> ClaimsConfig:
    """The paper's claims, robust; by the second rule C9 is about the time before the bar."""
    values = read_yaml(Path("config/claims.yaml"))
    title, family = next(iter(values["families"].items()))
    family["words"]["no_room"] = "could not be asked"
    for claim in family["claims"].values():
        claim["parts"] = {WAY: [dict(part) for part in claim["parts"][WAY]]}
        for part in claim["parts"][WAY]:
            part["metric"] = part["metric"].replace(CORRELATION, (CORRELATION, BEFORE)[rule - 1])
    return ClaimsConfig.model_validate(values | {"rule": rule, "families": {title: family}})


CLAIMS = {rule: claims_by(rule) for rule in (1, 2)}
[FAMILY] = CLAIMS[1].families.values()
EVERY = [part for claims in CLAIMS.values() for _, part in parts_of(*claims.families.values())]
PAIRS = {  # what is measured in which environment, and of which variant it is said to be better
    (env, part.metric, part.variant) for part in EVERY for env in part.environments
}
RUNS = pd.read_csv(TABLES / "metrics.csv").merge(pd.read_csv(TABLES / "betas.csv"))
RUNS = RUNS[["env", "variant", "episodes", *{metric for _, metric, _ in PAIRS}]]


def study(truth: str, seeds: int, draws: np.random.Generator) -> pd.DataFrame:
    """The metrics of a study in which that is true, of runs drawn with replacement."""
    drawn, paper = [], CLAIMS[1].table1
    for (env, variant), own in RUNS.groupby(["env", "variant"], sort=False):
        pool = RUNS[RUNS["env"] == env] if truth == NOTHING else own
        new = pool.sample(seeds, replace=True, random_state=draws)
        new = new.assign(variant=variant, seed=range(seeds))
        for metric in new.columns.intersection([*CORRELATIONS, *EPISODES]):
            value = paper.values_of([env], metric).get(variant)
            if truth == NOTHING and metric in CORRELATIONS:
                chosen = own[metric].sample(seeds, replace=True, random_state=draws)
                new[metric] = (chosen - own[metric].mean()).to_numpy()
            elif truth == TABLE1 and value is not None:
                budget = new["episodes"].iloc[0]
                first = EPISODES[metric].earliest(SETTINGS.moving_average, budget)
                new[metric] = (new[metric] - own[metric].mean() + value).clip(first, budget)
        drawn.append(new)
    table = pd.concat(drawn, ignore_index=True)
    for env, metric, variant in PAIRS if truth == BEST else ():
        best = pairs_of(Part((env,), metric, variant, None, 0.0), table, SETTINGS)[0].best
        own = (table["env"] == env) & (table["variant"] == variant)
        table.loc[own, metric] = -best if metric in EPISODES else best
    return table


def outcomes(truth: str, seeds: int, number: int) -> list[list[str]]:
    """Of one study, each claim's by each rule."""
    table = study(truth, seeds, np.random.default_rng([seeds, number]))
    answers = [ledger(table, SETTINGS, claims) for claims in CLAIMS.values()]
    return [[answer.ways[WAY].outcome for answer in own] for own in answers]


def main(studies: int) -> None:
    """Print both tables."""
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        print("differences | seeds | test alone | and the interval | and Holm")
        cells = list(product(SPREADS, SEEDS))
        rows = [pool.submit(absences, *cell, 10 * studies) for cell in cells]
        for cell, row in zip(cells, rows, strict=True):
            print(*cell, *np.round(row.result(), 1), sep=" | ")
        print("\ntrue | seeds | rule", *FAMILY.claims, sep=" | ")
        for truth, seeds in product((BEST, TABLE1, NOTHING), SEEDS):
            whole = pool.map(outcomes, repeat(truth), repeat(seeds), range(studies), chunksize=5)
            by_rule = np.array(list(whole)).transpose(1, 2, 0)
            for rule, claims in zip(CLAIMS, by_rule, strict=True):
                said = [
                    " ".join(f"{SAID[k]} {100 * n / studies:.0f}" for k, n in own.most_common())
                    for own in map(Counter, claims.tolist())
                ]
                print(truth, seeds, rule, *said, sep=" | ", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.rule_simulation 50"
    )
    parser.add_argument("studies", type=int, nargs="?", default=100, help="(default: 100)")
    count = parser.parse_args().studies
    if count < 1:
        sys.exit(f"rule_simulation: STUDIES is {count}, but should be at least 1")
    main(count)
