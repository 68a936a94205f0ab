"""What do the rules of verdicts say where the truth is known? By simulation.

    python -m tools.rule_simulation [STUDIES]              both rules: docs/metrics.md
    python -m tools.rule_simulation [STUDIES] --worlds     the second: docs/worlds-protocol.md

Of 10 · STUDIES parts whose difference is the margin, how many in % are absent, by more and more of
the rule; then, of STUDIES (100) drawn from the runs of reference/tables/study, what they say, in %.
With --worlds the studies have the seeds of each world. For *tuned* they are drawn from the same
runs, for the others from pilot runs of all variants together (reference/measured/pilot.csv).
"""

import argparse
import sys
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import asdict, replace
from itertools import product, repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from mace_rl.config.reading import read_yaml
from mace_rl.study.claims_config import FEWEST_SEEDS, ClaimsConfig, Part, parts_of
from mace_rl.study.compare.direction_and_size import decided
from mace_rl.study.compare.estimates import LEVEL, Pair, find, pairs_of
from mace_rl.study.compare.ledger import SizedFinding
from mace_rl.study.compare.verdicts import ledger
from mace_rl.study.config import read_study
from mace_rl.study.measure.betas import BEFORE, CORRELATION, CORRELATIONS
from mace_rl.study.measure.metrics import METRICS
from mace_rl.study.metrics_config import MetricsConfig
from tools.worlds import WORLDS

SETTINGS = read_study([Path("config.yaml")]).metrics
SETTINGS = SETTINGS.model_copy(update={"bootstrap_repetitions": 1000})  # for the time ...
EXACT = SETTINGS.model_copy(update={"bootstrap_repetitions": 1024})  # ... all signs of 10 seeds
EPISODES = {one.name: one for one in METRICS if one.unit == "episodes"}
TABLES, WAY, SEEDS, MARGIN = Path("reference/tables/study"), "robust", (20, 40), 3.0
SPREADS = {"normal": 0, "one seed in 20 fails by 8 σ": 8, "one seed in 20 fails by 40 σ": 40}
BEST, TABLE1, NOTHING = "as good as can be", "Table 1", "nothing differs"
SAID = {"shown": "r", "reversed": "c", "absent": "n", "open": "i", "no_room": "x"}


def absences(spread: str, seeds: int, count: int, end: int) -> np.ndarray:
    """The first table's numbers, at this end of the margin."""
    draws, part = np.random.default_rng(0), Part(("A-v0",), "final_return", "a", None, np.nan)
    found = np.zeros(3)
    for _ in range(count):
        failed = SPREADS[spread] * ((draws.random(seeds) < 1 / 20) - 1 / 20)
        values = end * MARGIN + draws.normal(size=seeds) - failed
        one = find(part, [Pair(values, np.zeros(seeds), 1, np.inf, 0)], MARGIN, SETTINGS)
        sized, p = SizedFinding(**asdict(one), room=np.inf), one.p_equivalent
        judged = [decided(replace(sized, p_equivalent_holm=p * parts)) for parts in (1, 24)]
        found += [p < LEVEL, *(part.outcome == "absent" for part in judged)]
    return 100 * found / count


def claims_by(rule: int) -> ClaimsConfig:
    """The paper's claims, robust; by the second rule C9 is about the time before the bar."""
    values = read_yaml(Path("reference/confirmation/claims.yaml"))
    title, family = next(iter(values["families"].items()))
    family["words"]["no_room"] = "could not be asked"
    for claim in family["claims"].values():
        claim["parts"] = {WAY: [dict(part) for part in claim["parts"][WAY]]}
        for part in claim["parts"][WAY]:
            part["metric"] = part["metric"].replace(CORRELATION, (CORRELATION, BEFORE)[rule - 1])
    return ClaimsConfig.model_validate(values | {"rule": rule, "families": {title: family}})


CLAIMS = {rule: claims_by(rule) for rule in (1, 2)}
EVERY = [part for claims in CLAIMS.values() for _, part in parts_of(*claims.families.values())]
CELLS = {(env, one.metric, one.variant) for one in EVERY for env in one.environments}
RUNS = pd.read_csv(TABLES / "metrics.csv").merge(pd.read_csv(TABLES / "betas.csv"))
RUNS = RUNS[["env", "variant", "episodes", *sorted({metric for _, metric, _ in CELLS})]]
PILOT = Path("reference/measured/pilot.csv")


class World(NamedTuple):
    """What studies are drawn from, and how many seeds they have in each environment."""

    runs: pd.DataFrame
    seeds: Mapping[str, int]
    together: bool  # whether a variant's runs are drawn from those of all
    apart: bool  # whether correlations are drawn by themselves, since PPO has none
    settings: MetricsConfig


def world(name: str) -> World:
    """One of docs/worlds-protocol.md."""
    wanted = read_study([Path("config.yaml"), Path(f"config/worlds/{name}.yaml")]).runs()
    seeds = Counter(env for env, variant, _ in wanted if variant == "ppo")
    return World(_pilot(name), seeds, name != "tuned", True, EXACT)


