"""Do claims hold? By the rule of docs/metrics.md: direction and size apart."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import pandas as pd
import scipy

from mace_study.compare.claims_config import (
    FEWEST_SEEDS,
    ClaimConfig,
    ClaimsConfig,
    Part,
    Table1Config,
)
from mace_study.compare.estimates import (
    CONFIDENCE,
    LEVEL,
    WORTH_MENTIONING,
    Pair,
    find,
    pairs_of,
)
from mace_study.compare.ledger import Answer, Finding, Judgement
from mace_study.compare.statistics import holm
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import metric_units

OF_BASELINE = 0.1  # of the episodes that the baseline itself needs: less is not worth mentioning


def ledger(table: pd.DataFrame, settings: MetricsConfig, claims: ClaimsConfig) -> list[Answer]:
    """An answer to each claim that the runs in `table` can answer.

    table: the frame of metrics.csv with the `CORRELATIONS` asked for; seeds may differ between
    environments, not between variants.
    """
    runs = table.groupby("env")["variant"].unique()
    lacking = claims.lacking({str(env): list(own) for env, own in runs.items()}, settings)
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
        findings = iter(judge(every, table, settings))
        for name, own in parts.items():
            found = [next(findings) for _ in own]
            answer = verdict([finding.outcome for finding in found])
            judged[name][how] = Judgement(answer, words[answer], found)
    for name, claim in family.claims.items():
        paper = _in_paper(claim, table1, settings)
        yield Answer(title, name, claim.statement, paper, judged[name])


def judge(parts: Sequence[Part], table: pd.DataFrame, settings: MetricsConfig) -> list[Finding]:
    """What each part came out as; p values of either kind are corrected for all parts."""
    findings = [find_sized(part, table, settings) for part in parts]
    different = _corrected([finding.p_value for finding in findings])
    equivalent = _corrected([finding.p_equivalent for finding in findings])
    return [
        decided(replace(finding, p_holm=p, p_equivalent_holm=q))
        for finding, p, q in zip(findings, different, equivalent, strict=True)
    ]


def verdict(outcomes: Sequence[str]) -> str:
    """A claim's outcome, from its parts'; in their words."""
    found = set(outcomes)
    if found == {"shown"}:
        return "shown"
    if "reversed" in found and "shown" not in found:
        return "reversed"
    if found & {"reversed", "absent"}:
        return "absent"
    return "open" if "open" in found else "no_room"


def find_sized(part: Part, table: pd.DataFrame, settings: MetricsConfig) -> Finding:
    """What is found of one part, before p values are corrected."""
    pairs = pairs_of(part, table, settings)
    found = find(part, pairs, float(np.mean([_margin(pair) for pair in pairs])), settings)
    chance = by_chance(pairs[0].variant - pairs[0].baseline)  # the paper has one environment
    return replace(
        found,
        room=float(np.mean([pair.best - pair.baseline.mean() for pair in pairs])),
        predicted_low=found.in_paper - chance,
        predicted_high=found.in_paper + chance,
    )


def decided(part: Finding) -> Finding:
    """A part whose p values are corrected, with what the rule says of it."""
    if part.seeds < FEWEST_SEEDS:
        return replace(part, outcome="open", size="open")
    size = "small" if max(-part.low, part.high) < part.worth_mentioning else "open"
    if max(part.low, -part.high) > part.worth_mentioning:
        size = "worth mentioning"
    outcome = "open"
    if part.p_holm < LEVEL:
        outcome = "shown" if part.difference > 0 else "reversed"
    elif not part.has_room:
        outcome = "no_room"
    elif size == "small" and part.p_equivalent_holm < LEVEL:
        outcome = "absent"
    return replace(part, outcome=outcome, size=size, replication=_replication(part))


def by_chance(differences: np.ndarray) -> float:
    """Half a prediction interval for the difference of one run each; NaN with one seed.

    Such a difference varies by our σ², our mean of n by σ² / n (Spence and Stanley 2016; Patil,
    Peng and Leek 2016).
    """
    seeds = len(differences)
    if seeds == 1:
        return np.nan
    quantile = scipy.special.stdtrit(seeds - 1, (1 + CONFIDENCE) / 2)
    return float(quantile * np.std(differences, ddof=1) * np.sqrt(1 + 1 / seeds))


def _margin(pair: Pair) -> float:
    """The smallest difference worth mentioning."""
    if pair.resolution:
        return max(-OF_BASELINE * pair.baseline.mean(), pair.resolution)
    return WORTH_MENTIONING * pair.everything


def _replication(part: Finding) -> str:
    """Whether the paper's difference goes with ours; empty where it has none."""
    if np.isnan(part.in_paper):
        return ""
    if part.low <= part.in_paper <= part.high:
        return "agrees"
    near = part.predicted_low <= part.difference <= part.predicted_high
    return "within one seed's chance" if near else "disagrees"


def _corrected(p_values: Sequence[float]) -> list[float]:
    """Holm's p values; NaN where there was none, because of one seed, which counts as 1."""
    adjusted = holm([1.0 if np.isnan(p) else p for p in p_values])
    return [p if np.isnan(p) else float(q) for p, q in zip(p_values, adjusted, strict=True)]


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
