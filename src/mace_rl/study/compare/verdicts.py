"""Do claims hold? By the first rule (docs/protocol.md) or the second (`direction_and_size`)."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from mace_rl.study.claims_config import FEWEST_SEEDS, ClaimConfig, ClaimsConfig, Part, Table1Config
from mace_rl.study.compare import direction_and_size
from mace_rl.study.compare.estimates import LEVEL, WORTH_MENTIONING, find, pairs_of
from mace_rl.study.compare.ledger import Answer, Finding, Judgement
from mace_rl.study.compare.statistics import holm
from mace_rl.study.measure.metrics import metric_units
from mace_rl.study.metrics_config import MetricsConfig


def ledger(table: pd.DataFrame, settings: MetricsConfig, claims: ClaimsConfig) -> list[Answer]:
    """An answer to each claim that the runs in `table` can answer.

    table: the frame of metrics.csv with the `CORRELATIONS` asked for; seeds may differ between
    environments, not between variants.
    """
    lacking = claims.lacking(table["env"], table["variant"], settings)
    asked = [title for title in claims.families if not lacking[title]]
    return [answer for title in asked for answer in _answers(title, claims, table, settings)]


def _answers(
    title: str, claims: ClaimsConfig, table: pd.DataFrame, settings: MetricsConfig
) -> Iterator[Answer]:
    """The answers to the claims of one family."""
    family, table1 = claims.families[title], claims.table1
    words = family.words.model_dump()
    judged: dict[str, dict[str, Judgement]] = {name: {} for name in family.claims}
    for how in family.ways:
        parts = {
            name: [part for several in claim.parts[how] for part in several.each(table1)]
            for name, claim in family.claims.items()
        }
        every = list(chain.from_iterable(parts.values()))
        findings = iter(judge(every, table, settings, claims.rule))
        for name, own in parts.items():
            found = [next(findings) for _ in own]
            outcomes = [finding.outcome for finding in found]
            answer = verdict(outcomes)
            if answer == "open" and "no_room" in outcomes and not any(p.has_room for p in found):
                answer = "no_room"
            judged[name][how] = Judgement(answer, words[answer], found)
    for name, claim in family.claims.items():
        paper = _in_paper(claim, table1, settings)
        yield Answer(title, name, claim.statement, paper, judged[name])


def judge(
    parts: Sequence[Part], table: pd.DataFrame, settings: MetricsConfig, rule: int
) -> list[Any]:
    """What each part came out as; p values of either kind are corrected for all parts."""
    find_by_rule, decided = RULES[rule]
    findings = [find_by_rule(part, table, settings) for part in parts]
    different = _corrected([finding.p_value for finding in findings])
    equivalent = _corrected([finding.p_equivalent for finding in findings])
    return [
        decided(replace(finding, p_holm=p, p_equivalent_holm=q))
        for finding, p, q in zip(findings, different, equivalent, strict=True)
    ]


def verdict(outcomes: Sequence[str]) -> str:
    """Of a claim, from what its parts came out as; in the words of parts."""
    found = set(outcomes)
    if found == {"shown"}:
        return "shown"
    if "reversed" in found and "shown" not in found:
        return "reversed"
    return "absent" if found & {"reversed", "absent"} else "open"


def outcome(finding: Finding) -> str:
    """Of one part, whose p values are corrected."""
    if finding.seeds >= FEWEST_SEEDS and finding.p_equivalent_holm < LEVEL:
        return "absent"
    if finding.seeds >= FEWEST_SEEDS and finding.p_holm < LEVEL:
        return "shown" if finding.difference > 0 else "reversed"
    return "open"


def _corrected(p_values: Sequence[float]) -> list[float]:
    """Holm's p values; NaN where there was none, because of one seed, which counts as 1."""
    adjusted = holm([1.0 if np.isnan(p) else p for p in p_values])
    return [p if np.isnan(p) else float(q) for p, q in zip(p_values, adjusted, strict=True)]


def _find(part: Part, table: pd.DataFrame, settings: MetricsConfig) -> Finding:
    """Estimates and tests of one part, with the protocol's margin."""
    pairs = pairs_of(part, table, settings)
    return find(part, pairs, WORTH_MENTIONING * pairs[0].everything, settings)


# What a rule finds of a part, and what it makes of that when all p values are corrected.
RULES: dict[int, tuple[Callable[..., Any], Callable[..., Any]]] = {
    1: (_find, lambda finding: replace(finding, outcome=outcome(finding))),
    2: (direction_and_size.find_sized, direction_and_size.decided),
}


def _in_paper(claim: ClaimConfig, table1: Table1Config, settings: MetricsConfig) -> str:
    """What the paper's own table says of a claim's first part; empty where it says nothing."""
    part = next(iter(claim.parts.values()))[0].each(table1)[0]
    values = table1.values_of(part.environments, part.metric)
    if not values:
        return ""
    lower = metric_units(settings)[part.metric] == "episodes"
    best = (min if lower else max)(values, key=values.__getitem__)
    metric = table1.metric_of(part.metric)
    numbers = ", ".join(f"{table1.variants[name]} {value}" for name, value in values.items())
    return f"{metric}: {numbers}; the best is {table1.variants[best]}"
