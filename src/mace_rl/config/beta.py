"""Settings of `mace_rl.beta`: what sets β, from nothing to the meta-adaptation network."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from mace_rl.config.section import Arguments, Count, Reference, Section

LARGEST_BETA = 10.0  # the paper has at most 1; larger constants are there to compare


class CreditConfig(Section):
    """How a β is judged by the updates that follow: docs/method.md."""

    horizon: Count  # updates after a rollout that judge its β
    max_credit: PositiveFloat  # bound of a β's credit, in units of its usual size


class MetaConfig(Section):
    """The meta-adaptation network, which learns during the run (paper, supplement)."""

    hidden_units: Count = Field(multiple_of=4)
    learning_rate: PositiveFloat
    max_gradient_norm: PositiveFloat
    output_decay: NonNegativeFloat  # λ of λ o² / 2 in its loss
    chunks: Count  # rows at most that it reads of an episode
    sequences: Count  # of a rollout, of which credit and evidence learn, at most
    reads: bool = True  # false: it sees a constant, whatever was played; to see what reading does


Several = Annotated[int, Field(ge=2, le=10**7)]  # of one alone nothing says what is usual


class ReturnObjective(Section):
    """`mace_rl.beta.objectives.Return`: the public code's loss, connected."""

    kind: Literal["return"]
    centred: bool  # less the mean of the last returns
    recent: Several  # of these: they also say what size is usual


class PerturbedObjective(Section):
    """`mace_rl.beta.objectives.Perturbed`."""

    window: Count  # episodes for which a perturbation stays
    noise: PositiveFloat  # its size, in β's logit
    lag: float = Field(ge=1)  # episodes after which it acts
    recent: Several  # payments that say what is usual


class ScoreObjective(PerturbedObjective):
    """`mace_rl.beta.objectives.Score`: paid by returns."""

    kind: Literal["score"]


class ProgressObjective(PerturbedObjective):
    """`mace_rl.beta.objectives.Progress`: paid by learning progress."""

    kind: Literal["progress"]
    stretch: Count  # episodes whose returns are compared with those of as many before


class WordsObjective(Section):
    """`mace_rl.beta.objectives.Words`: what the paper says that β does, as its target."""

    kind: Literal["words"]
    stretch: Count  # as in `ProgressObjective`


class CreditObjective(CreditConfig):
    """`mace_rl.beta.credit.Credit`: a meta-gradient."""

    kind: Literal["credit"]


class EvidenceObjective(CreditConfig):
    """`mace_rl.beta.credit.Evidence`: the same, and β waits until it is beyond chance."""

    kind: Literal["evidence"]
    chance: float = Field(gt=0, lt=1)  # of trainings in which β may move for nothing
    scale: PositiveFloat  # variance of the evidence at which it is best seen
    gain: NonNegativeFloat  # of β's logit per standard deviation of evidence beyond chance


ByReturns = ReturnObjective | ScoreObjective | ProgressObjective | WordsObjective
MetaObjective = ByReturns | CreditObjective | EvidenceObjective


class NoBonus(Section):
    """Plain PPO: no curiosity, no memory, β = 0."""

    kind: Literal["none"]


class ConstantBeta(Section):
    """The same β in every episode."""

    kind: Literal["constant"]
    value: float = Field(ge=0, le=LARGEST_BETA)


class ExponentialBeta(Section):
    """β_n = max(floor, initial · decay^(n-1)) for episode n = 1, 2, …"""

    kind: Literal["exponential"]
    initial: float = Field(ge=0, le=1)
    decay: PositiveFloat = Field(le=1)
    floor: float = Field(ge=0, le=1)

    @model_validator(mode="after")
    def _falls(self) -> "ExponentialBeta":
        if self.floor > self.initial:
            raise ValueError(
                f"floor is {self.floor}, which must not exceed initial, {self.initial}"
            )
        return self


class MetaBeta(Section):
    """β by the paper's meta-adaptation network; `initial` is β before it has learned anything."""

    kind: Literal["meta"]
    initial: float = Field(gt=0, lt=1)
    objective: MetaObjective | None = Field(default=None, discriminator="kind")  # what it learns


class CustomBeta(Section):
    """β from the class `rule`, a `mace_rl.beta.controller.BetaController`.

    It is made as rule(generator, **arguments), with episodes= of the run if it `needs_budget`.
    """

    kind: Literal["custom"]
    rule: Reference
    arguments: Arguments = Field(default={})


BetaRule = ConstantBeta | ExponentialBeta | CustomBeta
BetaConfig = NoBonus | MetaBeta | BetaRule
