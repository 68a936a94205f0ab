"""Novelty of states, in [0, 1]: visitation counts, or k-NN distances and a density estimator."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl.agent.adam import Adam
from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.bonus.density import DensityEstimator
from mace_rl.bonus.nearest import nearest
from mace_rl.config.plugins import make
from mace_rl.config.run import NoveltyConfig
from mace_rl.config.section import ConfigError
from mace_rl.finite import require_finite
from mace_rl.streams import Streams


class Novelty(ABC):
    """How new the states of an episode are; `observe` then makes them known.

    One of the user's own is made as Class(size, generator, **arguments), with the size of an
    observation (a Discrete one is one-hot).
    """

    @abstractmethod
    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Novelty of each state, [T, observation] → float64 [T] in [0, 1]."""

    @abstractmethod
    def observe(self, states: np.ndarray) -> None:
        """Take in an episode's states, [T, observation]."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs: tensors, numbers, strings, lists, dicts."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""


def novelty(
    config: NoveltyConfig,
    engine: str,
    space: Box | Discrete,
    normaliser: RunningNormaliser,
    streams: Streams,
) -> Novelty:
    """The novelty that the settings ask for, of observations in `space`."""
    size = len(normaliser.mean)
    kind = config.kind
    if kind == "auto":
        kind = "counts" if isinstance(space, Discrete) else "density"
    match kind:
        case "counts" if isinstance(space, Discrete):
            return CountNovelty(config, size)
        case "density":
            return DensityNovelty(config, engine, normaliser, streams)
        case "custom":
            given = size, streams["novelty"]
            return make(config.estimator, "novelty.estimator", *given, **config.arguments)
    raise ConfigError(
        f"novelty.kind is 'counts', but the observations are {space}, whose states do not repeat"
    )


class CountNovelty(Novelty):
    """1 / n(s) with counts that decay (paper, supplement): for Discrete observations.

    n(s) counts this visit too, those earlier in the episode included, so a first visit has
    novelty 1. After each episode all counts are multiplied by `count_decay`.
    """

    def __init__(self, config: NoveltyConfig, observation_size: int) -> None:
        self.config = config
        self.counts = np.zeros(observation_size)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """See `Novelty`; states are one-hot."""
        counts = self.counts.copy()
        novelty = np.empty(len(states))
        for t, state in enumerate(states.argmax(axis=1)):
            counts[state] += 1
            novelty[t] = 1 / max(counts[state], 1.0)
        return novelty

    def observe(self, states: np.ndarray) -> None:
        """See `Novelty`; states are one-hot."""
        self.counts = (self.counts + states.sum(axis=0)) * self.config.count_decay

    def state_dict(self) -> dict[str, Any]:
        """See `Novelty`."""
        return {"counts": torch.from_numpy(self.counts.copy())}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Novelty`."""
        self.counts = state["counts"].numpy().copy()


class DensityNovelty(Novelty):
    """An ensemble of k-NN distances combined with a neural density estimator (paper, supplement).

    Both refer to a buffer of the last visited states, as `normaliser` sees them, whose owner keeps
    it up to date.

    - k-NN: 1 - exp(-d_k), d_k the mean distance to the k nearest visited states, per dimension
      (root mean square); the mean over the ensemble's ks.
    - Density: the fraction of visited states at which the estimator, trained on the buffer after
      each episode, finds a higher density than here.
    """

    def __init__(
        self,
        config: NoveltyConfig,
        engine: str,
        normaliser: RunningNormaliser,
        streams: Streams,
    ) -> None:
        size = len(normaliser.mean)
        self.config = config
        self.normaliser = normaliser
        self.buffer = np.zeros((config.buffer_size, size), np.float32)
        self.seen = 0  # states ever written; the buffer is a ring
        self.density = DensityEstimator(
            size, config.density_hidden_units, engine, streams["density"]
        )
        self.optimiser = Adam(self.density.network.parameters, config.density_learning_rate)
        self.batches = streams["density_batches"]
        self.reference = np.zeros(0, np.float32)  # sorted log-densities of visited states

    @property
    def visited(self) -> np.ndarray:
        """The states in the buffer, [n, observation]."""
        return self.buffer[: min(self.seen, len(self.buffer))]

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """See `Novelty`. Before anything was visited everything has novelty 1."""
        if self.seen == 0:
            return np.ones(len(states))
        weight = self.config.knn_weight
        return weight * self.knn_novelty(states) + (1 - weight) * self.density_novelty(states)

    def knn_novelty(self, states: np.ndarray) -> np.ndarray:
        """The k-NN part, [T, observation] → float64 [T] in [0, 1)."""
        visited, normaliser = self.visited, self.normaliser
        largest = min(max(self.config.neighbours), len(visited))
        mean, std = normaliser.mean.astype(np.float32), normaliser.std.astype(np.float32)
        squared_distances, _ = nearest(states, visited, mean, std, largest)
        distances = np.sqrt(squared_distances / states.shape[1], dtype=np.float64)
        neighbours = np.minimum(self.config.neighbours, largest)
        means = distances.cumsum(axis=1)[:, neighbours - 1] / neighbours  # [T, ensemble]
        return (1 - np.exp(-means)).mean(axis=1)

    def density_novelty(self, states: np.ndarray) -> np.ndarray:
        """The density part, [T, observation] → float64 [T] in [0, 1]."""
        log_probs = self.density.log_prob(self.normaliser(states))
        return 1 - np.searchsorted(self.reference, log_probs) / len(self.reference)

    def observe(self, states: np.ndarray) -> None:
        """Add one in `write_every` of an episode's states and train the density estimator."""
        chosen = states[:: self.config.write_every]
        indices = np.arange(self.seen, self.seen + len(chosen)) % len(self.buffer)
        self.buffer[indices] = chosen
        self.seen += len(chosen)
        visited = self.visited
        shape = self.config.density_steps, self.config.density_batch_size
        for sample in self.normaliser(visited[self.batches.integers(len(visited), size=shape)]):
            self.optimiser.step(-self.density.gradient(sample))
        self.reference = np.sort(self.density.log_prob(sample))
        require_finite("a log-density", self.reference)

    def state_dict(self) -> dict[str, Any]:
        """See `Novelty`."""
        return {
            "buffer": torch.from_numpy(self.visited.copy()),
            "seen": self.seen,
            "density": self.optimiser.state_dict(),
            "batches": self.batches.bit_generator.state,
            "reference": torch.from_numpy(self.reference),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Novelty`."""
        self.buffer[: len(state["buffer"])] = state["buffer"].numpy()
        self.seen = state["seen"]
        self.optimiser.load_state_dict(state["density"])
        self.batches.bit_generator.state = state["batches"]
        self.reference = state["reference"].numpy().copy()
