"""The settings of `mace_rl.wrappers`: those of a run that an agent from elsewhere needs."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field, PositiveInt, field_validator, model_validator

from mace_rl.config.beta import BetaRule
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.config.reading import merge
from mace_rl.config.section import Section

# The study's; `config.yaml` says whose each value is.
MEMORY: dict[str, Any] = {
    "capacity": 1000,
    "neighbours": 10,
    "kernel_bandwidth": 0.1,
    "write_every": 10,
}
NOVELTY: dict[str, Any] = {
    "kind": "auto",
    "count_decay": 0.9995,
    "buffer_size": 2048,
    "write_every": 4,
    "neighbours": [10, 15, 20],
    "refresh_every": 256,
    "calibration_states": 32,
    "knn_weight": 0.7,
    "density_hidden_units": 64,
    "density_learning_rate": 0.001,
    "density_batch_size": 256,
    "density_steps": 2,
}


class CuriosityConfig(Section):
    """What R_extrinsic + β · R_curiosity depends on where the agent is not ours."""

    beta: BetaRule = Field(discriminator="kind")  # a number is that constant
    relevance: bool = True  # False: the bonus is novelty alone, and memory is not used
    memory: MemoryConfig  # what differs from `MEMORY`
    novelty: NoveltyConfig  # what differs from `NOVELTY`
    discount: float = Field(default=0.99, ge=0, le=1)  # γ of the agent
    rollout_steps: PositiveInt = 1  # steps between updates of the agent; for the bandit
    seed: int = Field(default=0, ge=0, lt=2**32)

    @model_validator(mode="before")
    @classmethod
    def _over_the_study_s(cls, values: dict[str, Any]) -> dict[str, Any]:
        if values.get("relevance") is False and "memory" in values:
            raise ValueError("relevance False does not use memory: one of the two should go")
        for section, defaults in (("memory", MEMORY), ("novelty", NOVELTY)):
            given = values.get(section, {})
            if isinstance(given, Mapping):
                values = {**values, section: merge(defaults, given)}
        return values

    @field_validator("beta", mode="before")
    @classmethod
    def _without_policy_gradients(cls, beta: Any) -> Any:
        if not isinstance(beta, Mapping):
            return {"kind": "constant", "value": beta}
        if beta.get("kind") == "meta":
            raise ValueError(
                "the meta network learns from policy gradients, which only our trainer has: kind "
                "should be constant, exponential, random, bandit or custom"
            )
        return beta
