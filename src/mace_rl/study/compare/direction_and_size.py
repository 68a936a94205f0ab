"""The second rule of verdicts: direction and size apart (docs/metrics.md, "The second rule")."""

from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import scipy

from mace_rl.study.claims_config import FEWEST_SEEDS, Part
from mace_rl.study.compare import estimates
from mace_rl.study.compare.estimates import LEVEL, Pair, find, pairs_of
from mace_rl.study.compare.ledger import SizedFinding
from mace_rl.study.metrics_config import MetricsConfig

OF_BASELINE = 0.1  # of the episodes that the baseline itself needs: less is not worth mentioning


def find_sized(part: Part, table: pd.DataFrame, settings: MetricsConfig) -> SizedFinding:
    """What is found of one part, before p values are corrected."""
    pairs = pairs_of(part, table, settings)
    found = find(part, pairs, float(np.mean([_margin(pair) for pair in pairs])), settings)
    chance = by_chance(pairs[0].variant - pairs[0].baseline)  # the paper has one environment
    return SizedFinding(
        **asdict(found),
        room=float(np.mean([pair.best - pair.baseline.mean() for pair in pairs])),
        predicted_low=found.in_paper - chance,
        predicted_high=found.in_paper + chance,
    )


def decided(part: SizedFinding) -> SizedFinding:
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
    quantile = scipy.special.stdtrit(seeds - 1, (1 + estimates.CONFIDENCE) / 2)
    return float(quantile * np.std(differences, ddof=1) * np.sqrt(1 + 1 / seeds))


def _margin(pair: Pair) -> float:
    """The smallest difference worth mentioning."""
    if pair.resolution:
        return max(-OF_BASELINE * pair.baseline.mean(), pair.resolution)
    return estimates.WORTH_MENTIONING * pair.everything


def _replication(part: SizedFinding) -> str:
    """Whether the paper's difference goes with ours; empty where it has none."""
    if np.isnan(part.in_paper):
        return ""
    if part.low <= part.in_paper <= part.high:
        return "agrees"
    near = part.predicted_low <= part.difference <= part.predicted_high
    return "within one seed's chance" if near else "disagrees"
