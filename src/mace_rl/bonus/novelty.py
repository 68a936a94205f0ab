"""Novelty of states, in [0, 1]: visitation counts, or k-NN distances and a density estimator."""

import math
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.bonus.density import DensityEstimator
from mace_rl.config.bonus import NoveltyConfig
from mace_rl.config.plugins import make
from mace_rl.config.section import ConfigError
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.arrays import quantile
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import exp, fma
from mace_rl.numerics.finite import require_finite
from mace_rl.numerics.nearest import Neighbours
from mace_rl.numerics.normaliser import RunningNormaliser, standardised
from mace_rl.state import Stateful
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
            return DensityNovelty(config, normaliser, streams)
        case "custom" if config.estimator is not None:
            key, given = "novelty.estimator", (size, streams["novelty"])
            return make(config.estimator, key, Novelty, False, *given, **config.arguments)
    raise ConfigError(
        f"novelty.kind is {kind!r}, but the observations are {space}: 'counts' is for Discrete"
        " ones, 'density' for Box"
    )


class CountNovelty(Stateful, Novelty):
    """1 / n(s) with counts that decay (paper, supplement): for Discrete observations.

    n(s) counts this visit too, those earlier in the episode included, so a first visit has
    novelty 1. After each episode all counts are multiplied by `count_decay`.
    """

    STATE = ("counts",)

    def __init__(self, config: NoveltyConfig, observation_size: int) -> None:
        self.config = config
        self.counts = np.zeros(observation_size)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """See `Novelty`; states are one-hot."""
        return self.continued(states, np.zeros_like(self.counts))

    def continued(self, states: np.ndarray, visits: np.ndarray) -> np.ndarray:
        counts = self.counts + visits
        novelty = np.empty(len(states))
        for t, state in enumerate(states.argmax(axis=1)):
            counts[state] += 1
            novelty[t] = 1 / counts[state]
        return novelty

    def observe(self, states: np.ndarray) -> None:
        """See `Novelty`; states are one-hot."""
        self.counts = (self.counts + states.sum(axis=0)) * self.config.count_decay


