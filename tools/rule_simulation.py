"""What do both rules of verdicts say where the truth is known? By simulation (docs/metrics.md).

    python -m tools.rule_simulation [STUDIES]

Of 10 · STUDIES parts whose difference is the margin, how many in % are absent, by more and more of
the rule; then, of STUDIES (100) drawn from the runs of reference/tables/study, what they say, in %.
"""

import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from itertools import product, repeat
from pathlib import Path

import numpy as np
import pandas as pd

from mace_rl.config.reading import read_yaml
from mace_rl.study.claims_config import ClaimsConfig, Part, parts_of
from mace_rl.study.compare.direction_and_size import decided
from mace_rl.study.compare.estimates import LEVEL, Pair, find, pairs_of
from mace_rl.study.compare.ledger import SizedFinding
from mace_rl.study.compare.verdicts import ledger
from mace_rl.study.config import read_study
from mace_rl.study.measure.betas import BEFORE, CORRELATION, CORRELATIONS
from mace_rl.study.measure.metrics import METRICS

SETTINGS = read_study([Path("config.yaml"), Path("config/study.yaml")]).metrics
SETTINGS = SETTINGS.model_copy(update={"bootstrap_repetitions": 1000})  # for the time
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


def study(truth: str, seeds: int, draws: np.random.Generator) -> pd.DataFrame:
    """The metrics of a study in which that is true, of runs drawn with replacement."""
    drawn = []
    for cell, own in RUNS.groupby(["env", "variant"], sort=False):
        (env, variant), budget = map(str, cell), own["episodes"].min()
        pool = RUNS[RUNS["env"] == env] if truth == NOTHING else own
        new = pool.sample(seeds, replace=True, random_state=draws)
        new = new.assign(variant=variant, seed=range(seeds))
        for metric in new.columns.intersection([*CORRELATIONS, *EPISODES]):
            value = CLAIMS[1].table1.values_of([env], metric).get(variant)
            if truth == NOTHING and metric in CORRELATIONS:
                chosen = own[metric].sample(seeds, replace=True, random_state=draws)
                new[metric] = (chosen - own[metric].mean()).to_numpy()
            elif truth == TABLE1 and value is not None:
                first = EPISODES[metric].earliest(SETTINGS.moving_average, budget)
                new[metric] = (new[metric] - own[metric].mean() + value).clip(first, budget)
        drawn.append(new)
    table = pd.concat(drawn, ignore_index=True)
    for env, metric, variant in CELLS if truth == BEST else ():
        best = pairs_of(Part((env,), metric, variant, None, 0.0), table, SETTINGS)[0].best
        better = (table["env"] == env) & (table["variant"] == variant)
        table.loc[better, metric] = -best if metric in EPISODES else best
    return table


def outcomes(truth: str, seeds: int, number: int) -> list[list[str]]:
    """Of one study, each claim's by each rule."""
    table = study(truth, seeds, np.random.default_rng([seeds, number]))
    answers = [ledger(table, SETTINGS, claims) for claims in CLAIMS.values()]
    return [[answer.ways[WAY].outcome for answer in own] for own in answers]


def main(studies: int) -> None:
    with ProcessPoolExecutor() as pool:
        print("differences | seeds | test alone | and the interval | and Holm")
        for cell in product(SPREADS, SEEDS):
            shares = pool.map(absences, *map(repeat, cell), [10 * studies] * 2, (-1, 1))
            print(*cell, *np.round(np.max(list(shares), axis=0), 1), sep=" | ", flush=True)
        print("\ntrue | seeds | rule", *(f"C{number}" for number in range(1, 11)), sep=" | ")
        for truth, seeds in product((BEST, TABLE1, NOTHING), SEEDS):
            found = np.array(list(pool.map(outcomes, repeat(truth), repeat(seeds), range(studies))))
            for rule, claims in zip(CLAIMS, found.transpose(1, 2, 0).tolist(), strict=True):
                counts = [Counter(SAID[one] for one in own).most_common() for own in claims]
                said = [", ".join(f"{k} {100 * n / studies:.0f}" for k, n in own) for own in counts]
                print(truth, seeds, rule, *said, sep=" | ", flush=True)


if __name__ == "__main__":
    if not (given := " ".join(sys.argv[1:]) or "100").isdecimal() or not int(given):
        sys.exit(f"rule_simulation: {given!r} should be one number of studies, at least 1")
    main(int(given))
