"""The curiosity bonus: novelty × what the episodic memory says of similar states (paper)."""

from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numba import njit

from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.bonus.memory import EpisodicMemory
from mace_rl.bonus.novelty import novelty
from mace_rl.config.run import MemoryConfig, NoveltyConfig
from mace_rl.environments.rollout import Episode
from mace_rl.streams import Streams


@njit(cache=True, error_model="numpy")
def relevance(similarity, recalled, returns):
    """Memory relevance in [0, 1], float64 [N]: 1 - similarity · (1 - productivity).

    similarity: [N]; recalled: remembered return-to-go, [N]. Productivity is where it lies among all
    `returns` in memory, [M]: the logistic function of its distance from their mean in standard
    deviations. So a state unlike anything remembered has relevance 1, one like unproductive states
    goes toward 0, and one like productive states stays near 1.
    """
    mean = returns.astype(np.float64).mean()
    # Not below float32's rounding, which would decide if all returns were equal.
    spread = np.sqrt(np.square(returns - mean).mean()) + 1e-6 * np.abs(returns).mean() + 1e-8
    return 1 - similarity * (1 - 1 / (1 + np.exp((mean - recalled) / spread)))


class Bonus(NamedTuple):
    """The curiosity bonus of an episode and what it is made of, float64 [T] each."""

    reward: np.ndarray  # R_curiosity = novelty × relevance
    novelty: np.ndarray
    relevance: np.ndarray
    similarity: np.ndarray  # to what memory holds, in [0, 1]


class Curiosity:
    """R_curiosity of every step, and the memory and novelty estimates it rests on.

    An episode is rewarded for what was known before it; `remember` adds it to what is known.
    """

    def __init__(
        self,
        memory: MemoryConfig,
        novelty_config: NoveltyConfig,
        engine: str,
        observation_space: Box | Discrete,
        observation_size: int,
        streams: Streams,
    ) -> None:
        self.config = memory
        self.memory = EpisodicMemory(memory, observation_size)
        # States are compared as this normaliser sees them; one-hot states as they are.
        self.normaliser = RunningNormaliser(observation_size)
        self.discrete = isinstance(observation_space, Discrete)
        self.novelty = novelty(novelty_config, engine, observation_space, self.normaliser, streams)

    def bonus(self, episode: Episode) -> Bonus:
        """R_curiosity of each step: novelty × relevance of the state it led to."""
        states = episode.observations[1:]
        new = self.novelty(states)
        if len(self.memory) == 0:
            return Bonus(new, new, np.ones(len(new)), np.zeros(len(new)))
        recollection = self.memory.lookup(
            torch.from_numpy(states),
            torch.from_numpy(self.normaliser.mean.astype(np.float32)),
            torch.from_numpy(self.scale().astype(np.float32)),
        )
        similarity, recalled = recollection.similarity.numpy(), recollection.values[:, -1].numpy()
        relevant = relevance(similarity, recalled, self.memory.returns.numpy())
        return Bonus(new * relevant, new, relevant, similarity)

    def scale(self) -> np.ndarray:
        """The unit of distance between states, [observation].

        One-hot states differ in two dimensions however many there are: in this unit by 2 per
        dimension, like independent standardised ones.
        """
        size = len(self.normaliser.mean)
        return np.full(size, size**-0.5) if self.discrete else self.normaliser.std

    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """Make the episode part of memory and of what is no longer novel.

        returns: extrinsic return-to-go of each step, [T], as its λ-return.
        """
        chosen = slice(None, None, self.config.write_every)
        self.memory.write(
            torch.from_numpy(episode.observations[:-1][chosen]),
            torch.from_numpy(episode.observations[1:][chosen]),
            torch.from_numpy(episode.rewards[chosen]),
            torch.from_numpy(returns[chosen]),
        )
        if not self.discrete:
            self.normaliser.update(episode.observations[1:])
        self.novelty.observe(episode.observations[1:])

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {
            "memory": self.memory.state_dict(),
            "normaliser": self.normaliser.state_dict(),
            "novelty": self.novelty.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.memory.load_state_dict(state["memory"])
        self.normaliser.load_state_dict(state["normaliser"])
        self.novelty.load_state_dict(state["novelty"])
