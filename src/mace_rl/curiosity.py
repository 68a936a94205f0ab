"""The curiosity bonus: novelty × what the episodic memory says of similar states (paper)."""

from typing import Any

import numpy as np
import torch
from numba import njit

from mace_rl.environments import Environment
from mace_rl.hyperparameters import RunConfig
from mace_rl.memory import EpisodicMemory
from mace_rl.novelty import CountNovelty, DensityNovelty, Novelty
from mace_rl.rollout import Episode
from mace_rl.standardise import RunningStandardiser


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


class Curiosity:
    """R_curiosity of every step, and the memory and novelty estimates it rests on.

    An episode is rewarded for what was known before it; `remember` adds it to what is known.
    """

    def __init__(self, config: RunConfig, environment: Environment) -> None:
        size = environment.observation_size
        self.config = config
        self.memory = EpisodicMemory(config.memory, size)
        # States are compared in running standardisation; one-hot states as they are.
        self.embedding = RunningStandardiser(size)
        self.discrete = environment.discrete_observations
        self.novelty: Novelty = (
            CountNovelty(config.novelty, size)
            if self.discrete
            else DensityNovelty(config.novelty, size, config.seed, self.embedding)
        )

    def bonus(self, episode: Episode) -> np.ndarray:
        """R_curiosity of each step: novelty × relevance of the state it led to, float64 [T]."""
        states = episode.observations[1:]
        novelty = self.novelty(states)
        if len(self.memory) == 0:
            return novelty
        recollection = self.memory.lookup(
            torch.from_numpy(states),
            torch.from_numpy(self.embedding.mean.astype(np.float32)),
            torch.from_numpy(self.scale().astype(np.float32)),
        )
        similarity, recalled = recollection.similarity, recollection.values[:, -1]
        return novelty * relevance(
            similarity.numpy(), recalled.numpy(), self.memory.returns.numpy()
        )

    def scale(self) -> np.ndarray:
        """The unit of distance between states, [observation].

        One-hot states differ in two dimensions however many there are: in this unit by 2 per
        dimension, like independent standardised ones.
        """
        size = len(self.embedding.mean)
        return np.full(size, size**-0.5) if self.discrete else self.embedding.std

    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """Make the episode part of memory and of what is no longer novel.

        returns: extrinsic return-to-go of each step, [T], as its λ-return.
        """
        chosen = slice(None, None, self.config.memory.write_every)
        self.memory.write(
            torch.from_numpy(episode.observations[:-1][chosen]),
            torch.from_numpy(episode.observations[1:][chosen]),
            torch.from_numpy(episode.rewards[chosen]),
            torch.from_numpy(returns[chosen]),
        )
        if not self.discrete:
            self.embedding.update(episode.observations[1:])
        self.novelty.observe(episode.observations[1:])

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {
            "memory": self.memory.state_dict(),
            "embedding": self.embedding.state_dict(),
            "novelty": self.novelty.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.memory.load_state_dict(state["memory"])
        self.embedding.load_state_dict(state["embedding"])
        self.novelty.load_state_dict(state["novelty"])
