"""The curiosity bonus: novelty × what the episodic memory says of similar states (paper)."""

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.bonus.memory import EpisodicMemory
from mace_rl.bonus.novelty import novelty
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.environments.rollout import Episode
from mace_rl.streams import Streams

SMALLEST_SPAN = 0.1  # of reward: returns that differ by less differ by the critic's errors


def relevance(
    similarity: np.ndarray, recalled: np.ndarray, worst: float, best: float
) -> np.ndarray:
    """Memory relevance in [0, 1], float64 [N]: 1 - similarity · (1 - productivity).

    similarity: [N]; recalled: remembered return-to-go, [N]. Productivity is how far the recalled
    return lies on the way from the `worst` to the `best` return that memory holds, in [0, 1]; 0
    where none is better than another. So a state unlike anything remembered has relevance 1, one
    like unproductive states goes toward 0, and one like productive states stays near 1.
    """
    span = best - worst
    if not span > SMALLEST_SPAN:
        return 1.0 - similarity
    productivity = np.clip((recalled - worst) / span, 0, 1)
    return 1 - similarity * (1 - productivity)


class Curiosity(IntrinsicReward):
    """R_curiosity of every step, and the memory and novelty estimates it rests on.

    An episode is rewarded for what was known before it; `remember` adds it to what is known.
    Without a memory all is relevant: the bonus is the novelty.
    """

    largest = 1.0

    def __init__(
        self,
        memory: MemoryConfig | None,
        novelty_config: NoveltyConfig,
        engine: str,
        observation_space: Box | Discrete,
        observation_size: int,
        streams: Streams,
    ) -> None:
        self.memory = None if memory is None else EpisodicMemory(memory, observation_size)
        # States are compared as this normaliser sees them; one-hot states as they are.
        self.normaliser = RunningNormaliser(observation_size)
        self.steps = 0  # remembered or not
        self.discrete = isinstance(observation_space, Discrete)
        self.novelty = novelty(novelty_config, engine, observation_space, self.normaliser, streams)

    def bonus(self, episode: Episode) -> Bonus:
        """R_curiosity of each step: novelty × relevance of the state it led to."""
        states = episode.observations[1:]
        new = self.novelty(states)
        if self.memory is None:
            return Bonus(new, new, np.ones(len(new)))
        if len(self.memory) == 0:
            return Bonus(new, new, np.ones(len(new)), np.zeros(len(new)))
        recollection = self.memory.lookup(
            torch.from_numpy(states),
            torch.from_numpy(self.normaliser.mean.astype(np.float32)),
            torch.from_numpy(self.scale().astype(np.float32)),
        )
        similarity, recalled = recollection.similarity.numpy(), recollection.values[:, -1].numpy()
        remembered = self.memory.values[: len(self.memory), -1].numpy()
        worst, best = float(remembered.min()), float(remembered.max())
        relevant = relevance(similarity.astype(np.float64), recalled, worst, best)
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
        if self.memory is not None:
            self._memorise(self.memory, episode, returns)
        if not self.discrete:
            self.normaliser.update(episode.observations[1:])
        self.novelty.observe(episode.observations[1:])

    def _memorise(self, memory: EpisodicMemory, episode: Episode, returns: np.ndarray) -> None:
        # One step in so many, counted across episodes, and the last, which had the outcome.
        every = memory.config.write_every
        chosen = np.arange(-self.steps % every, len(episode), every)
        chosen = np.union1d(chosen, len(episode) - 1)
        self.steps += len(episode)
        memory.write(
            torch.from_numpy(episode.observations[:-1][chosen]),
            torch.from_numpy(episode.observations[1:][chosen]),
            torch.from_numpy(episode.rewards[chosen]),
            torch.from_numpy(returns[chosen]),
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {
            "memory": None if self.memory is None else self.memory.state_dict(),
            "steps": self.steps,
            "normaliser": self.normaliser.state_dict(),
            "novelty": self.novelty.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        if self.memory is not None:
            self.memory.load_state_dict(state["memory"])
        self.steps = state["steps"]
        self.normaliser.load_state_dict(state["normaliser"])
        self.novelty.load_state_dict(state["novelty"])
