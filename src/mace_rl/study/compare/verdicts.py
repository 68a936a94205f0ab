"""Do claims hold? The rule is in docs/protocol.md, the claims are in a file: `claims_config`.

A part of a claim, a comparison of two variants, is shown, reversed, absent or open; of these comes
the verdict on the claim.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import pandas as pd
import scipy

from mace_rl.records import RecordError
from mace_rl.study.claims_config import ClaimConfig, ClaimsConfig, FamilyConfig, Part, Table1Config
from mace_rl.study.compare.ledger import Answer, Finding, Judgement
from mace_rl.study.compare.statistics import (
    equivalence,
    holm,
    probability_of_improvement,
    stratified_comparison,
)
from mace_rl.study.measure.metrics import CORRELATION, Metric, all_metrics
from mace_rl.study.metrics_config import MetricsConfig

CONFIDENCE = 0.95  # of the intervals, whatever those of the tables have
LEVEL = 0.05  # of the corrected p values
WORTH_MENTIONING = 0.05  # of everything: of E, of reference - random, of a correlation of 1
FEWEST_SEEDS = 10  # with fewer nothing is decided: that would be an anecdote
POWER = 0.8  # of the smallest difference that could have been shown, before correction


def ledger(table: pd.DataFrame, settings: MetricsConfig, claims: ClaimsConfig) -> list[Answer]:
    """An answer to each claim that the runs in `table` can answer.

    table: the frame of metrics.csv with a column `CORRELATION`; seeds may differ between
    environments, not between variants. Of one seed there are no intervals and no tests: NaN.
    """
    lacking = claims.lacking(table["env"], table["variant"], settings)
    return [
        answer
        for title, family in claims.families.items()
        if not lacking[title]
        for answer in _answers(title, family, claims.table1, table, settings)
    ]


def _answers(
    title: str,
    family: FamilyConfig,
    table1: Table1Config,
    table: pd.DataFrame,
    settings: MetricsConfig,
) -> Iterator[Answer]:
    """The answers to the claims of one family."""
    words = family.words.model_dump()
    judged: dict[str, dict[str, Judgement]] = {name: {} for name in family.claims}
    for how in family.ways:
        parts = {
            name: [part for several in claim.parts[how] for part in several.each(table1)]
            for name, claim in family.claims.items()
        }
        findings = iter(judge(list(chain.from_iterable(parts.values())), table, settings))
        for name, own in parts.items():
            found = [next(findings) for _ in own]
            answer = verdict([finding.outcome for finding in found])
            judged[name][how] = Judgement(answer, words[answer], found)
    for name, claim in family.claims.items():
        paper = _in_paper(claim, table1, settings)
        yield Answer(title, name, claim.statement, paper, judged[name])


def judge(parts: Sequence[Part], table: pd.DataFrame, settings: MetricsConfig) -> list[Finding]:
    """The rule: what each part came out as, their p values corrected together.

    Those for a difference and those against one are corrected apart. A part that one seed leaves
    without a p value counts as one of 1.
    """
    findings = [_find(part, table, settings) for part in parts]
    different = _corrected([finding.p_value for finding in findings])
    equivalent = _corrected([finding.p_equivalent for finding in findings])
    corrected = [
        replace(finding, p_holm=p, p_equivalent_holm=q)
        for finding, p, q in zip(findings, different, equivalent, strict=True)
    ]
    return [replace(finding, outcome=outcome(finding)) for finding in corrected]


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
    if finding.seeds < FEWEST_SEEDS:
        return "open"
    if finding.p_equivalent_holm < LEVEL:
        return "absent"
    if finding.p_holm < LEVEL:
        return "shown" if finding.difference > 0 else "reversed"
    return "open"


def _corrected(p_values: Sequence[float]) -> list[float]:
    """Holm's p values; NaN where there was none."""
    adjusted = holm([1.0 if np.isnan(p) else p for p in p_values])
    return [p if np.isnan(p) else float(q) for p, q in zip(p_values, adjusted, strict=True)]


