"""The settings of `mace_rl.wrapping.wrappers`."""

from collections.abc import Mapping
from functools import cache
from typing import Any

from pydantic import Field, field_validator, model_validator

from mace_rl.config.beta import BetaRule
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.config.reading import DEFAULTS, merge, read_yaml
from mace_rl.config.run import BETA_SECTIONS
from mace_rl.config.section import Count, Section


@cache
def defaults() -> dict[str, Any]:
    """The sections `memory` and `novelty` of config.yaml."""
    training = read_yaml(DEFAULTS)["training"]
    return {section: training[section] for section in ("memory", "novelty")}


class CuriosityConfig(Section):
    """The settings of R_extrinsic + β · R_curiosity for any agent."""

    beta: BetaRule = Field(discriminator="kind")  # a number is that constant
    relevance: bool = True  # False: the bonus is novelty alone, and memory is not used
    centred: bool = True  # what is usual is paid with 0: a long episode as such earns nothing
    memory: MemoryConfig  # is read over `defaults`, as is the next
    novelty: NoveltyConfig
    discount: float = Field(default=0.99, ge=0, le=1)  # γ of the agent
    rollout_steps: Count = 1  # steps between updates of the agent
    seed: int = Field(default=0, ge=0, lt=2**32)

    @model_validator(mode="before")
    @classmethod
    def _over_defaults(cls, values: dict[str, Any]) -> dict[str, Any]:
        if values.get("relevance") is False and "memory" in values:
            raise ValueError("relevance False does not use memory: one of the two should go")
        for section, default in defaults().items():
            given = values.get(section, {})
            if isinstance(given, Mapping):
                values = {**values, section: merge(default, given)}
        return values

    @field_validator("beta", mode="before")
    @classmethod
    def _not_meta(cls, beta: Any) -> Any:
        if not isinstance(beta, Mapping):
            return {"kind": "constant", "value": beta}
        if beta.get("kind") in {kind for kinds in BETA_SECTIONS.values() for kind in kinds}:
            raise ValueError(
                "meta-adaptation asks for policy gradients and the budget, which only our trainer "
                "has: kind should be constant, exponential or custom"
            )
        return beta
