"""Settings of `mace_rl.bonus`: memory, novelty, and the bonuses that can be had."""

from typing import Literal

from pydantic import Field, PositiveFloat, model_validator

from mace_rl.config.section import Arguments, Count, Reference, Section, Units


class MemoryConfig(Section):
    """Episodic memory: a neural dictionary (paper, supplement)."""

    capacity: Count  # entries
    neighbours: Count  # k of the top-k lookup
    kernel_bandwidth: PositiveFloat  # δ of the kernel 1 / (d² + δ), in standardised units
    write_every: Count  # one step in this many is written

    @model_validator(mode="after")
    def _neighbours_fit(self) -> "MemoryConfig":
        if self.neighbours > self.capacity:
            raise ValueError(
                f"neighbours is {self.neighbours}, which must not exceed capacity, {self.capacity}"
            )
        return self


class NoveltyConfig(Section):
    """Novelty: visitation counts (of whole numbers) or k-NN and density (of others)."""

    # auto: by the observation space; custom: a `mace_rl.bonus.novelty.Novelty`, made as
    # estimator(size, generator, **arguments).
    kind: Literal["auto", "counts", "density", "custom"] = "auto"
    estimator: Reference | None = None
    arguments: Arguments = Field(default={})
    count_decay: PositiveFloat = Field(le=1)  # factor on all counts after each episode
    buffer_size: Count  # visited states that k-NN and density refer to
    write_every: Count  # one visited state in so many may be written
    neighbours: list[Count] = Field(min_length=1)  # one k-NN estimator for each k
    refresh_every: Count  # steps after which, at an episode's end, novelty is updated
    calibration_states: Count  # the sample for the threshold of distances
    knn_weight: float = Field(ge=0, le=1)  # the density estimator weighs 1 - knn_weight
    density_hidden_units: Units
    density_learning_rate: PositiveFloat = Field(lt=1)
    density_batch_size: Count
    density_steps: Count  # gradient steps of the density estimator in a refresh

    @model_validator(mode="after")
    def _keys_agree(self) -> "NoveltyConfig":
        if max(self.neighbours) >= self.buffer_size:
            raise ValueError(
                f"neighbours has {max(self.neighbours)}, which must be less than buffer_size,"
                f" {self.buffer_size}"
            )
        if (self.kind == "custom") != (self.estimator is not None):
            raise ValueError("estimator and kind: custom go together")
        if self.arguments and self.kind != "custom":
            raise ValueError("arguments are those of an estimator, with kind: custom")
        return self


class CuriosityBonus(Section):
    """Curiosity: novelty × memory relevance (paper); without `relevance`, novelty alone."""

    kind: Literal["curiosity"]
    relevance: bool = True


class CustomBonus(Section):
    """A `mace_rl.bonus.intrinsic.IntrinsicReward`: estimator(spaces, generator, **arguments)."""

    kind: Literal["custom"]
    estimator: Reference
    arguments: Arguments = Field(default={})


BonusConfig = CuriosityBonus | CustomBonus
