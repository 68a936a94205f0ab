"""β at random: what a rule has to beat that learns β."""

from typing import Any

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController
from mace_rl.config.section import Section, check
from mace_rl.environments.episode import Episode


class Settings(Section):
    """The arguments of `RandomBeta`."""

    low: float = Field(ge=0, le=1)
    high: float = Field(ge=0, le=1)

    @field_validator("high")
    @classmethod
    def _in_order(cls, high: float, before: ValidationInfo) -> float:
        if (low := before.data.get("low", 0.0)) > high:
            raise ValueError(f"should not be less than low, {low}")
        return high


class RandomBeta(Stateful, BetaController):
    """β uniform in [low, high), drawn anew for every episode.

    Raises `ConfigError` for arguments that are not as `Settings` has them.
    """

    STATE = ("_beta", "generator")

    def __init__(self, generator: np.random.Generator, **arguments: Any) -> None:
        self.settings, self.generator = check(Settings, arguments, "arguments"), generator
        self._beta = self.draw()

    def next_beta(self) -> float:
        """See `BetaController`."""
        return self._beta

    def draw(self) -> float:
        """One β."""
        return float(self.generator.uniform(self.settings.low, self.settings.high))

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self._beta = self.draw()
