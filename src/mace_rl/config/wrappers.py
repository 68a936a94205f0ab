"""The settings of `mace_rl.wrapping.wrappers`."""

from collections.abc import Mapping
from functools import cache
from typing import Any

from pydantic import Field, field_validator, model_validator

from mace_rl.config.beta import BetaRule, ByReturns, MetaBeta, MetaConfig
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.config.reading import DEFAULTS, merge, read_yaml
from mace_rl.config.section import Count, Section

LEARNED = "learned"  # β as in the variant mace_full of config.yaml


@cache
def defaults() -> dict[str, Any]:
    """The sections `memory`, `novelty`, `meta` and `beta` of config.yaml's mace_full."""
    config = read_yaml(DEFAULTS)
    everything = merge(config["training"], config["variant_settings"]["mace_full"])
    return {name: everything[name] for name in ("memory", "novelty", "meta", "beta")}


class CuriosityConfig(Section):
    """The settings of R_extrinsic + β · R_curiosity for any agent."""

    # A number is that constant; `LEARNED` stands for the learned β.
    beta: MetaBeta | BetaRule = Field(discriminator="kind")
    relevance: bool = True  # False: the bonus is novelty alone, and memory is not used
    centred: bool = True  # what is usual is paid with 0: a long episode as such earns nothing
    memory: MemoryConfig  # is read over `defaults`, as are the next two
    novelty: NoveltyConfig
    meta: MetaConfig  # of a learned β
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
            if section != "beta" and isinstance(given, Mapping):
                values = {**values, section: merge(default, given)}
        return values

    @model_validator(mode="before")
    @classmethod
    def _meta_is_used(cls, values: dict[str, Any]) -> dict[str, Any]:
        beta = values.get("beta")
        learned = beta == LEARNED or (isinstance(beta, Mapping) and beta.get("kind") == "meta")
        if "meta" in values and not learned:
            raise ValueError(f"meta is for a β that is {LEARNED!r}: one of the two should go")
        return values

    @field_validator("beta", mode="before")
    @classmethod
    def _as_a_rule(cls, beta: Any) -> Any:
        if beta == LEARNED:
            return defaults()["beta"]
        if isinstance(beta, str):
            raise ValueError(f"it should be a number, {LEARNED!r}, or a rule as in config.yaml")
        return beta if isinstance(beta, Mapping) else {"kind": "constant", "value": beta}

    @field_validator("beta")
    @classmethod
    def _by_returns(cls, beta: MetaBeta | BetaRule) -> MetaBeta | BetaRule:
        if isinstance(beta, MetaBeta) and not isinstance(beta.objective, ByReturns):
            raise ValueError(
                "its objective should be one that asks for returns alone, of kind return, score, "
                "progress or words: policy gradients are our trainer's"
            )
        return beta
