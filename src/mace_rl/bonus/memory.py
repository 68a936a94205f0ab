"""Episodic memory: a differentiable neural dictionary (paper, supplement; Pritzel et al. 2017)."""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from mace_rl.config.bonus import MemoryConfig
from mace_rl.nearest import Neighbours


class EpisodicMemory:
    """A fixed number of (key, value) entries; the least recently used one is overwritten.

    Keys are states as observed. They are compared in an embedding that the caller gives, here the
    running standardisation, so that stored keys follow it as it changes: `lay_out` prepares that
    once, for all that is asked until the next `write`.

    A value is (next state, reward, return-to-go): what came of being in the state.
    """

    def __init__(self, config: MemoryConfig, key_size: int) -> None:
        self.config = config
        self.keys = torch.zeros(config.capacity, key_size)
        self.values = torch.zeros(config.capacity, key_size + 2)
        # For each entry the time of its last reading or writing, and its number among all that were
        # ever written, from 1; 0 for an empty one.
        self.usage = np.zeros(config.capacity, np.int64)
        self.number = np.zeros(config.capacity, np.int64)
        self.time = 0
        self.read = np.zeros(config.capacity, np.bool_)  # entries, since the last `write`
        self.neighbours: Neighbours | None = None

    def __len__(self) -> int:
        return int(np.count_nonzero(self.usage))

    def write(self, keys: Tensor, next_states: Tensor, rewards: Tensor, returns: Tensor) -> None:
        """Store N experiences over the least recently used entries.

        keys, next_states: [N, key]; rewards, returns: [N]. Of more than `capacity` the last ones
        are stored. What was read since the last time counts as used first, all at the same time.
        """
        if self.read.any():
            self.time += 1
            self.usage[self.read] = self.time
            self.read[:] = False
        self.time += 1
        written = [part.numpy()[-self.config.capacity :] for part in (keys, next_states)]
        outcome = [part.numpy()[-self.config.capacity :] for part in (rewards, returns)]
        # A lookup of a long episode reads nearly every entry: of equally used ones the earliest
        # written goes, or entries that are read for ever would never be outdated.
        count = len(written[0])
        oldest = np.lexsort((self.number, self.usage))[:count]
        values = self.values.numpy()
        self.keys.numpy()[oldest], values[oldest, :-2] = written
        values[oldest, -2], values[oldest, -1] = outcome
        self.usage[oldest] = self.time
        self.number[oldest] = self.number.max() + np.arange(1, count + 1)
        self.neighbours = None

    def lay_out(self, mean: np.ndarray, std: np.ndarray) -> None:
        """From now on distances are Euclidean between (x - mean) / std; both are [key]."""
        # Of equally near entries the first is read: the last written, so that what came of a state
        # lately is what is remembered of it.
        self.newest_first = np.argsort(-self.number[: len(self)])
        self.neighbours = Neighbours(self.keys.numpy()[self.newest_first], mean, std)

    def search(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The k nearest entries to each state, float32 [N, key], which have been read now.

        Returns squared distances per dimension, so that the kernel does not depend on how many
        there are, float32 [N, k] ascending, and the entries, int64 [N, k]. Raises `LookupError` if
        nothing is stored, or `lay_out` was not called since the last `write`.
        """
        if not self.neighbours:
            raise LookupError("the episodic memory is empty, or not laid out since it was written")
        count = min(self.config.neighbours, len(self.neighbours))
        squared_distances, places = self.neighbours.nearest(states, count)
        entries = self.newest_first[places]
        self.read[entries] = True
        return squared_distances / np.float32(states.shape[1]), entries

    def recall(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Kernel-weighted mean of the k nearest entries' values, and how similar the nearest is.

        states: float32 [N, key]. The kernel is 1 / (d² + δ) (Pritzel et al. 2017, eq. 5). Returns
        float32 [N, value], and [N] in (0, 1]: the kernel at the nearest key over the kernel at 0.
        """
        return recollect(*self.search(states), self.values.numpy(), self.config.kernel_bandwidth)

    def lookup(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """`recall` as autograd can follow it, with respect to `queries` and `values`.

        For whoever trains through the memory; the method does not. Which entries are nearest has
        no gradient.
        """
        _, entries = self.search(queries.detach().float().numpy())
        chosen = torch.from_numpy(entries)  # [N, k]
        assert self.neighbours is not None  # else `search` has raised
        squares = (queries[:, None] - self.keys[chosen]) / torch.from_numpy(self.neighbours.std)
        kernel = 1 / (squares.square().mean(-1) + self.config.kernel_bandwidth)
        weights = kernel / kernel.sum(1, keepdim=True)
        values = (weights[..., None] * self.values[chosen]).sum(1)
        return values, self.config.kernel_bandwidth * kernel[:, 0]  # the nearest comes first

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        counters = {"usage": self.usage, "number": self.number, "read": self.read}
        tensors = {name: torch.from_numpy(counter) for name, counter in counters.items()}
        return {"keys": self.keys, "values": self.values, "time": self.time, **tensors}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned; to be laid out before the next look-up."""
        self.keys, self.values = state["keys"].clone(), state["values"].clone()
        counters = (state[name].numpy().copy() for name in ("usage", "number", "read"))
        self.usage, self.number, self.read = counters
        self.time = state["time"]
        self.neighbours = None


@njit(cache=True, error_model="numpy")
def recollect(
    squared_distances: np.ndarray, indices: np.ndarray, values: np.ndarray, bandwidth: float
) -> tuple[np.ndarray, np.ndarray]:
    """What `EpisodicMemory.recall` computes from the nearest entries.

    squared_distances: float32 [N, k], ascending; indices: int64 [N, k], rows of values, float32
    [M, value].
    Returns float32 [N, value] and [N]. Compiled, as a dozen operations of torch take longer than
    the search for the entries.
    """
    recalled = np.zeros((len(squared_distances), values.shape[1]), np.float32)
    similarity = np.empty(len(squared_distances), np.float32)
    for n in range(len(squared_distances)):
        kernel = 1 / (squared_distances[n] + bandwidth)
        total = kernel.sum()
        for i in range(len(kernel)):
            weight = np.float32(kernel[i] / total)
            row = values[indices[n, i]]
            for j in range(len(row)):
                recalled[n, j] += weight * row[j]
        similarity[n] = bandwidth * kernel[0]
    return recalled, similarity
