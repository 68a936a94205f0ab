"""A rule for β in ten lines, made by looking at a few tasks: what learning has to be as good as."""

from typing import Any

import numpy as np
from pydantic import Field

from mace_rl.beta.controller import BetaController
from mace_rl.config.section import Count, Section, check
from mace_rl.environments.rollout import Episode
from mace_rl.state import Stateful


class Settings(Section):
    """The arguments of `StopWhenUnlearnable`."""

    window: Count  # episodes
    share: float = Field(gt=0)  # of the first window's bonus


class StopWhenUnlearnable(Stateful, BetaController):
    """β is 1; if the bonus of the second window is above a share of the first's, it is 0 from then.

    What can be learned fades; a bonus that does not comes of noise. Raises `ConfigError` for
    arguments that are not as `Settings` has them.
    """

    STATE = ("_beta", "means")

    def __init__(self, generator: np.random.Generator, **arguments: Any) -> None:
        self.settings = check(Settings, arguments, "arguments")
        self._beta = 1.0
        self.means: list[float] = []  # of the bonus of each episode of the two windows

    @property
    def beta(self) -> float:
        """See `BetaController`."""
        return self._beta

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        window = self.settings.window
        if len(self.means) == 2 * window:
            return
        self.means.append(float(bonus.mean()))
        if len(self.means) == 2 * window:
            first, second = sum(self.means[:window]), sum(self.means[window:])
            self._beta = float(second <= self.settings.share * first)