def _pilot(name: str) -> pd.DataFrame:
    """The pilot runs of a world; where there are under 10, the last world's, with their mean."""
    if name == "tuned":
        return RUNS
    pilot = pd.read_csv(PILOT).query("world == @name")
    measured = sorted({metric for _, metric, _ in CELLS if metric not in CORRELATIONS})
    found = []
    for env, runs in _pilot(WORLDS[WORLDS.index(name) - 1]).groupby("env", sort=False):
        own = pilot[pilot["env"] == env]
        if 0 < len(own) < FEWEST_SEEDS:
            shift = own[measured].mean() - runs[measured].mean()
            runs = runs.assign(**{metric: runs[metric] + shift[metric] for metric in measured})
            for metric in runs.columns.intersection([*EPISODES]):
                first = EPISODES[metric].earliest(SETTINGS.moving_average, runs["episodes"].min())
                runs[metric] = runs[metric].clip(lower=first)
        found.append(own[RUNS.columns] if len(own) >= FEWEST_SEEDS else runs)
    return pd.concat(found, ignore_index=True)


def study(truth: str, origin: World, draws: np.random.Generator) -> pd.DataFrame:
    """The metrics of a study in which that is true, of runs drawn with replacement."""
    drawn, runs = [], origin.runs
    for cell, own in runs.groupby(["env", "variant"], sort=False):
        (env, variant), budget = map(str, cell), own["episodes"].min()
        seeds = origin.seeds[env]
        pool = runs[runs["env"] == env] if origin.together or truth == NOTHING else own
        new = pool.sample(seeds, replace=True, random_state=draws)
        new = new.assign(variant=variant, seed=range(seeds))
        for metric in new.columns.intersection([*CORRELATIONS, *EPISODES]):
            value = CLAIMS[1].table1.values_of([env], metric).get(variant)
            if metric in CORRELATIONS and (origin.apart or truth == NOTHING):
                chosen = own[metric].sample(seeds, replace=True, random_state=draws)
                nothing = own[metric].mean() if truth == NOTHING else 0.0
                new[metric] = (chosen - nothing).to_numpy()
            elif truth == TABLE1 and value is not None:
                first = EPISODES[metric].earliest(SETTINGS.moving_average, budget)
                new[metric] = (new[metric] - pool[metric].mean() + value).clip(first, budget)
        drawn.append(new)
    table = pd.concat(drawn, ignore_index=True)
    for env, metric, variant in CELLS if truth == BEST else ():
        best = pairs_of(Part((env,), metric, variant, None, 0.0), table, SETTINGS)[0].best
        better = (table["env"] == env) & (table["variant"] == variant)
        table.loc[better, metric] = -best if metric in EPISODES else best
    return table


def outcomes(truth: str, origin: World, number: int) -> list[list[str]]:
    """Of one study, each claim's by each rule."""
    table = study(
        truth, origin, np.random.default_rng([origin.seeds[next(iter(origin.seeds))], number])
    )
    answers = [ledger(table, origin.settings, claims) for claims in CLAIMS.values()]
    return [[answer.ways[WAY].outcome for answer in own] for own in answers]


def said(truth: str, origin: World, studies: int, pool: Executor) -> dict[int, list[str]]:
    """By rule what it says of each claim, in how many % of the studies."""
    found = np.array(list(pool.map(outcomes, repeat(truth), repeat(origin), range(studies))))
    texts = {}
    for rule, claims in zip(CLAIMS, found.transpose(1, 2, 0).tolist(), strict=True):
        counts = [Counter(SAID[one] for one in own).most_common() for own in claims]
        texts[rule] = [", ".join(f"{k} {100 * n / studies:.0f}" for k, n in own) for own in counts]
    return texts


def rooms(origin: World) -> list[str]:
    """Of each part by the second rule: how much room, what is worth mentioning, detectable."""
    table = study("", origin, np.random.default_rng(0))
    lines = []
    for answer in ledger(table, SETTINGS, CLAIMS[2]):
        for part in answer.ways[WAY].parts:
            assert isinstance(part, SizedFinding)
            where = ", ".join(part.environments)
            sizes = f"{part.room:.4g} | {part.worth_mentioning:.4g} | {part.detectable:.4g}"
            over = f"{part.variant} over {part.baseline or 0}"
            lines.append(f"{answer.claim} | {where} | {part.metric} | {over} | {sizes}")
    return lines


def main(studies: int, worlds: bool) -> None:
    claims = " | ".join(f"C{number}" for number in range(1, 11))
    with ProcessPoolExecutor() as pool:
        if worlds:
            print("world", "true", claims, sep=" | ")
            for name, truth in product(WORLDS, (BEST, TABLE1, NOTHING)):
                print(
                    name, truth, *said(truth, world(name), studies, pool)[2], sep=" | ", flush=True
                )
            for name in WORLDS:
                print(
                    "",
                    f"{name} | claim | where | metric | part | room | margin | detectable",
                    sep="\n",
                )
                print(*rooms(world(name)), sep="\n")
            return
        print("differences | seeds | test alone | and the interval | and Holm")
        for cell in product(SPREADS, SEEDS):
            shares = pool.map(absences, *map(repeat, cell), [10 * studies] * 2, (-1, 1))
            print(*cell, *np.round(np.max(list(shares), axis=0), 1), sep=" | ", flush=True)
        print("\ntrue | seeds | rule", claims, sep=" | ")
        for truth, seeds in product((BEST, TABLE1, NOTHING), SEEDS):
            alike = World(RUNS, dict.fromkeys(RUNS["env"], seeds), False, False, SETTINGS)
            for rule, texts in said(truth, alike, studies, pool).items():
                print(truth, seeds, rule, *texts, sep=" | ", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", type=int, nargs="?", default=100)
    parser.add_argument("--worlds", action="store_true", help="of docs/worlds-protocol.md")
    given = parser.parse_args()
    if given.studies < 1:
        sys.exit(f"rule_simulation: {given.studies} should be a number of studies, at least 1")
    main(given.studies, given.worlds)
