"""Rewards for exploring: their interface, and what those with a learned predictor share.

Which one a run has, the section `bonus` says: the paper's curiosity, or one of those it is compared
with. β weighs each of them alike.
"""

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.config.bonus import ICMBonus, RNDBonus
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.normaliser import RunningNormaliser
from mace_rl.state import Stateful

CLIP = 5.0  # bound of whitened observations, in standard deviations (Burda et al. 2018, 2.4)


class Bonus(NamedTuple):
    """The bonus of an episode and what it is made of, float64 [T] each; None: no such part."""

    reward: np.ndarray  # what β weighs; of curiosity: novelty × relevance
    novelty: np.ndarray | None = None
    relevance: np.ndarray | None = None
    similarity: np.ndarray | None = None  # to what memory holds, in [0, 1]


class IntrinsicReward(ABC):
    """R_I of every step, and what it rests on.

    An episode is rewarded for what was known before it; `remember` adds it to what is known. One of
    the user's own is made as Class(size, action_space, generator, **arguments), with the size of an
    observation (a Discrete one is one-hot).
    """

    largest = math.inf  # a step's reward is in [0, largest]; a run in which it is not is stopped

    @abstractmethod
    def bonus(self, episode: Episode) -> Bonus:
        """The bonus of each step, for the state it led to. Asking changes nothing."""

    @abstractmethod
    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """Make the episode part of what is known; returns: extrinsic return-to-go, [T]."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs: tensors, numbers, strings, lists, dicts."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""


class PredictionError(Stateful, IntrinsicReward):
    """The error of networks that learn to predict what is visited: high where little was learnt.

    They learn from each episode once, when that is over, in minibatches of `batch_size` steps in
    random order. They see observations whitened by their running mean and standard deviation and
    clipped to ±`CLIP`; of the first episode, before which there are none, as they are. Discrete
    ones are one-hot and stay as they are.
    """

    STATE: tuple[str, ...] = ("optimiser", "normaliser", "generator")

    def __init__(
        self,
        config: ICMBonus | RNDBonus,
        parameters: np.ndarray,
        observation_space: Box | Discrete,
        observation_size: int,
        generator: np.random.Generator,
    ) -> None:
        self.config = config
        self.optimiser = Adam(parameters, config.learning_rate)
        self.normaliser = RunningNormaliser(observation_size)
        self.discrete = isinstance(observation_space, Discrete)
        self.generator = generator

    @abstractmethod
    def inputs(self, episode: Episode) -> np.ndarray:
        """What the networks get for each step, float32 [T, inputs]."""

    @abstractmethod
    def errors(self, inputs: np.ndarray) -> np.ndarray:
        """The bonus for each of N inputs, [N, inputs] → [N]."""

    @abstractmethod
    def gradient(self, inputs: np.ndarray) -> np.ndarray:
        """Gradient, float32 [n], of the loss of N inputs at the parameters."""

    def whiten(self, observations: np.ndarray) -> np.ndarray:
        """Observations as the networks see them, float32 [N, observation]."""
        return self.normaliser(observations, CLIP)

    def bonus(self, episode: Episode) -> Bonus:
        """See `IntrinsicReward`."""
        return Bonus(self.errors(self.inputs(episode)).astype(np.float64))

    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """See `IntrinsicReward`; the returns do not matter."""
        if not self.discrete:
            self.normaliser.update(episode.observations[1:])
        inputs = self.inputs(episode)
        order = self.generator.permutation(len(inputs))
        for chosen in np.array_split(order, math.ceil(len(order) / self.config.batch_size)):
            self.optimiser.step(self.gradient(inputs[chosen]))
