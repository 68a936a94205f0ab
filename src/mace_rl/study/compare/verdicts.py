"""Does what the paper claims hold, and what of our own questions? The rule is in docs/protocol.md.

A part of a claim, a comparison of two variants, is shown, reversed, absent or open; of these comes
the verdict on the claim.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd
import scipy

from mace_rl.runs.records import RecordError
from mace_rl.study.claims_config import CORRELATION, Claim, Family, Part
from mace_rl.study.compare.statistics import (
    equivalence,
    holm,
    probability_of_improvement,
    stratified_comparison,
)
from mace_rl.study.measure.metrics import Metric, all_metrics
from mace_rl.study.metrics_config import MetricsConfig
from mace_rl.study.paper import FIXED, FULL, PAPER_METRICS, PAPER_TABLE1, PPO, VARIANTS

CONFIDENCE = 0.95  # of the intervals, whatever those of the tables have
LEVEL = 0.05  # of the corrected p values
WORTH_MENTIONING = 0.05  # of everything: of E, of reference - random, of a correlation of 1
FEWEST_SEEDS = 10  # with fewer nothing is decided: that would be an anecdote
POWER = 0.8  # of the smallest difference that could have been shown, before correction


@dataclass
class Finding:
    """What was found of one part; differences count in the claim's favour."""

    environments: tuple[str, ...]
    metric: str
    variant: str
    baseline: str | None
    unit: str  # episodes, return, correlation, or a share of everything
    seeds: int  # in the environment that has fewest
    difference: float
    low: float
    high: float
    p_value: float
    probability: float  # that a run of the variant is better than one of the baseline
    probability_low: float
    probability_high: float
    detectable: float  # what these seeds show with a power of `POWER`, before correction
    worth_mentioning: float
    in_paper: float  # the same difference in the paper's Table 1; NaN where that has none
    p_equivalent: float  # that the difference is not smaller than what is worth mentioning
    p_holm: float = np.nan
    p_equivalent_holm: float = np.nan
    outcome: str = ""  # shown, reversed, absent or open


def ledger(
    table: pd.DataFrame, settings: MetricsConfig, families: Sequence[Family]
) -> list[dict[str, Any]]:
    """A record per claim: statement, what the paper's table says, verdicts and `Finding`s.

    table: the frame of metrics.csv with a column `CORRELATION`, and with the families' environments
    and variants; seeds may differ between environments, not between variants. Of one seed there are
    no intervals and no tests: NaN.
    """
    return list(chain.from_iterable(_answers(table, settings, family) for family in families))


def _answers(table: pd.DataFrame, settings: MetricsConfig, family: Family) -> list[dict[str, Any]]:
    """The records of one family."""
    records: list[dict[str, Any]] = [
        {"family": family.title, "claim": claim.name, "statement": claim.statement}
        | {"paper": _paper(claim)}
        for claim in family.claims
    ]
    for how in family.claims[0].parts:
        found = [
            [_find(part, claim, table, settings) for part in claim.parts[how]]
            for claim in family.claims
        ]
        _judge(list(chain.from_iterable(found)))
        for record, findings in zip(records, found, strict=True):
            answer = verdict([finding.outcome for finding in findings])
            parts = [_record(finding) for finding in findings]
            record[how] = {"outcome": answer, "verdict": family.words[answer], "parts": parts}
    return records


def _record(finding: Finding) -> dict[str, Any]:
    """A finding for JSON, which has no NaN."""
    values = asdict(finding)
    return {key: None if value != value else value for key, value in values.items()}


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


def _judge(findings: list[Finding]) -> None:
    """Correct the p values of all parts together, and say what each came out as.

    Those for a difference and those against one are corrected apart. A part that one seed leaves
    without a p value counts as one of 1.
    """
    different = _corrected([finding.p_value for finding in findings])
    equivalent = _corrected([finding.p_equivalent for finding in findings])
    for finding, *p_values in zip(findings, different, equivalent, strict=True):
        finding.p_holm, finding.p_equivalent_holm = p_values
        finding.outcome = outcome(finding)


def _corrected(p_values: Sequence[float]) -> list[float]:
    """Holm's p values; NaN where there was none."""
    adjusted = holm([1.0 if np.isnan(p) else p for p in p_values])
    return [p if np.isnan(p) else float(q) for p, q in zip(p_values, adjusted, strict=True)]


def _find(part: Part, claim: Claim, table: pd.DataFrame, settings: MetricsConfig) -> Finding:
    """Estimates and tests of one part of a claim."""
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
        *part,
        unit,
        min(len(difference) for difference in differences),
        *(difference, low, high, p_value),
        *(chance, lowest, highest),
        _detectable(differences),
        margin,
        _in_paper(part, claim) if unit == "episodes" else np.nan,
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


def _in_paper(part: Part, claim: Claim) -> float:
    """By how many episodes the variant is earlier than the baseline in the paper's Table 1."""
    if claim.paper is None or part.baseline is None:
        return np.nan
    environment, column = claim.paper
    variant, baseline = (
        PAPER_TABLE1[environment, name][column] for name in (part.variant, part.baseline)
    )
    return float(baseline - variant)


def _paper(claim: Claim) -> str:
    """What the paper's own table says of a claim; empty where it says nothing."""
    if claim.paper is None:
        return ""
    environment, column = claim.paper
    values = {name: PAPER_TABLE1[environment, name][column] for name in VARIANTS}
    first = min(values, key=values.__getitem__)
    names = {PPO: "PPO", FIXED: "fixed", FULL: "full"}
    numbers = ", ".join(f"{names[name]} {value}" for name, value in values.items())
    return f"{PAPER_METRICS[column]}: {numbers}; the best is {names[first]}"
