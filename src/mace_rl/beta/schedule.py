"""Schedules of β, which follow the episode's number alone."""

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController
from mace_rl.config.beta import ConstantBeta, ExponentialBeta
from mace_rl.environments.episode import Episode


class ExponentialSchedule(Stateful, BetaController):
    """β_n = max(floor, initial · decay^(n-1)): the paper's ablation with a fixed schedule."""

    STATE = ("decayed",)

    def __init__(self, config: ExponentialBeta) -> None:
        self.config = config
        self.decayed = config.initial

    def next_beta(self) -> float:
        return max(self.config.floor, self.decayed)

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        self.decayed *= self.config.decay


class Constant(Stateful, BetaController):
    """One β for every episode."""

    def __init__(self, config: ConstantBeta) -> None:
        self.config = config

    def next_beta(self) -> float:
        return self.config.value

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """Whatever it was."""
