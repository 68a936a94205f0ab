"""A rule for β in ten lines, made by looking at a few tasks: what learning has to be as good as."""

from typing import Any

import numpy as np
from pydantic import Field

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController
from mace_rl.config.section import Count, Section, check
from mace_rl.environments.episode import Episode


class Settings(Section):
    """The arguments of `StopWhenUnlearnable`."""

    window: Count  # episodes
    share: float = Field(gt=0)  # of the first window's bonus


class StopWhenUnlearnable(Stateful, BetaController):
    """β is 1, and 0 for good once a window's bonus is above a share of the first window's.

    It asks from the end of the second window on. What can be learned fades by then; a bonus that
    does not comes of noise. Raises `ConfigError` for arguments that are not as `Settings` has them.
    """

    STATE = ("_beta", "first", "last")

    def __init__(self, generator: np.random.Generator, **arguments: Any) -> None:
        self.settings = check(Settings, arguments, "arguments")
        self._beta = 1.0
        self.first: list[float] = []  # of the episodes of the first window, their mean bonus
        self.last: list[float] = []  # of those since, a window of them at most

    def next_beta(self) -> float:
        """See `BetaController`."""
        return self._beta

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        window = self.settings.window
        if len(self.first) < window:
            self.first.append(float(bonus.mean()))
            return
        self.last = [*self.last, float(bonus.mean())][-window:]
        if len(self.last) == window and sum(self.last) > self.settings.share * sum(self.first):
            self._beta = 0.0
