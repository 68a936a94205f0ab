"""Settings of `mace_rl.beta`: what sets β, from nothing to the meta-adaptation network."""

from typing import Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from mace_rl.config.section import Arguments, Count, Reference, Section, Units


class MetaConfig(Section):
    """Meta-adaptation network: the LSTM that sets β (paper, supplement)."""

    hidden_units: Units
    learning_rate: NonNegativeFloat = Field(lt=1)  # 0: the LSTM stays as it was initialised
    max_gradient_norm: PositiveFloat
    horizon: Count  # updates after an episode that judge its β
    learn_every: Count  # βs that have been judged for one step of the optimiser
    prior: NonNegativeFloat  # pull of β's logit back to the initial β's, per unit of distance
    max_credit: PositiveFloat  # bound of a β's credit, in units of its usual size
    max_sequence: Count | None  # longer episodes are condensed to this many elements


class NoBonus(Section):
    """Plain PPO: no curiosity, no memory, β = 0."""

    kind: Literal["none"]


class ConstantBeta(Section):
    """The same β in every episode."""

    kind: Literal["constant"]
    value: float = Field(ge=0, le=1)


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
    """β from the meta-adaptation network; `initial` is β of the first episode."""

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
