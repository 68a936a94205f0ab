"""The curiosity bonus step by step, while an episode goes on.

`Curiosity.bonus` values all states of a finished episode at once. What it compares them with stays
the same until the next episode is remembered; here that is laid out once, after each episode, so
that a single state costs what it costs there: the search among what is known.
"""

from collections import Counter
from typing import Any

import numpy as np
import torch
from numba import njit

from mace_rl.agent.kernels import forward
from mace_rl.agent.network import CompiledMLP
from mace_rl.bonus.curiosity import SMALLEST_SPAN, Curiosity
from mace_rl.bonus.density import SMALLEST_LOG_STD, gaussian_log_probs
from mace_rl.bonus.memory import EpisodicMemory, recollect
from mace_rl.bonus.novelty import CountNovelty, DensityNovelty
from mace_rl.environments.rollout import Episode
from mace_rl.nearest import in_columns, nearest_in_columns


class StepwiseCuriosity:
    """`Curiosity` that pays as states come, for several episodes that go on at once.

    They share what is known. Networks are compiled ones.

    An episode gets what `Curiosity.bonus` would have given for it, as long as no other one is
    remembered meanwhile; the density estimate, whose matrix products are taken in another order,
    within rounding. A novelty of the user's own is asked for one state at a time.
    """

    def __init__(self, curiosity: Curiosity, episodes: int) -> None:
        self.curiosity = curiosity
        self.visits: list[Counter[int]] = [Counter() for _ in range(episodes)]  # discrete states
        self._lay_out()

    def begin(self, episode: int) -> None:
        """Episode number `episode` starts anew."""
        self.visits[episode].clear()

    def bonus(self, state: np.ndarray, episode: int) -> tuple[float, float, float]:
        """R_curiosity of the state that an episode has just come to, its novelty and relevance.

        state: float32 [observation]; episode: its number.
        """
        new, relevant = self._novelty(state, episode), self._relevance(state)
        return new * relevant, new, relevant

    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """See `Curiosity.remember`."""
        memory = self.curiosity.memory
        if memory is not None and len(memory) > 0:
            memory.mark_used(self._newest_first[self._read])  # as one lookup for the episode does
        self.curiosity.remember(episode, returns)
        self._lay_out()

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {
            "curiosity": self.curiosity.state_dict(),
            "visits": [dict(visits) for visits in self.visits],
            "read": torch.from_numpy(self._read),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.curiosity.load_state_dict(state["curiosity"])
        self.visits = [Counter(visits) for visits in state["visits"]]
        self._lay_out()
        self._read = state["read"].numpy().copy()

    def _lay_out(self) -> None:
        """Prepare what states are compared with until the next episode is remembered."""
        novelty, memory = self.curiosity.novelty, self.curiosity.memory
        self._visited: tuple[Any, ...] | None = None  # arguments of `density_novelty`
        if isinstance(novelty, DensityNovelty) and novelty.seen > max(novelty.config.neighbours):
            self._visited = visited(novelty)
            nobody = np.full(max(novelty.config.neighbours), -1)
            self._near = [nobody.copy() for _ in self.visits]  # for each episode
        self._newest_first = np.empty(0, np.int64)
        self._remembered: tuple[Any, ...] | None = None  # arguments of `memory_relevance`
        if memory is not None and len(memory) > 0:
            self._newest_first = np.argsort(-memory.number[: len(memory)])
            self._remembered = self._memory(memory)
        # Entries in that order: whether they were read since they were laid out.
        self._read = np.zeros(len(self._newest_first), np.bool_)
        self._known: dict[int, float] = {}  # relevance of discrete states, as far as asked for

    def _memory(self, memory: EpisodicMemory) -> tuple[Any, ...]:
        mean = self.curiosity.normaliser.mean.astype(np.float32)
        scale = self.curiosity.scale().astype(np.float32)
        keys = memory.keys.numpy()[self._newest_first]
        returns = memory.values.numpy()[self._newest_first, -1:]
        return (
            *(in_columns(keys, mean, scale), mean, scale),
            *(min(memory.config.neighbours, len(keys)), returns, memory.config.kernel_bandwidth),
            *(float(returns.min()), float(returns.max())),
        )

    def _novelty(self, state: np.ndarray, episode: int) -> float:
        if self._visited is not None:
            return density_novelty(state, self._near[episode], *self._visited)
        novelty = self.curiosity.novelty
        if not isinstance(novelty, CountNovelty):
            return float(novelty(state[None])[0])
        number, visits = int(state.argmax()), self.visits[episode]
        visits[number] += 1
        return 1 / (novelty.counts.item(number) + visits[number])

    def _relevance(self, state: np.ndarray) -> float:
        if self._remembered is None:
            return 1.0
        if not self.curiosity.discrete:
            return memory_relevance(state, self._read, *self._remembered)
        number = int(state.argmax())
        if number not in self._known:
            self._known[number] = memory_relevance(state, self._read, *self._remembered)
        return self._known[number]


def visited(novelty: DensityNovelty) -> tuple[Any, ...]:
    """What `density_novelty` compares states with to agree with `novelty` as it is now."""
    config, network = novelty.config, novelty.density.network
    assert isinstance(network, CompiledMLP)  # `StepwiseCuriosity` asks for that
    mean, std = novelty.normaliser.mean, novelty.normaliser.std
    return (
        in_columns(novelty.visited, mean.astype(np.float32), std.astype(np.float32)),
        *(mean, std, np.array(config.neighbours), novelty.usual_distances, config.knn_weight),
        *(network.parameters, network.sizes, novelty.usual_log_density, novelty.dimensions),
    )


@njit(cache=True, error_model="numpy")
def density_novelty(
    state: np.ndarray,
    near: np.ndarray,
    columns: np.ndarray,
    mean: np.ndarray,
    std: np.ndarray,
    neighbours: np.ndarray,
    usual_distances: np.ndarray,
    knn_weight: float,
    parameters: np.ndarray,
    sizes: np.ndarray,
    usual_log_density: float,
    dimensions: float,
) -> float:
    """`DensityNovelty` of one state, float32 [size]; NaN where that is not finite.

    near: int64 [largest k], see `knn_novelty`; columns: the visited states, by `in_columns`; mean,
    std: float64 [size], of the normaliser; parameters, sizes: of the density's network. The rest:
    as it is called there.
    """
    size = len(state)
    standardised = np.empty((1, size), np.float32)
    for i in range(size):
        if not np.isfinite(state[i]):
            return np.nan
        standardised[0, i] = (state[i] - mean[i]) / std[i]
    outputs = forward(standardised[0], parameters, sizes)
    inverse_std = np.empty((1, size), np.float32)
    for i in range(size):
        inverse_std[0, i] = np.exp(-max(outputs[size + i], np.float32(SMALLEST_LOG_STD)))
    log_prob = gaussian_log_probs(standardised, outputs.reshape(1, -1), inverse_std)[0]
    lack = np.float64(np.float32(usual_log_density) - log_prob)
    density = 1 - np.exp(-max(lack, 0.0) / dimensions)
    knn = knn_novelty(state, near, columns, mean, std, neighbours, usual_distances)
    return knn_weight * knn + (1 - knn_weight) * density


@njit(cache=True, error_model="numpy")
def knn_novelty(
    state: np.ndarray,
    near: np.ndarray,
    columns: np.ndarray,
    mean: np.ndarray,
    std: np.ndarray,
    neighbours: np.ndarray,
    usual_distances: np.ndarray,
) -> float:
    """`DensityNovelty.knn_novelty` of one state; arguments as in `density_novelty`.

    near: some places in `columns`, the first -1 for none; those of the nearest states when they
    were searched for last, for a state of the same episode. If these are close enough for the state
    to be known, those nearest to it are as well, and need not be found.
    """
    row = np.zeros(len(columns), np.float32)
    for i in range(len(mean)):
        row[i] = (state[i] - np.float32(mean[i])) * (np.float32(1) / np.float32(std[i]))
    squared_distances = np.empty(len(near), np.float32)
    if near[0] >= 0:
        for place in range(len(near)):
            total = np.float32(0)
            m = near[place]
            for i in range(0, len(row), 4):
                d0, d1 = row[i] - columns[i, m], row[i + 1] - columns[i + 1, m]
                d2, d3 = row[i + 2] - columns[i + 2, m], row[i + 3] - columns[i + 3, m]
                total = total + d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3
            squared_distances[place] = total
        squared_distances.sort()
        if knn_share(squared_distances, neighbours, usual_distances) == 0:
            return 0.0
    found, places = nearest_in_columns(
        state.reshape(1, -1), columns, mean.astype(np.float32), std.astype(np.float32), len(near)
    )
    near[:] = places[0]
    return knn_share(found[0], neighbours, usual_distances)


@njit(cache=True, error_model="numpy")
def knn_share(
    squared_distances: np.ndarray, neighbours: np.ndarray, usual_distances: np.ndarray
) -> float:
    """What follows from the squared distances, ascending, to the nearest states."""
    sums = np.empty(len(squared_distances))
    total = 0.0
    for place in range(len(squared_distances)):
        total += np.sqrt(np.float64(squared_distances[place]))
        sums[place] = total
    result = 0.0
    for i in range(len(neighbours)):
        distance = sums[neighbours[i] - 1] / neighbours[i]
        result += 1 - usual_distances[i] / distance if distance > usual_distances[i] else 0.0
    return result / len(neighbours)


@njit(cache=True, error_model="numpy")
def memory_relevance(
    state: np.ndarray,
    read: np.ndarray,
    columns: np.ndarray,
    mean: np.ndarray,
    scale: np.ndarray,
    neighbours: int,
    returns: np.ndarray,
    bandwidth: float,
    worst: float,
    best: float,
) -> float:
    """Memory relevance of one state, float32 [size]: `EpisodicMemory.lookup`, then `relevance`.

    columns: the memory's keys, by `in_columns` with `mean` and `scale`, float32 [size]; returns:
    float32 [M, 1], in the same order; worst, best: of them; read: bool [M], likewise, where the
    entries that are read become true.
    """
    squared_distances, places = nearest_in_columns(
        state.reshape(1, -1), columns, mean, scale, neighbours
    )
    for place in places[0]:
        read[place] = True
    squared_distances /= np.float32(len(state))
    recalled, similarity = recollect(squared_distances, places, returns, bandwidth)
    span, productivity = best - worst, np.float32(0)
    if span > SMALLEST_SPAN:
        way = (recalled[0, 0] - np.float32(worst)) / np.float32(span)
        productivity = min(max(way, np.float32(0)), np.float32(1))
    return 1 - np.float64(similarity[0]) * (np.float32(1) - productivity)
