"""The interface of whatever sets β, and the choice of it."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from mace_rl.environments.rollout import Episode


class BetaController(ABC):
    """Sets β for the next episode from what happened in the last.

    One of the user's own is made as Class(generator, **arguments).
    """

    learns = False  # whether `learn` wants policy gradients

    @property
    @abstractmethod
    def beta(self) -> float:
        """β of the next episode, in [0, 1]."""

    @abstractmethod
    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """Take in a finished episode and its curiosity bonus, [T]; `beta` is then the next's."""

    def learn(self, extrinsic: np.ndarray, intrinsic: list[np.ndarray]) -> float | None:
        """After each rollout, before the policy's update on it: the flat policy gradients.

        extrinsic: g_E of the whole rollout; intrinsic: for each of its episodes, in order, the
        derivative dg/dβ of the update's direction. Returns the mean credit of the βs that it could
        judge, or None.
        """
        raise NotImplementedError("this rule for β does not learn")

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs: tensors, numbers, strings, lists, dicts."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
