"""What the study asks, as docs/protocol.md has it: the paper's claims, and questions of our own.

Each is made of parts, comparisons of two variants, which `claims` judges.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from mace_rl.study.paper import (
    ACROBOT,
    CARTPOLE,
    ENVIRONMENTS,
    FIXED,
    FULL,
    HOPPER,
    PPO,
    VARIANTS,
)

CORRELATION = "stagnation_correlation"  # of betas.csv; over 0
AREA = "area_under_curve"  # the mean return of training

WAYS = LITERAL, ROBUST = "by the paper's words and code", "robust"

EXPLORATION = (  # tasks in which random actions hardly ever see a reward
    "SparseMountainCar-v0",
    "DeepSea10-v0",
    "DeepSea20-v0",
    "FrozenLake8x8Deterministic-v0",
    "CliffWalking200-v0",
)
DISTRACTING = ("BarrenRegion-v0", "NoisyMountainCar-v0", "NoisyDeepSea10-v0")
CONSTANTS = ("beta_0.1", "beta_0.4", "beta_1")
FROZEN, WITHOUT_MEMORY = "mace_frozen", "mace_no_memory"


class Part(NamedTuple):
    """In these environments, on this metric: `variant` is better than `baseline`."""

    environments: tuple[str, ...]  # of several the mean of the differences, as shares of everything
    metric: str
    variant: str
    baseline: str | None  # None: over 0


@dataclass(frozen=True)
class Claim:
    """A claim of the paper's or a question of ours, and its parts, by how it is measured."""

    name: str
    statement: str
    parts: Mapping[str, tuple[Part, ...]]
    paper: tuple[str, int] | None = None  # the environment and column of the paper's Table 1


@dataclass(frozen=True)
class Family:
    """Claims whose parts are corrected together, and what each kind of answer is called."""

    title: str
    claims: tuple[Claim, ...]
    words: Mapping[str, str]  # by how the parts came out: shown, reversed, absent, open


def _over_both(variant: str, metric: str, *environments: str) -> tuple[Part, ...]:
    """`variant` over the two others of the paper's, in each environment."""
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


def _pays(name: str, environment: str) -> Claim:
    """The question whether learning β pays in a task in which the bonus distracts."""
    task = environment.removesuffix("-v0")
    others = (PPO, *CONSTANTS, FROZEN)
    parts = tuple(Part((environment,), AREA, FULL, other) for other in others)
    statement = f"{task}: the learned β beats PPO, every constant and the frozen LSTM"
    return Claim(name, statement, {ROBUST: parts})


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
            for how, metric in ((LITERAL, "sample_efficiency"), (ROBUST, AREA))
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
ELSEWHERE = (ACROBOT, CARTPOLE, *EXPLORATION)
QUESTIONS = (
    Claim(
        "Q1",
        "Where exploration is needed, a bonus helps: β = 0.4 beats PPO in each of five tasks",
        {ROBUST: tuple(Part((env,), AREA, "beta_0.4", PPO) for env in EXPLORATION)},
    ),
    Claim(
        "Q2",
        "In three tasks made for it the bonus distracts: β = 0.1 beats β = 1 in each",
        {ROBUST: tuple(Part((env,), AREA, "beta_0.1", "beta_1") for env in DISTRACTING)},
    ),
    *(_pays(f"Q{number}", env) for number, env in enumerate(DISTRACTING, 3)),
    Claim(
        "Q6",
        "Elsewhere, over seven environments: the learned β beats each constant and the frozen LSTM",
        {ROBUST: tuple(Part(ELSEWHERE, AREA, FULL, other) for other in (*CONSTANTS, FROZEN))},
    ),
    Claim(
        "Q7",
        "Over the three tasks that distract, memory helps the learned β",
        {ROBUST: (Part(DISTRACTING, AREA, FULL, WITHOUT_MEMORY),)},
    ),
    Claim(
        "Q8",
        "Elsewhere, over seven environments: memory helps the learned β",
        {ROBUST: (Part(ELSEWHERE, AREA, FULL, WITHOUT_MEMORY),)},
    ),
)
FAMILIES = (
    Family(
        "the paper's claims",
        CLAIMS,
        {
            "shown": "reproduced",
            "reversed": "reversed",
            "absent": "not reproduced",
            "open": "open",
        },
    ),
    Family(
        "our own questions",
        QUESTIONS,
        {"shown": "yes", "reversed": "the opposite", "absent": "no", "open": "open"},
    ),
)


def asked(environments: Iterable[str], variants: Iterable[str]) -> list[Family]:
    """What a study of these can answer: the families all of whose parts it has."""
    has = set(environments), set(variants)
    return [
        family
        for family in FAMILIES
        if all(
            has[0].issuperset(part.environments)
            and has[1].issuperset({part.variant, part.baseline or part.variant})
            for claim in family.claims
            for parts in claim.parts.values()
            for part in parts
        )
    ]