class DensityNovelty(Stateful, Novelty):
    """An ensemble of k-NN distances combined with a neural density estimator (paper, supplement).

    Both refer to a buffer that covers the visited states, as `normaliser` sees them, whose owner
    keeps it up to date. Both are measured against what is usual there: a sample of visited states
    says how far a known state is from its neighbours, and how likely. A state no farther and no
    less likely than `KNOWN` of them has novelty 0.

    - k-NN: 1 - d*/d, with d the mean distance to the k nearest visited states and d* what is usual;
      the mean over the ensemble's ks.
    - Density: 1 - exp(-(l* - l) / D), with l the log-density, l* what is usual, in nats per
      dimension, of D that vary.

    All of this is brought up to date, `refresh`, at the first end of an episode at which
    `refresh_every` steps have been taken since it was last; in between nothing changes.
    """

    STATE = (
        *("buffer", "seen", "steps", "refreshed", "waiting", "optimiser", "batches"),
        *("usual_distances", "usual_log_density", "mean", "std", "varied"),
    )

    def __init__(
        self,
        config: NoveltyConfig,
        normaliser: RunningNormaliser,
        streams: Streams,
    ) -> None:
        size = len(normaliser.mean)
        self.config = config
        self.normaliser = normaliser
        self.buffer = np.zeros((config.buffer_size, size), np.float32)
        self.seen = 0  # states written until the buffer was full
        self.steps = 0  # states ever observed, of which one in `write_every` is written
        self.refreshed = 0  # at which of these steps
        self.waiting = np.empty((0, size), np.float32)  # states to be written since then
        self.density = DensityEstimator(size, config.density_hidden_units, streams["density"])
        self.optimiser = Adam(self.density.network.parameters, config.density_learning_rate)
        self.batches = streams["density_batches"]
        self.usual_distances = np.zeros(len(config.neighbours))
        self.usual_log_density = 0.0
        self.ensemble = np.array(sorted(config.neighbours))
        self.largest = max(config.neighbours)
        self._build_index(normaliser.mean, normaliser.std, normaliser.varied)

    @property
    def visited(self) -> np.ndarray:
        """The states in the buffer, [n, observation]."""
        return self.buffer[: self.seen]

    def _build_index(self, mean: np.ndarray, std: np.ndarray, varied: np.ndarray) -> None:
        """Prepare what states are compared with until the next refresh."""
        self.mean, self.std, self.varied = mean.copy(), std.copy(), varied.copy()
        self.dimensions = max(1, int(varied.sum()))  # of the observation, that vary
        self.neighbours = Neighbours(self.visited, mean, std)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """See `Novelty`. 1 everywhere until the buffer has more states than the largest k."""
        if self.seen <= self.largest:
            return np.ones(len(states))
        weight = self.config.knn_weight
        return weight * self.knn_novelty(states) + (1 - weight) * self.density_novelty(states)

    def knn_novelty(self, states: np.ndarray) -> np.ndarray:
        """The k-NN part, [T, observation] → float64 [T] in [0, 1)."""
        squared_distances, _ = self.neighbours.nearest(states, self.largest)
        return shares_beyond(squared_distances, self.ensemble, self.usual_distances)

    def density_novelty(self, states: np.ndarray) -> np.ndarray:
        """The density part, [T, observation] → float64 [T] in [0, 1]."""
        log_probs = self.density.log_prob(standardised(states, self.mean, self.std, np.inf))
        return improbability(log_probs, self.usual_log_density, self.dimensions)

    def observe(self, states: np.ndarray) -> None:
        """Take in an episode's states, one in `write_every` to be written at the next refresh."""
        chosen = states[-self.steps % self.config.write_every :: self.config.write_every]
        self.waiting = np.concatenate([self.waiting, chosen])
        self.steps += len(states)
        if self.steps - self.refreshed >= self.config.refresh_every:
            self.refresh()

    def refresh(self) -> None:
        """Write what waits, train the density estimator, and see what is usual now.

        What waits is new or not by what was usual until now: what is usual depends on the buffer
        with it.
        """
        free = self.waiting[: len(self.buffer) - self.seen]
        self.buffer[self.seen : self.seen + len(free)] = free
        self.seen += len(free)
        normaliser = self.normaliser
        self._build_index(normaliser.mean, normaliser.std, normaliser.varied)
        if len(self.waiting) > len(free) and self._replace_redundant(self.waiting[len(free) :]):
            self._build_index(normaliser.mean, normaliser.std, normaliser.varied)
        self.waiting, self.refreshed = self.waiting[:0], self.steps
        if self.seen <= self.largest:
            return
        shape = self.config.density_steps, self.config.density_batch_size
        samples = self.visited[self.batches.integers(self.seen, size=shape)]
        for sample in samples:
            self.optimiser.step(-self.density.gradient(normaliser(sample)))
        log_probs = self.density.log_prob(normaliser(samples[-1]))
        require_finite("a log-density", log_probs)
        self.usual_log_density = quantile(log_probs.astype(np.float64), 1 - KNOWN)
        known = samples[-1][: self.config.calibration_states]
        squared_distances, _ = self.neighbours.nearest(known, self.largest + 1)
        others = np.ascontiguousarray(squared_distances[:, 1:])  # the nearest is itself
        distances = np.ascontiguousarray(mean_distances(others, self.ensemble).T)
        self.usual_distances = np.array([quantile(column, KNOWN) for column in distances])

    def _replace_redundant(self, states: np.ndarray) -> bool:
        """Let states that are far from the buffer take the places of entries close to others.

        Far and close by the k-th neighbour, with the largest k: a place is known that has so many
        states in the buffer, also where they are equal. States without novelty are close already.
        Returns whether anything was replaced.
        """
        states = states[self.knn_novelty(states) > 0]
        if len(states) == 0:
            return False
        k, buffer = self.largest, self.neighbours
        sample = self.batches.integers(len(self.buffer), size=self.config.calibration_states)
        sample = np.unique(sample)
        apart = buffer.nearest(states, k)[0][:, -1]
        squared, neighbours = buffer.nearest(self.buffer[sample], k + 1)
        redundant_first = np.argsort(squared[:, -1], kind="stable")
        new = replacements(
            states, apart, squared[:, -1], neighbours, sample, redundant_first, buffer.std
        )
        self.buffer[sample[new >= 0]] = states[new[new >= 0]]
        return bool((new >= 0).any())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._build_index(self.mean, self.std, self.varied)


