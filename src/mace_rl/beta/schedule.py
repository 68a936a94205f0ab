"""Schedules of β, which follow the episode's number alone."""

from typing import Any

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
        """β of the next episode."""
        return max(self.config.floor, self.decayed)

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.decayed *= self.config.decay


class Constant(BetaController):
    """One β for every episode."""

    def __init__(self, config: ConstantBeta) -> None:
        self.config = config

    def next_beta(self) -> float:
        """See `BetaController`."""
        return self.config.value

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""

    def state_dict(self) -> dict[str, Any]:
        """See `BetaController`."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `BetaController`."""
