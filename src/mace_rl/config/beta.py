"""Settings of `mace_rl.beta`: what sets β, from nothing to meta-adaptation."""

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from mace_rl.config.section import Arguments, Count, Reference, Section
from mace_rl.records import LARGEST_BETA


class MetaConfig(Section):
    """Meta-adaptation: a pretrained LSTM (paper, supplement), and the credit of earlier βs."""

    pretrained: bool  # false: no LSTM, in whose place stands the initial β
    credit_gain: NonNegativeFloat  # of β's logit per unit of z beyond the threshold; 0: no credit
    credit_threshold: NonNegativeFloat  # of |z|, the sum of the credits in units of its noise
    horizon: Count  # updates after a rollout that judge its β
    max_credit: PositiveFloat  # bound of a β's credit, in units of its usual size


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
    """β by meta-adaptation; `initial` is β of the first hundredth of the training."""

    kind: Literal["meta"]
    initial: float = Field(gt=0, lt=1)


class CustomBeta(Section):
    """β from the class `rule`, a `mace_rl.beta.controller.BetaController`.

    It is made as rule(generator, **arguments).
    """

    kind: Literal["custom"]
    rule: Reference
    arguments: Arguments = Field(default={})


BetaRule = ConstantBeta | ExponentialBeta | CustomBeta
BetaConfig = NoBonus | MetaBeta | BetaRule
