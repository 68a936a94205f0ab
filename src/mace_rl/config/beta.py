"""Settings of `mace_rl.beta`: what sets β, from nothing to the meta-adaptation network."""

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from mace_rl.config.section import Arguments, Count, Reference, Section

LARGEST_BETA = 10.0  # the paper has at most 1; larger constants are there to compare


class CreditConfig(Section):
    """How a β is judged by the updates that follow: docs/method.md."""

    horizon: Count  # updates after a rollout that judge its β
    max_credit: PositiveFloat  # bound of a β's credit, in units of its usual size


class MetaConfig(CreditConfig):
    """The meta-adaptation network, which learns during the run (paper, supplement)."""

    hidden_units: Count = Field(multiple_of=4)
    learning_rate: PositiveFloat
    max_gradient_norm: PositiveFloat
    output_decay: NonNegativeFloat  # λ in its loss, -c o + λ o² / 2
    chunks: Count  # rows at most that it reads of an episode
    sequences: Count  # episodes at most, of a rollout, that it learns from
    evidence_chance: float = Field(gt=0, lt=1)  # of trainings in which β may move for nothing
    evidence_scale: PositiveFloat  # variance of the evidence at which it is best seen
    gain: NonNegativeFloat  # of β's logit per standard deviation of evidence beyond chance
    reads: bool = True  # false: it sees a constant, whatever was played; to see what reading does
    trusts_evidence: bool = True  # false: its output moves β as it is; to see what waiting does


class PretrainedConfig(CreditConfig):
    """A pretrained LSTM that reads how the training goes, and the credit of earlier βs: ours."""

    lstm: bool  # false: none, in whose place stands the initial β
    credit_gain: NonNegativeFloat  # of β's logit per unit of z beyond the threshold; 0: no credit
    credit_threshold: NonNegativeFloat  # of |z|, the sum of the credits in units of its noise


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


class PretrainedBeta(Section):
    """β by the pretrained LSTM; `initial` is β of the first hundredth of the training."""

    kind: Literal["pretrained"]
    initial: float = Field(gt=0, lt=1)


class HybridBeta(Section):
    """β by the pretrained LSTM, which the paper's network corrects in place of the credit's sum."""

    kind: Literal["hybrid"]
    initial: float = Field(gt=0, lt=1)


class CustomBeta(Section):
    """β from the class `rule`, a `mace_rl.beta.controller.BetaController`.

    It is made as rule(generator, **arguments).
    """

    kind: Literal["custom"]
    rule: Reference
    arguments: Arguments = Field(default={})


BetaRule = ConstantBeta | ExponentialBeta | CustomBeta
BetaConfig = NoBonus | MetaBeta | PretrainedBeta | HybridBeta | BetaRule
