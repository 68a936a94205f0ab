"""The second rule of verdicts: direction and size apart (docs/metrics.md, "The second rule").

Of each part it says whether there is a difference, whether it is worth mentioning, how it goes with
the paper's own, and whether there was room for one.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import scipy

from mace_rl.study.claims_config import Part
from mace_rl.study.compare.estimates import (
    CONFIDENCE,
    FEWEST_SEEDS,
    LEVEL,
    WORTH_MENTIONING,
    Pair,
    find,
    pairs_of,
)
from mace_rl.study.compare.ledger import SizedFinding
from mace_rl.study.metrics_config import MetricsConfig

OF_BASELINE = 0.1  # of the episodes that the baseline itself needs: less is not worth mentioning


def find_sized(part: Part, table: pd.DataFrame, settings: MetricsConfig) -> SizedFinding:
    """What is found of one part, before p values are corrected."""
    pairs = pairs_of(part, table, settings)
    found = find(part, pairs, float(np.mean([_margin(pair) for pair in pairs])), settings)
    chance = _prediction(pairs[0].variant - pairs[0].baseline)  # the paper has one environment
    return SizedFinding(
        **asdict(found),
        room=float(np.mean([pair.best - pair.baseline.mean() for pair in pairs])),
        predicted_low=found.in_paper - chance,
        predicted_high=found.in_paper + chance,
    )


def verdict(parts: Sequence[SizedFinding]) -> str:
    """Of a claim, from its parts; in the words of parts."""
    found = {part.outcome for part in parts}
    if found == {"shown"}:
        return "shown"
    if "reversed" in found and "shown" not in found:
        return "reversed"
    if found & {"reversed", "absent"}:
        return "absent"
    return "open" if any(part.has_room for part in parts) else "no_room"


def decided(part: SizedFinding) -> SizedFinding:
    """A part whose p values are corrected, with all that the rule says of it."""
    direction, size = _direction(part), _size(part)
    outcome, within = direction, size == "small" and part.p_equivalent_holm < LEVEL
    if direction == "open" and not part.has_room:
        outcome = "no_room"
    elif direction == "open" and within:
        outcome = "absent"
    return replace(
        part, direction=direction, size=size, outcome=outcome, replication=_replication(part)
    )


def _direction(part: SizedFinding) -> str:
    if part.seeds < FEWEST_SEEDS or not part.p_holm < LEVEL:
        return "open"
    return "shown" if part.difference > 0 else "reversed"


def _size(part: SizedFinding) -> str:
    margin = part.worth_mentioning
    if part.seeds >= FEWEST_SEEDS and max(part.low, -part.high) > margin:
        return "worth mentioning"
    if part.seeds >= FEWEST_SEEDS and max(-part.low, part.high) < margin:
        return "small"
    return "open"


def _replication(part: SizedFinding) -> str:
    """Whether the paper's difference can be ours; empty where it has none, or we too few seeds."""
    if np.isnan(part.in_paper) or part.seeds < FEWEST_SEEDS:
        return ""
    if part.low <= part.in_paper <= part.high:
        return "agrees"
    by_chance = part.predicted_low <= part.difference <= part.predicted_high
    return "within one seed's chance" if by_chance else "disagrees"


def _margin(pair: Pair) -> float:
    """The smallest difference worth mentioning."""
    if pair.resolution:
        return max(-OF_BASELINE * pair.baseline.mean(), pair.resolution)
    return WORTH_MENTIONING * pair.everything


def _prediction(differences: np.ndarray) -> float:
    """How far our mean may lie from the difference of one run each, by chance alone.

    Half a prediction interval (Spence and Stanley 2016; Patil, Peng and Leek 2016). The difference
    of one run each has our variance σ² of differences [n], our mean σ² / n: theirs apart has
    σ² (1 + 1 / n). NaN with one seed.
    """
    seeds = len(differences)
    if seeds == 1:
        return np.nan
    quantile = scipy.special.stdtrit(seeds - 1, (1 + CONFIDENCE) / 2)
    return float(quantile * np.std(differences, ddof=1) * np.sqrt(1 + 1 / seeds))
