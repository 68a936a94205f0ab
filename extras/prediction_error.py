"""What ICM and RND share: a bonus that is the error of a learned predictor."""

import math
from abc import abstractmethod
from typing import Any

import numpy as np
from pydantic import Field, PositiveFloat

from mace_rl.base.state import Stateful
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.config.section import Count, Section, Units
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.normaliser import RunningNormaliser

CLIP = 5.0  # bound of whitened observations, in standard deviations (Burda et al. 2018, 2.4)


class PredictorSettings(Section):
    """The arguments that every one of them takes."""

    hidden_units: Units = 64  # of the one hidden layer in each network
    learning_rate: PositiveFloat = Field(default=0.001, lt=1)  # RND's paper has 0.0001, for images
    batch_size: Count = 64  # steps; each episode is learnt from once


class PredictionError(Stateful, IntrinsicReward):
    """The error of networks that learn to predict what is visited: high where little was learnt.

    They learn from each episode once, when that is over, in minibatches of `batch_size` steps in
    random order. They see observations whitened by their running mean and standard deviation and
    clipped to ±`CLIP`; of the first episode, before which there are none, as they are. Discrete
    ones are one-hot and stay as they are.
    """

    STATE: tuple[str, ...] = ("optimiser", "normaliser", "generator")
    settings: Any

    def __init__(
        self,
        settings: PredictorSettings,
        parameters: np.ndarray,
        spaces: Spaces,
        generator: np.random.Generator,
    ) -> None:
        self.settings, self.spaces, self.generator = settings, spaces, generator
        self.optimiser = Adam(parameters, settings.learning_rate)
        self.normaliser = RunningNormaliser(spaces.observation_size)

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
        if not self.spaces.discrete_observations:
            self.normaliser.update(episode.observations[1:])
        inputs = self.inputs(episode)
        order = self.generator.permutation(len(inputs))
        for chosen in np.array_split(order, math.ceil(len(order) / self.settings.batch_size)):
            self.optimiser.step(self.gradient(inputs[chosen]))
