"""The paper's claims asked of every reading of its learned β: a specification curve.

Simonsohn, Simmons and Nelson 2020: where an analysis has several reasonable forms, show what comes
out in each. reference/readings/protocol.md says which, and by what rule.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mace_rl.base.rng import Streams
from mace_rl.beta.objectives import Perturbed, Progress, Score
from mace_rl.config.beta import MetaBeta, ProgressObjective, ScoreObjective
from mace_rl.config.reading import read_yaml
from mace_rl.config.run import RunConfig
from mace_study.compare.claims_config import ClaimsConfig, PartsConfig, with_learned
from mace_study.compare.verdicts import ledger
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics import CORRELATIONS

MOVES = 0.05  # median standard deviation of the asked β over a training, from which on it moves
STILL, NOT_ASKED = "β does not move", ""


def asked_beta(beta: np.ndarray, config: RunConfig) -> np.ndarray:
    """β as its rule asks for it, without the perturbation that a reading adds to learn by, [E].

    beta: that of a run's episodes.
    """
    generator = Streams(config.seed)["exploration"]
    match config.beta:
        case MetaBeta(objective=ScoreObjective() as settings):
            added = perturbations(Score(settings, generator), len(beta))
        case MetaBeta(objective=ProgressObjective() as settings):
            added = perturbations(Progress(settings, generator), len(beta))
        case _:
            return beta
    return 1 / (1 + np.exp(added - np.log(beta / (1 - beta))))


def perturbations(objective: Perturbed, episodes: int) -> np.ndarray:
    """ξ of each episode, [episodes]; the first one's β is given, and has none."""
    found = np.zeros(episodes)
    for episode in range(1, episodes):
        found[episode] = objective.perturbation
        objective.count_episode()
    return found


def specification(
    table: pd.DataFrame,
    settings: MetricsConfig,
    claims: str | Path,
    deviations: Mapping[str, float],
    how: str,
) -> pd.DataFrame:
    """What comes out of each of the paper's claims with each reading as the learned β.

    table: the frames of metrics.csv and betas.csv of one world, joined; deviations: of each reading
    the median over runs of the standard deviation of its `asked_beta`; how: to measure. A reading's
    whole claims are a family of their own for Holm's correction. Those with parts elsewhere, in
    environments that `table` lacks, are asked of the others, in another.

    Columns: reading, claim, statement, whole, outcome, verdict; without outcome where a claim is
    about a β that `MOVES`, and this does not.
    """
    rows: list[Any] = []
    given = read_yaml(Path(claims))
    for reading, moved in deviations.items():
        everything = with_learned(given, reading, str(claims))
        for whole in (True, False):
            asked = one_way(family_of(everything, set(table["env"]), whole), how)
            for answer in ledger(table, settings, asked):
                judged = answer.ways[how]
                of_beta = any(part.metric in CORRELATIONS for part in judged.parts)
                still = of_beta and moved <= MOVES
                said = (NOT_ASKED, STILL) if still else (judged.outcome, judged.verdict)
                rows.append((reading, answer.claim, answer.statement, whole, *said))
    names = ["reading", "claim", "statement", "whole", "outcome", "verdict"]
    return pd.DataFrame(rows, columns=names)


def in_tasks(
    table: pd.DataFrame,
    settings: MetricsConfig,
    claims: str | Path,
    readings: Iterable[str],
    name: str,
    how: str,
) -> pd.DataFrame:
    """A row for each part of a claim of ours with each reading as the learned β.

    table: as for `specification`; name: of the claim, for each reading a family of its own.
    Columns: claim, reading, over, seeds, difference, low, high, p_holm, outcome; verdict, of all.
    """
    rows: list[Any] = []
    given = read_yaml(Path(claims))
    for reading in readings:
        asked = one_way(alone(with_learned(given, reading, str(claims)), name), how)
        [answer] = ledger(table, settings, asked)
        judged = answer.ways[how]
        for part in judged.parts:
            found = part.seeds, part.difference, part.low, part.high, part.p_holm, part.outcome
            rows.append((name, reading, part.baseline, *found, judged.verdict))
    names = ["seeds", "difference", "low", "high", "p_holm", "outcome", "verdict"]
    return pd.DataFrame(rows, columns=["claim", "reading", "over", *names])


def one_way(claims: ClaimsConfig, how: str) -> ClaimsConfig:
    """The claims as they are measured in one way."""
    families = {}
    for title, family in claims.families.items():
        measured = {
            name: claim.model_copy(update={"parts": {how: claim.parts[how]}})
            for name, claim in family.claims.items()
        }
        families[title] = family.model_copy(update={"claims": measured})
    return claims.model_copy(update={"families": families})


def alone(claims: ClaimsConfig, name: str) -> ClaimsConfig:
    """One claim, as the only one of its family."""
    [(title, family)] = [own for own in claims.families.items() if name in own[1].claims]
    only = family.model_copy(update={"claims": {name: family.claims[name]}})
    return claims.model_copy(update={"families": {title: only}})


def family_of(claims: ClaimsConfig, environments: set[str], whole: bool) -> ClaimsConfig:
    """The paper's claims, the first family: those with all parts in these environments, or parts.

    whole: False for the claims of which only some parts are there, cut to these.
    """
    title, family = next(iter(claims.families.items()))
    found = {}
    for name, claim in family.claims.items():
        own = {
            how: [cut for part in parts if (cut := within(part, environments)) is not None]
            for how, parts in claim.parts.items()
        }
        if all(own.values()) and (own == claim.parts) is whole:
            found[name] = claim.model_copy(update={"parts": own})
    families = {title: family.model_copy(update={"claims": found})} if found else {}
    return claims.model_copy(update={"families": families})


def within(part: PartsConfig, environments: set[str]) -> PartsConfig | None:
    """A part in those of its environments that are there; None if none is."""
    there = [env for env in part.environments if env in environments]
    return part.model_copy(update={"environments": there}) if there else None
