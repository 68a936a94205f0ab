"""Does what the paper claims hold? A verdict for each claim by the rule in docs/method.md.

A claim is made of parts, each a comparison of two variants; a part holds, fails or is open, and the
claim is reproduced, contradicted or inconclusive. docs/method.md has the rule, and what was known
when it was written.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy

from mace_rl.config.results import MetricsConfig
from mace_rl.results.metrics import Metric, all_metrics
from mace_rl.results.paper import (
    ACROBOT,
    CARTPOLE,
    ENVIRONMENTS,
    FIXED,
    FULL,
    HOPPER,
    PAPER_METRICS,
    PAPER_TABLE1,
    PPO,
    VARIANTS,
)
from mace_rl.results.statistics import (
    holm,
    probability_of_improvement,
    stratified_comparison,
)

CORRELATION = "stagnation_correlation"  # of betas.csv; over 0
CONFIDENCE = 0.95  # of the intervals, whatever those of the tables have
LEVEL = 0.05  # of the corrected p values
WORTH_MENTIONING = 0.05  # of everything: of E, of reference - random, of a correlation of 1
FEWEST_SEEDS = 10  # with fewer nothing is decided: that would be an anecdote
POWER = 0.8  # of the smallest difference that could have been shown, before correction

LITERAL, ROBUST = "by the paper's words and code", "robust"
VERDICTS = ("reproduced", "contradicted", "inconclusive")


class Part(NamedTuple):
    """In these environments, on this metric: `variant` is better than `baseline`."""

    environments: tuple[str, ...]  # of several the mean of the differences, as shares of everything
    metric: str
    variant: str
    baseline: str | None  # None: over 0


@dataclass(frozen=True)
class Claim:
    """What the paper says, and of which parts that is made, by how it is measured."""

    name: str
    statement: str
    parts: Mapping[str, tuple[Part, ...]]
    paper: tuple[str, int] | None = None  # the environment and column of the paper's Table 1


def _over_both(variant: str, metric: str, *environments: str) -> tuple[Part, ...]:
    """`variant` over the two others, in each environment."""
    others = [name for name in VARIANTS if name != variant]
    return tuple(Part((env,), metric, variant, other) for env in environments for other in others)


def _speed(name: str, environment: str, statement: str, column: int) -> Claim:
    """A claim that full is the first in a column of the paper's Table 1."""
    names = [
        ("sample_efficiency", "sample_efficiency_common"),
        ("convergence_steps_public_code", "convergence_steps"),
    ][column]
    literal, robust = (_over_both(FULL, metric, environment) for metric in names)
    return Claim(name, statement, {LITERAL: literal, ROBUST: robust}, (environment, column))


def _same(parts: tuple[Part, ...]) -> dict[str, tuple[Part, ...]]:
    return {LITERAL: parts, ROBUST: parts}


CLAIMS = (
    _speed("C1", ACROBOT, "Acrobot: the learned β has the best sample efficiency", 0),
    _speed("C2", ACROBOT, "Acrobot: the learned β converges first", 1),
    _speed("C3", HOPPER, "Hopper: the learned β has the best sample efficiency", 0),
    _speed("C4", HOPPER, "Hopper: the learned β converges first", 1),
    _speed("C5", CARTPOLE, "CartPole: the learned β has the best sample efficiency", 0),
    Claim(
        "C6",
        "CartPole: the fixed β converges first and ends slightly above the learned one",
        {
            how: (
                *_over_both(FIXED, metric, CARTPOLE),
                Part((CARTPOLE,), "final_return", FIXED, FULL),
            )
            for how, metric in (
                (LITERAL, "convergence_steps_public_code"),
                (ROBUST, "convergence_steps"),
            )
        },
        (CARTPOLE, 1),
    ),
    Claim(
        "C7",
        "Acrobot and Hopper: the learned β ends above both others",
        _same(_over_both(FULL, "final_return", ACROBOT, HOPPER)),
    ),
    Claim(
        "C8",
        "Over all environments the learned β outperforms both others",
        {
            how: tuple(Part(ENVIRONMENTS, metric, FULL, other) for other in (PPO, FIXED))
            for how, metric in ((LITERAL, "sample_efficiency"), (ROBUST, "area_under_curve"))
        },
    ),
    Claim(
        "C9",
        "β rises when progress stalls and falls when learning advances",
        _same(tuple(Part((env,), CORRELATION, FULL, None) for env in ENVIRONMENTS)),
    ),
    Claim(
        "C10",
        "CartPole: the learned β has the steepest initial curve",
        _same(_over_both(FULL, "early_return", CARTPOLE)),
    ),
)


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
    p_holm: float = np.nan
    outcome: str = ""  # holds, fails or open


