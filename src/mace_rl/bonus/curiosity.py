"""The curiosity bonus: novelty × what the episodic memory says of similar states (paper)."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Discrete

from mace_rl.base.rng import Streams
from mace_rl.base.state import Stateful
from mace_rl.bonus.counts import CountNovelty, HashedCountNovelty
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.bonus.memory import EpisodicMemory
from mace_rl.bonus.novelty import DensityNovelty, Novelty
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.config.plugins import make
from mace_rl.config.section import ConfigError
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import is_discrete
from mace_rl.numerics.arrays import mean, variance
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.finite import numbers
from mace_rl.numerics.normaliser import RunningNormaliser

SMALLEST_SPREAD = 0.01  # of reward: where returns differ by less, nothing is unproductive


@kernel
def relevance(
    similarity: np.ndarray, recalled: np.ndarray, mean_return: float, spread: float
) -> np.ndarray:
    """Memory relevance in [0, 1], float64 [N]: 1 - similarity · unproductivity.

    similarity, recalled: float32 [N], the latter the remembered return-to-go. A state is
    unproductive as far as less came of it than the `mean_return`, in units of the `spread` of what
    memory holds, at most 1; where hardly any returns differ, none is. A single lucky return does
    not make all others unproductive: it moves the mean only by as much as it is rare.
    """
    result = np.empty(len(similarity))
    for n in range(len(similarity)):
        unproductivity = np.float32(0)
        if spread > SMALLEST_SPREAD:
            unproductivity = (np.float32(mean_return) - recalled[n]) / np.float32(spread)
            if unproductivity < 0:  # so written, NaN stays NaN
                unproductivity = np.float32(0)
            elif unproductivity > 1:
                unproductivity = np.float32(1)
        result[n] = 1 - np.float64(similarity[n]) * np.float64(unproductivity)
    return result


class Curiosity(Stateful, IntrinsicReward):
    """R_curiosity of every step, and the memory and novelty estimates it rests on.

    An episode is rewarded for what was known before it; `remember` adds it to what is known.
    Without a memory all is relevant: the bonus is the novelty.
    """

    STATE = ("memory", "steps", "normaliser", "novelty")

    largest = 1.0

    def __init__(
        self,
        memory: MemoryConfig | None,
        novelty_config: NoveltyConfig,
        observation_space: Space[Any],
        observation_size: int,
        streams: Streams,
    ) -> None:
        self.memory = None if memory is None else EpisodicMemory(memory, observation_size)
        # States are compared as this normaliser sees them; one-hot states as they are.
        self.normaliser = RunningNormaliser(observation_size)
        self.steps = 0  # remembered or not
        self.discrete = isinstance(observation_space, Discrete)
        self.novelty = novelty_of(novelty_config, observation_space, self.normaliser, streams)

    def bonus(self, episode: Episode) -> Bonus:
        """R_curiosity of each step: novelty × relevance of the state it led to."""
        return self.of_states(episode.observations[1:])

    def of_states(self, states: np.ndarray, visits: Mapping[bytes, int] | None = None) -> Bonus:
        """The bonus for states that an episode came to one after the other.

        states: float32 [N, observation]; visits: see `Novelty.continued`, if it goes on.
        """
        new = self.novelty(states) if visits is None else self.novelty.continued(states, visits)
        new = numbers("the novelty", new, (len(states),))
        if self.memory is None:
            return Bonus(new, new, np.ones(len(new)))
        if self.memory.neighbours is None:
            return Bonus(new, new, np.ones(len(new)), np.zeros(len(new)))
        recalled, similarity = self.memory.recall(states)
        relevant = relevance(similarity, recalled, self.mean_return, self.spread)
        return Bonus(new * relevant, new, relevant, similarity)

    def scale(self) -> np.ndarray:
        """The unit of distance between states, [observation].

        One-hot states differ in two dimensions however many there are: in this unit by 2 per
        dimension, like independent standardised ones.
        """
        size = len(self.normaliser.mean)
        return np.full(size, 1 / math.sqrt(size)) if self.discrete else self.normaliser.std

    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """Make the episode part of memory and of what is no longer novel.

        returns: extrinsic return-to-go of each step, [T], as it was paid.
        """
        if self.memory is not None:
            self._memorise(self.memory, episode, returns)
        if not self.discrete:
            self.normaliser.update(episode.observations[1:])
        self.novelty.observe(episode.observations[1:])
        self._build_index()

    def _build_index(self) -> None:
        # What the memory compares states with until the next episode is remembered.
        if self.memory is not None and len(self.memory) > 0:
            self.memory.build_index(self.normaliser.mean, self.scale())
            returns = self.memory.values[: len(self.memory), -1].astype(np.float64)
            self.mean_return, self.spread = mean(returns), math.sqrt(variance(returns))

    def _memorise(self, memory: EpisodicMemory, episode: Episode, returns: np.ndarray) -> None:
        # One step in so many, counted across episodes, and the last, which had the outcome.
        every, last = memory.config.write_every, len(episode) - 1
        chosen = np.array([*range(-self.steps % every, last, every), last])
        self.steps += len(episode)
        before, after = episode.observations[:-1], episode.observations[1:]
        memory.write(before[chosen], after[chosen], episode.rewards[chosen], returns[chosen])

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._build_index()


def novelty_of(
    config: NoveltyConfig, space: Space[Any], normaliser: RunningNormaliser, streams: Streams
) -> Novelty:
    """The novelty that the settings ask for, of observations in `space`, before they are flat."""
    size, kind = len(normaliser.mean), config.kind
    if kind == "auto":
        kind = "counts" if is_discrete(space) else "density"
    match kind:
        case "counts" if isinstance(space, Discrete):
            return CountNovelty(config, size)
        case "counts" if is_discrete(space):
            return HashedCountNovelty(config)
        case "density" if not isinstance(space, Discrete):
            return DensityNovelty(config, normaliser, streams)
        case "custom" if config.estimator is not None:
            key, stream = "novelty.estimator", streams["novelty"]
            return make(config.estimator, key, Novelty, False, size, stream, **config.arguments)
    raise ConfigError(
        f"novelty.kind is {kind!r}, but the observations are {space}: 'counts' is for Discrete"
        " ones and whole numbers, 'density' for all but Discrete"
    )
