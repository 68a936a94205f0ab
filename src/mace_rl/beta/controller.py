"""The interface of whatever sets β."""

from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np

from mace_rl.base.state import HasState
from mace_rl.environments.episode import Episode


class BetaGradient(NamedTuple):
    """What a little more β in each episode of a rollout changes in the update on it: dθ'/dβ."""

    direction: np.ndarray  # dθ'/dβ as the optimiser steps, up to a factor, float32 [n]
    advantage_rms: float  # of what β weighs: the rollout's intrinsic advantages, in their scale


class BetaController(HasState):
    """Sets β for the next episode from what happened in the last.

    One of the user's own is made as Class(generator, **arguments); it raises `ConfigError` for
    arguments that it cannot use.
    """

    learns = False  # whether `learn` wants policy gradients
    one_at_a_time = False  # whether every episode has to end before the next begins
    needs_budget = False  # whether it is made with episodes=, how many the run will have
    # What `next_beta` went by, for `next_episode` of that episode: arrays and numbers. Whoever
    # plays several at once keeps it and puts it back.
    asked: tuple[Any, ...] | None = None

    @abstractmethod
    def next_beta(self) -> float:
        """β of the next episode, in [0, 10]; the paper has at most 1. Asked once, before it."""

    @abstractmethod
    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """Take in a finished episode and its curiosity bonus, [T]."""

    def end_rollout(self) -> None:
        """After the last `next_episode` before an update of the policy, and before `learn`."""
        return  # most rules do not ask when the policy changes

    def learn(
        self, gradient: np.ndarray, advantage_rms: float, change: BetaGradient
    ) -> float | None:
        """After each rollout, before the policy's update on it: what its β does to the policy.

        gradient: g_E, the policy gradient of the rollout's extrinsic return, [n]; advantage_rms: of
        the extrinsic advantages in their scale. Returns the credit of the earlier β that has been
        judged with this, or None.
        """
        raise NotImplementedError("this rule for β does not learn")
