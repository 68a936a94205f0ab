"""Novelty of states, in [0, 1]: the interface, and k-NN distances with a density estimator."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from mace_rl.base.rng import Streams
from mace_rl.base.state import HasState, Stateful
from mace_rl.bonus.density import DensityEstimator
from mace_rl.config.bonus import NoveltyConfig
from mace_rl.numerics.adam import Adam
from mace_rl.numerics.arrays import quantile
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import exp, fma
from mace_rl.numerics.finite import require_finite
from mace_rl.numerics.nearest import Neighbours
from mace_rl.numerics.normaliser import RunningNormaliser, standardised

KNOWN = 0.9  # the share of visited states that count as known


class Novelty(HasState):
    """How new the states of an episode are; `observe` then makes them known.

    A user's own is made as Class(size, generator, **arguments), with the size of an observation (a
    Discrete one is one-hot).
    """

    @abstractmethod
    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Novelty of each state, [T, observation] → float64 [T] in [0, 1]."""

    def continued(self, states: np.ndarray, visits: Mapping[bytes, int]) -> np.ndarray:
        """The same for states in the middle of an episode.

        visits: of the episode so far to each state, by its bytes.
        """
        return self(states)

    @abstractmethod
    def observe(self, states: np.ndarray) -> None:
        """Take in an episode's states, [T, observation]."""


class DensityNovelty(Stateful, Novelty):
    """An ensemble of k-NN distances combined with a neural density estimator (paper, supplement).

    Both refer to a buffer that covers the visited states, normalised by `normaliser`, which the
    caller updates. Both have a threshold from a sample of visited states: `KNOWN` of these are no
    farther from their neighbours and no less likely. Up to the threshold novelty is 0.

    - k-NN: 1 - d*/d, with d the mean distance to the k nearest visited states and d* the threshold;
      the mean over the ensemble's ks.
    - Density: 1 - exp(-(l* - l) / D), with l the log-density, l* the threshold, and D the number of
      dimensions that vary.

    `refresh` updates all of this at an episode's end, after at least `refresh_every` steps.
    """

    STATE = (
        *("buffer", "seen", "steps", "refreshed", "pending", "optimiser", "batches"),
        *("distance_thresholds", "log_density_threshold", "mean", "std", "varied"),
    )

    def __init__(
        self, config: NoveltyConfig, normaliser: RunningNormaliser, streams: Streams
    ) -> None:
        size = len(normaliser.mean)
        self.config, self.normaliser = config, normaliser
        self.buffer = np.zeros((config.buffer_size, size), np.float32)
        self.seen = 0  # states in the buffer
        self.steps = 0  # states ever observed, of which one in `write_every` is written
        self.refreshed = 0  # value of `steps` at the last refresh
        self.pending = np.empty((0, size), np.float32)  # states to write at the next one
        self.density = DensityEstimator(size, config.density_hidden_units, streams["density"])
        self.optimiser = Adam(self.density.parameters, config.density_learning_rate)
        self.batches = streams["density_batches"]
        self.distance_thresholds = np.zeros(len(config.neighbours))  # d*
        self.log_density_threshold = 0.0  # l*
        self.ensemble = np.array(sorted(config.neighbours))
        self.largest = max(config.neighbours)
        self._build_index(normaliser)

    @property
    def visited(self) -> np.ndarray:
        """The states in the buffer, [n, observation]."""
        return self.buffer[: self.seen]

    def _build_index(self, normaliser: Any) -> None:
        # Until the next refresh; normaliser: has `mean`, `std` and `varied`.
        self.mean, self.std = normaliser.mean.copy(), normaliser.std.copy()
        self.varied = normaliser.varied.copy()
        self.dimensions = max(1, int(self.varied.sum()))  # D
        self.neighbours = Neighbours(self.visited, self.mean, self.std)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """As `Novelty` says; 1 until the buffer has more states than the largest k."""
        if self.seen <= self.largest:
            return np.ones(len(states))
        weight = self.config.knn_weight
        return weight * self.knn_novelty(states) + (1 - weight) * self.density_novelty(states)

    def knn_novelty(self, states: np.ndarray) -> np.ndarray:
        """The k-NN part, [T, observation] → float64 [T] in [0, 1)."""
        squared_distances, _ = self.neighbours.nearest(states, self.largest)
        return shares_beyond(squared_distances, self.ensemble, self.distance_thresholds)

    def density_novelty(self, states: np.ndarray) -> np.ndarray:
        """The density part, [T, observation] → float64 [T] in [0, 1]."""
        log_probs = self.density.log_prob(standardised(states, self.mean, self.std, np.inf))
        return improbability(log_probs, self.log_density_threshold, self.dimensions)

    def observe(self, states: np.ndarray) -> None:
        """Take in an episode's states, one in `write_every` to be written at the next refresh."""
        chosen = states[-self.steps % self.config.write_every :: self.config.write_every]
        self.pending = np.concatenate([self.pending, chosen])
        self.steps += len(states)
        if self.steps - self.refreshed >= self.config.refresh_every:
            self.refresh()

    def refresh(self) -> None:
        """Write what waits, train the density estimator, and measure the thresholds.

        Whether a pending state is new is judged by the old thresholds: the new ones depend on it.
        """
        free = self.pending[: len(self.buffer) - self.seen]
        self.buffer[self.seen : self.seen + len(free)] = free
        self.seen += len(free)
        self._build_index(self.normaliser)
        if len(self.pending) > len(free) and self._replace_redundant(self.pending[len(free) :]):
            self._build_index(self.normaliser)
        self.pending, self.refreshed = self.pending[:0], self.steps
        if self.seen <= self.largest:
            return
        shape = self.config.density_steps, self.config.density_batch_size
        samples = self.visited[self.batches.integers(self.seen, size=shape)]
        for sample in samples:
            self.optimiser.step(-self.density.gradient(self.normaliser(sample)))
        log_probs = self.density.log_prob(self.normaliser(samples[-1]))
        require_finite("a log-density", log_probs)
        self.log_density_threshold = quantile(log_probs.astype(np.float64), 1 - KNOWN)
        count = self.config.calibration_states
        known = samples[-1][:count]  # which were drawn alike
        if count > len(known):
            known = self.visited[self.batches.integers(self.seen, size=count)]
        squared_distances, _ = self.neighbours.nearest(known, self.largest + 1)
        others = np.ascontiguousarray(squared_distances[:, 1:])  # the nearest is itself
        distances = np.ascontiguousarray(mean_distances(others, self.ensemble).T)
        self.distance_thresholds = np.array([quantile(column, KNOWN) for column in distances])

    def _replace_redundant(self, states: np.ndarray) -> bool:
        """Let states far from the buffer replace entries close to others; whether any was replaced.

        Distances are those to the k-th neighbour, with the largest k: so many states in the buffer
        make a place known, also where they are equal. States without novelty are skipped.
        """
        states = states[self.knn_novelty(states) > 0]
        if len(states) == 0:
            return False
        k, buffer = self.largest, self.neighbours
        size = self.config.calibration_states
        sample = np.unique(self.batches.integers(len(self.buffer), size=size))
        apart = buffer.nearest(states, k)[0][:, -1]
        squared, neighbours = buffer.nearest(self.buffer[sample], k + 1)
        new = replacements(states, apart, squared[:, -1], neighbours, sample, buffer.std)
        self.buffer[sample[new >= 0]] = states[new[new >= 0]]
        return bool((new >= 0).any())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._build_index(self)