def ledger(table: pd.DataFrame, settings: MetricsConfig) -> list[dict[str, Any]]:
    """A record per claim: statement, what the paper's table says, verdicts and `Finding`s.

    table: the frame of metrics.csv with a column `CORRELATION`, and with the paper's environments
    and variants; seeds may differ between environments, not between variants. Of one seed there are
    no intervals and no tests: NaN.
    """
    found = {
        how: [
            [_find(part, claim, table, settings) for part in claim.parts[how]] for claim in CLAIMS
        ]
        for how in (LITERAL, ROBUST)
    }
    for of_claims in found.values():
        _judge(list(chain.from_iterable(of_claims)))
    return [
        {"claim": claim.name, "statement": claim.statement, "paper": _paper(claim)}
        | {
            how: {
                "verdict": verdict([finding.outcome for finding in of_claims[number]]),
                "parts": [_record(finding) for finding in of_claims[number]],
            }
            for how, of_claims in found.items()
        }
        for number, claim in enumerate(CLAIMS)
    ]


def _record(finding: Finding) -> dict[str, Any]:
    """A finding for JSON, which has no NaN."""
    values = asdict(finding)
    return {key: None if value != value else value for key, value in values.items()}


def verdict(outcomes: Sequence[str]) -> str:
    """Of a claim, from what its parts came out as."""
    if "fails" in outcomes:
        return "contradicted"
    return "reproduced" if set(outcomes) == {"holds"} else "inconclusive"


def outcome(finding: Finding) -> str:
    """Of one part, whose `p_holm` is known."""
    if finding.seeds < FEWEST_SEEDS:
        return "open"
    if finding.p_holm < LEVEL:
        return "holds" if finding.difference > 0 else "fails"
    return "fails" if finding.high < finding.worth_mentioning else "open"


def _judge(findings: list[Finding]) -> None:
    """Correct the p values of all parts together, and say what each came out as.

    A part that one seed leaves without a p value counts as one of 1.
    """
    p_values = np.array([finding.p_value for finding in findings])
    untested = np.isnan(p_values)
    corrected = np.where(untested, np.nan, holm(np.where(untested, 1.0, p_values).tolist()))
    for finding, p_holm in zip(findings, corrected, strict=True):
        finding.p_holm = float(p_holm)
        finding.outcome = outcome(finding)


def _find(part: Part, claim: Claim, table: pd.DataFrame, settings: MetricsConfig) -> Finding:
    """Estimates and test of one part of a claim."""
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
    return Finding(
        *part,
        unit,
        min(len(difference) for difference in differences),
        *(difference, low, high, p_value),
        *(chance, lowest, highest),
        _detectable(differences),
        WORTH_MENTIONING * everything[0],
        _in_paper(part, claim) if unit == "episodes" else np.nan,
    )


def _pair(
    part: Part, runs: pd.DataFrame, metrics: Mapping[str, Metric]
) -> tuple[np.ndarray, np.ndarray]:
    """The metric of both variants, [seeds] each, in the order of seeds; greater is better.

    runs: those of both in one environment. Episodes beyond the shorter budget count as it.
    """
    episodes = part.metric in metrics and metrics[part.metric].unit == "episodes"
    wide = runs.pivot(index="seed", columns="variant", values=part.metric).astype(np.float64)
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