@kernel
def mean_distances(squared_distances: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Mean distance to the k nearest, for each k of `neighbours`, float64 [T, ensemble].

    squared_distances: float32 [T, at least the largest k], nearest first; neighbours: ascending.
    """
    result = np.empty((len(squared_distances), len(neighbours)))
    for t in range(len(squared_distances)):
        total, place = 0.0, 0
        for i in range(len(neighbours)):
            while place < neighbours[i]:
                total += math.sqrt(np.float64(squared_distances[t, place]))
                place += 1
            result[t, i] = total / neighbours[i]
    return result


@kernel
def shares_beyond(
    squared_distances: np.ndarray, neighbours: np.ndarray, usual: np.ndarray
) -> np.ndarray:
    """The mean over the ensemble of 1 - d*/d where d is beyond the `usual` d*, else 0: [T].

    d: of `mean_distances`. Where states repeat exactly both are 0, and what is known is still not
    new.
    """
    distances, result = (
        mean_distances(squared_distances, neighbours),
        np.zeros(len(squared_distances)),
    )
    for t in range(len(distances)):
        for i in range(len(usual)):
            if not distances[t, i] <= usual[i]:  # so written, NaN stays NaN
                result[t] += 1 - usual[i] / distances[t, i]
        result[t] /= len(usual)
    return result


@kernel
def improbability(log_probs: np.ndarray, usual: float, dimensions: int) -> np.ndarray:
    """1 - exp(-(l* - l) / D) where l is below the `usual` l*, else 0: float64 [T]."""
    result = np.zeros(len(log_probs))
    for t in range(len(log_probs)):
        below = np.float32(usual) - log_probs[t]
        if not below <= 0:  # so written, NaN stays NaN
            result[t] = 1 - exp(-below / np.float32(dimensions))
    return result


@kernel
def replacements(
    states: np.ndarray,
    apart: np.ndarray,
    redundancy: np.ndarray,
    neighbours: np.ndarray,
    sample: np.ndarray,
    redundant_first: np.ndarray,
    std: np.ndarray,
) -> np.ndarray:
    """Which of the new states takes the place of each of the sampled entries, -1 for none, [S].

    apart: squared distance of each new state, [N], to its k-th neighbour in the buffer, redundancy:
    of each sampled entry, [S], whose neighbours' places are in `neighbours`, [S, k + 1]. One after
    the other, the farthest first: a state is not put in beside its like, and an entry of whose
    neighbours one has just gone is not redundant any more.
    """
    apart = apart.copy()
    chosen = np.full(len(sample), -1)
    for old in redundant_first:
        new = int(np.argmax(apart))
        if not apart[new] > redundancy[old]:
            break
        kept = True
        for other in range(len(sample)):
            if chosen[other] >= 0:
                kept &= not np.any(neighbours[old] == sample[other])
        if not kept:
            continue
        chosen[old] = new
        for n in range(len(states)):
            squared = np.float32(0)
            for i in range(len(std)):
                difference = (states[n, i] - states[new, i]) / std[i]
                squared = fma(difference, difference, squared)
            apart[n] = min(apart[n], squared)
    return chosen