@kernel
def mean_distances(squared_distances, neighbours):
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
def shares_beyond(squared_distances, neighbours, thresholds):
    """The mean over the ensemble of 1 - d*/d where d is beyond its threshold d*, else 0: [T].

    d: of `mean_distances`. Where states repeat exactly, d, d* and the result are 0.
    """
    distances = mean_distances(squared_distances, neighbours)
    result = np.zeros(len(squared_distances))
    for t in range(len(distances)):
        for i in range(len(thresholds)):
            if not distances[t, i] <= thresholds[i]:  # so written, NaN stays NaN
                result[t] += 1 - thresholds[i] / distances[t, i]
        result[t] /= len(thresholds)
    return result


@kernel
def improbability(log_probs, threshold, dimensions):
    """1 - exp(-(l* - l) / D) where l is below the threshold l*, else 0: float64 [T]."""
    result = np.zeros(len(log_probs))
    for t in range(len(log_probs)):
        below = np.float32(threshold) - log_probs[t]
        if not below <= 0:  # so written, NaN stays NaN
            result[t] = 1 - exp(-below / np.float32(dimensions))
    return result


@kernel
def replacements(states, apart, redundancy, neighbours, sample, std):
    """Which of the new states takes the place of each of the sampled entries, -1 for none, [S].

    apart, redundancy: squared distance of each new state, [N], and of each sampled entry, [S], to
    its k-th neighbour in the buffer; neighbours: places of the entries' neighbours, [S, k + 1].

    The farthest state replaces the closest entry, and so on. States close to one that was put in
    are skipped, as are entries of whose neighbours one was replaced.
    """
    apart = apart.copy()
    chosen = np.full(len(sample), -1)
    for old in np.argsort(redundancy, kind="mergesort"):  # a stable sort
        new = int(np.argmax(apart))
        if not apart[new] > redundancy[old]:
            break
        gone = False
        for other in range(len(sample)):
            if chosen[other] >= 0:
                gone |= bool(np.any(neighbours[old] == sample[other]))
        if gone:
            continue
        chosen[old] = new
        for n in range(len(states)):
            squared = np.float32(0)
            for i in range(len(std)):
                difference = (states[n, i] - states[new, i]) / std[i]
                squared = fma(difference, difference, squared)
            apart[n] = min(apart[n], squared)
    return chosen
