"""Novelty of states, in [0, 1]: visitation counts, or k-NN distances and a density estimator."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from numba import njit

from mace_rl.agent.adam import Adam
from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.bonus.density import DensityEstimator
from mace_rl.config.bonus import NoveltyConfig
from mace_rl.config.plugins import make
from mace_rl.config.section import ConfigError
from mace_rl.finite import require_finite
from mace_rl.nearest import Neighbours, nearest
from mace_rl.streams import Streams

KNOWN = 0.9  # the share of visited states that count as known


class Novelty(ABC):
    """How new the states of an episode are; `observe` then makes them known.

    One of the user's own is made as Class(size, generator, **arguments), with the size of an
    observation (a Discrete one is one-hot).
    """

    @abstractmethod
    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Novelty of each state, [T, observation] → float64 [T] in [0, 1]."""

    def continued(self, states: np.ndarray, visits: np.ndarray) -> np.ndarray:
        """The same when the episode came to others before.

        visits: how often to each of the Discrete ones, [observation]; of Box ones 0.
        """
        return self(states)

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
        case "density" if isinstance(space, Box):
            return DensityNovelty(config, engine, normaliser, streams)
        case "custom" if config.estimator is not None:
            given = size, streams["novelty"]
            return make(config.estimator, "novelty.estimator", *given, **config.arguments)
    raise ConfigError(
        f"novelty.kind is {kind!r}, but the observations are {space}: 'counts' is for Discrete"
        " ones, 'density' for Box"
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
        return self.continued(states, np.zeros_like(self.counts))

    def continued(self, states: np.ndarray, visits: np.ndarray) -> np.ndarray:
        """See `Novelty`."""
        counts = self.counts + visits
        novelty = np.empty(len(states))
        for t, state in enumerate(states.argmax(axis=1)):
            counts[state] += 1
            novelty[t] = 1 / counts[state]
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

    Both refer to a buffer that covers the visited states, as `normaliser` sees them, whose owner
    brings it up to date before each `observe` and `load_state_dict`: once it is full, a state that
    is far from it takes the place of one that is close to another. Both are measured against what
    is usual there: after each episode a sample of visited states says how far a known state is from
    its neighbours, and how likely. A state no farther and no less likely than `KNOWN` of them has
    novelty 0.

    - k-NN: 1 - d*/d, with d the mean distance to the k nearest visited states and d* what is usual;
      the mean over the ensemble's ks.
    - Density: 1 - exp(-(l* - l) / D), with l the log-density, l* what is usual, in nats per
      dimension, of D that vary.
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
        self.seen = 0  # states written until the buffer was full
        self.steps = 0  # states ever observed, of which one in `write_every` is written
        self.density = DensityEstimator(
            size, config.density_hidden_units, engine, streams["density"]
        )
        self.optimiser = Adam(self.density.network.parameters, config.density_learning_rate)
        self.batches = streams["density_batches"]
        self.usual_distances = np.zeros(len(config.neighbours))
        self.usual_log_density = 0.0
        self.ensemble = np.array(config.neighbours)
        self.largest = max(config.neighbours)
        self._lay_out()

    @property
    def visited(self) -> np.ndarray:
        """The states in the buffer, [n, observation]."""
        return self.buffer[: min(self.seen, len(self.buffer))]

    def _lay_out(self) -> None:
        """Prepare what states are compared with until the next ones are observed."""
        self.mean, self.std = self.normaliser.mean, self.normaliser.std
        self.dimensions = max(1, int(self.normaliser.varied.sum()))  # of the observation, that vary
        self.neighbours = Neighbours(self.visited, self.mean, self.std)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """See `Novelty`. 1 everywhere until the buffer has more states than the largest k."""
        if self.seen <= self.largest:
            return np.ones(len(states))
        weight = self.config.knn_weight
        return weight * self.knn_novelty(states) + (1 - weight) * self.density_novelty(states)

    def knn_novelty(self, states: np.ndarray) -> np.ndarray:
        """The k-NN part, [T, observation] → float64 [T] in [0, 1)."""
        squared_distances, _ = self.neighbours.nearest(states, self.largest)
        beyond = share_beyond(squared_distances, self.ensemble, self.usual_distances)
        return np.add.reduce(beyond, axis=1) / len(self.ensemble)

    def density_novelty(self, states: np.ndarray) -> np.ndarray:
        """The density part, [T, observation] → float64 [T] in [0, 1]."""
        log_probs = self.density.log_prob(standardised(states, self.mean, self.std))
        return 1 - np.exp(-lack(log_probs, self.usual_log_density) / self.dimensions)

    def observe(self, states: np.ndarray) -> None:
        """Add one in `write_every` of an episode's states and train the density estimator."""
        chosen = states[-self.steps % self.config.write_every :: self.config.write_every]
        self.steps += len(states)
        free = len(self.buffer) - self.seen
        self.buffer[self.seen : self.seen + len(chosen[:free])] = chosen[:free]
        self.seen += len(chosen[:free])
        if len(chosen) > free:
            self._replace_redundant(chosen[free:])
        self._lay_out()
        visited = self.visited
        if len(visited) <= self.largest:
            return
        shape = self.config.density_steps, self.config.density_batch_size
        samples = visited[self.batches.integers(len(visited), size=shape)]
        for sample in self.normaliser(samples):
            self.optimiser.step(-self.density.gradient(sample))
        log_probs = self.density.log_prob(self.normaliser(samples[-1]))
        require_finite("a log-density", log_probs)
        self.usual_log_density = float(np.quantile(log_probs, 1 - KNOWN))
        known = samples[-1][: self.config.calibration_states]
        squared_distances, _ = self.neighbours.nearest(known, self.largest + 1)
        distances = mean_distances(squared_distances[:, 1:], self.ensemble)  # the nearest is itself
        self.usual_distances = np.quantile(distances, KNOWN, axis=0)

    def _replace_redundant(self, states: np.ndarray) -> None:
        """Let states that are far from the buffer take the places of entries close to others.

        Far and close by the k-th neighbour, with the largest k: a place is known that has so many
        states in the buffer, also where they are equal. One after the other, the farthest first:
        a state is not put in beside its like, and an entry of whose neighbours one has just gone
        is not redundant any more.
        """
        mean, std = self.normaliser.mean, self.normaliser.std
        buffer = Neighbours(self.buffer, mean, std)
        sample = self.batches.integers(len(self.buffer), size=self.config.calibration_states)
        sample, k = np.unique(sample), self.largest
        apart = buffer.nearest(states, k)[0][:, -1]
        squared, neighbours = buffer.nearest(self.buffer[sample], k + 1)
        gone: set[int] = set()
        for old in np.argsort(squared[:, -1]):
            new = int(np.argmax(apart))
            if not apart[new] > squared[old, -1]:
                break
            if not gone.isdisjoint(neighbours[old].tolist()):
                continue
            gone.add(int(sample[old]))
            self.buffer[sample[old]] = states[new]
            apart = np.minimum(apart, nearest(states, states[[new]], mean, std, 1)[0][:, 0])

    def state_dict(self) -> dict[str, Any]:
        """See `Novelty`."""
        return {
            "buffer": torch.from_numpy(self.visited.copy()),
            "seen": self.seen,
            "steps": self.steps,
            "density": self.optimiser.state_dict(),
            "batches": self.batches.bit_generator.state,
            "usual_distances": torch.from_numpy(self.usual_distances),
            "usual_log_density": self.usual_log_density,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Novelty`."""
        self.buffer[: len(state["buffer"])] = state["buffer"].numpy()
        self.seen, self.steps = state["seen"], state["steps"]
        self.optimiser.load_state_dict(state["density"])
        self.batches.bit_generator.state = state["batches"]
        self.usual_distances = state["usual_distances"].numpy().copy()
        self.usual_log_density = state["usual_log_density"]
        self._lay_out()


# Compiled: for a single state NumPy's calls take longer than the search for its neighbours.


@njit(cache=True, error_model="numpy")
def mean_distances(squared_distances: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Mean distance to the k nearest, for each k of `neighbours`, float64 [T, ensemble].

    squared_distances: float32 [T, at least the largest k], nearest first.
    """
    distances = np.empty((len(squared_distances), len(neighbours)))
    sums = np.empty(squared_distances.shape[1])
    for t in range(len(squared_distances)):
        total = 0.0
        for place in range(len(sums)):
            total += np.sqrt(np.float64(squared_distances[t, place]))
            sums[place] = total
        for i in range(len(neighbours)):
            distances[t, i] = sums[neighbours[i] - 1] / neighbours[i]
    return distances


@njit(cache=True, error_model="numpy")
def share_beyond(
    squared_distances: np.ndarray, neighbours: np.ndarray, usual: np.ndarray
) -> np.ndarray:
    """1 - d*/d of `mean_distances` d beyond the `usual` d*, [ensemble]; else 0: [T, ensemble].

    Where states repeat exactly both are 0, and what is known is still not new.
    """
    shares = mean_distances(squared_distances, neighbours)
    for share in shares:
        for i in range(len(usual)):
            share[i] = 1 - usual[i] / share[i] if share[i] > usual[i] else 0.0
    return shares


@njit(cache=True, error_model="numpy")
def standardised(states: np.ndarray, mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """(states - mean) / std in float64, as float32 [T, size]."""
    result = np.empty(states.shape, np.float32)
    for t in range(len(states)):
        for i in range(len(mean)):
            result[t, i] = (states[t, i] - mean[i]) / std[i]
    return result


@njit(cache=True, error_model="numpy")
def lack(log_probs: np.ndarray, usual: float) -> np.ndarray:
    """How far log-densities, float32 [T], are below the `usual` one, float64; 0 if they are not."""
    result = np.zeros(len(log_probs))
    for t in range(len(log_probs)):
        below = np.float32(usual) - log_probs[t]
        if not below < 0:  # so written, NaN stays NaN
            result[t] = below
    return result