def _find(part: Part, table: pd.DataFrame, settings: MetricsConfig) -> Finding:
    """Estimates and tests of one part."""
    metrics = {metric.name: metric for metric in all_metrics(settings)}
    both = table[table["variant"].isin([part.variant, part.baseline])]
    runs = {env: both[both["env"] == env] for env in part.environments}
    pairs = [_pair(part, own, metrics) for own in runs.values()]
    everything = [_everything(part, own, env, metrics, settings) for env, own in runs.items()]
    unit: str = metrics[part.metric].unit if part.metric in metrics else "correlation"
    if len(pairs) > 1:
        pairs = [(x / all_, y / all_) for (x, y), all_ in zip(pairs, everything, strict=True)]
        everything, unit = [1.0], "share of everything"
    differences = [x - y for x, y in pairs]
    how = CONFIDENCE, settings.bootstrap_repetitions
    seed, columns = settings.bootstrap_seed, [(x[:, None], y[:, None]) for x, y in pairs]
    compared = stratified_comparison(differences, *how, np.random.default_rng(seed))
    difference, low, high, p_value = map(float, compared)
    improved = probability_of_improvement(columns, *how, np.random.default_rng(seed))
    chance, lowest, highest = (bound.item() for bound in improved)
    margin = WORTH_MENTIONING * everything[0]
    flips = settings.bootstrap_repetitions, np.random.default_rng(seed)
    return Finding(
        *part[:4],
        unit,
        min(len(difference) for difference in differences),
        *(difference, low, high, p_value),
        *(chance, lowest, highest),
        _detectable(differences),
        margin,
        -part.in_paper if unit == "episodes" else part.in_paper,
        equivalence(differences, margin, *flips),
    )


def _pair(
    part: Part, runs: pd.DataFrame, metrics: Mapping[str, Metric]
) -> tuple[np.ndarray, np.ndarray]:
    """The metric of both variants, [seeds] each, in the order of seeds; greater is better.

    runs: those of both in one environment. Episodes beyond the shorter budget count as it. Raises
    `RecordError` for a seed that one of the two lacks.
    """
    episodes = part.metric in metrics and metrics[part.metric].unit == "episodes"
    wide = runs.pivot(index="seed", columns="variant", values=part.metric).astype(np.float64)
    lacking = wide.isna().to_numpy()
    if lacking.any():
        row, column = np.argwhere(lacking)[0]
        run = f"{runs['env'].iloc[0]}, {wide.columns[column]}, seed {wide.index[row]}"
        raise RecordError(f"{run}: there is no {part.metric}")
    if episodes:
        wide = wide.clip(upper=runs["episodes"].min())
    variant = wide[part.variant].to_numpy()
    baseline = wide[part.baseline].to_numpy() if part.baseline else np.zeros_like(variant)
    return (-variant, -baseline) if episodes else (variant, baseline)


def _everything(
    part: Part,
    runs: pd.DataFrame,
    environment: str,
    metrics: Mapping[str, Metric],
    settings: MetricsConfig,
) -> float:
    """All that a difference could be between these runs of the part's variants."""
    if part.metric == CORRELATION:
        return 1.0
    if metrics[part.metric].unit == "episodes":
        return float(runs["episodes"].min())
    return settings.reference_return[environment] - settings.random_return_in(environment)


def _detectable(differences: Sequence[np.ndarray]) -> float:
    """The smallest mean difference that is significant with a probability of `POWER`."""
    if min(len(values) for values in differences) == 1:
        return np.nan
    freedom = sum(len(values) - 1 for values in differences)
    variances = [np.var(values, ddof=1) / len(values) for values in differences]
    error = np.sqrt(np.sum(variances)) / len(differences)
    quantiles = scipy.special.stdtrit(freedom, [(1 + CONFIDENCE) / 2, POWER])
    return float(quantiles.sum() * error)


def _in_paper(claim: ClaimConfig, table1: Table1Config, settings: MetricsConfig) -> str:
    """What the paper's own table says of a claim's first part; empty where it says nothing."""
    part = next(iter(claim.parts.values()))[0].each(table1)[0]
    values = table1.values_of(part.environments, part.metric)
    if not values:
        return ""
    units = {one.name: one.unit for one in all_metrics(settings)}
    best = (min if units[part.metric] == "episodes" else max)(values, key=values.__getitem__)
    metric = next(one for one in table1.metrics if part.metric.startswith(one))
    numbers = ", ".join(f"{table1.variants[name]} {value}" for name, value in values.items())
    return f"{metric}: {numbers}; the best is {table1.variants[best]}"
