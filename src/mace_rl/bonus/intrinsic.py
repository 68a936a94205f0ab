"""The interface of rewards for exploring: the paper's curiosity, or one of the user's own."""

import math
from abc import abstractmethod
from typing import NamedTuple

import numpy as np

from mace_rl.base.state import HasState
from mace_rl.environments.episode import Episode


class Bonus(NamedTuple):
    """The bonus of an episode and what it is made of, float64 [T] each; None: no such part."""

    reward: np.ndarray  # what β weighs; of curiosity: novelty × relevance
    novelty: np.ndarray | None = None
    relevance: np.ndarray | None = None
    similarity: np.ndarray | None = None  # to what memory holds, in [0, 1]


class IntrinsicReward(HasState):
    """R_I of every step.

    An episode is rewarded for what was known before it; `remember` adds it to what is known. A
    user's own is made as Class(spaces, generator, **arguments) with the environment's
    `mace_rl.environments.spaces.Spaces`; it raises `ConfigError` for arguments that it cannot use.
    """

    largest = math.inf  # bound of a step's reward: a run is stopped if one is not in [0, largest]

    @abstractmethod
    def bonus(self, episode: Episode) -> Bonus:
        """The bonus of each step, for the state it led to. Asking again gives the same."""

    @abstractmethod
    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """Make the episode part of what is known; returns: extrinsic return-to-go, [T]."""
