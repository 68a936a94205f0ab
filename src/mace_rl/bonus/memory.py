"""Episodic memory: a differentiable neural dictionary (paper, supplement; Pritzel et al. 2017)."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from mace_rl.config.bonus import MemoryConfig
from mace_rl.nearest import nearest


class Recollection(NamedTuple):
    """What the memory says of N queries."""

    values: Tensor  # float32 [N, value], kernel-weighted mean of the top-k values
    similarity: Tensor  # float32 [N] in (0, 1], kernel at the nearest key over kernel at 0


class EpisodicMemory:
    """A fixed number of (key, value) entries; the least recently used one is overwritten.

    Keys are states as observed. `lookup` compares them in an embedding that the caller gives,
    here the running standardisation, so that stored keys follow it as it changes.

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

    def __len__(self) -> int:
        return int(np.count_nonzero(self.usage))

    def write(self, keys: Tensor, next_states: Tensor, rewards: Tensor, returns: Tensor) -> None:
        """Store N experiences over the least recently used entries.

        keys, next_states: [N, key]; rewards, returns: [N]. Of more than `capacity` the last ones
        are stored.
        """
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

    def lookup(self, queries: Tensor, mean: Tensor, std: Tensor) -> Recollection:
        """Kernel-weighted mean of the k nearest entries' values for each query, [N, key].

        Distances are Euclidean between (x - mean) / std of query and key; the kernel is
        1 / (d² + δ) (Pritzel et al. 2017, eq. 5), with d² per dimension so that δ does not depend
        on the number of dimensions. Differentiable with respect to queries and values. Every
        entry that is read counts as used now; of equally near ones the last written are read, so
        that what came of a state lately is what is remembered of it. Raises `LookupError` if
        nothing is stored.
        """
        stored = len(self)
        if stored == 0:
            raise LookupError("the episodic memory is empty")
        newest_first = np.argsort(-self.number[:stored])
        points = (queries.detach(), self.keys[newest_first], mean, std)
        states, keys, centre, unit = (tensor.float().numpy() for tensor in points)
        count = min(self.config.neighbours, stored)
        squared_distances, places = nearest(states, keys, centre, unit, count)
        indices = newest_first[places]
        self.mark_used(indices)
        bandwidth = self.config.kernel_bandwidth
        if not (queries.requires_grad or self.values.requires_grad):
            size = queries.shape[1]
            read = recollect(
                squared_distances / np.float32(size), indices, self.values.numpy(), bandwidth
            )
            return Recollection(*(torch.from_numpy(part) for part in read))
        # The same as autograd can follow it, for whoever trains through the memory; the method does
        # not. Which entries are nearest has no gradient.
        chosen = torch.from_numpy(indices)  # [N, k]
        squares = ((queries[:, None] - self.keys[chosen]) / std).square().mean(-1)
        kernel = 1 / (squares + bandwidth)
        weights = kernel / kernel.sum(1, keepdim=True)
        return Recollection(
            values=(weights[..., None] * self.values[chosen]).sum(1),
            similarity=bandwidth * kernel[:, 0],  # the nearest comes first
        )

    def mark_used(self, entries: np.ndarray) -> None:
        """Count `entries`, int64 of any shape, as read now, all at the same time."""
        self.time += 1
        self.usage[entries] = self.time

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        counters = {"usage": self.usage, "number": self.number}
        tensors = {name: torch.from_numpy(counter) for name, counter in counters.items()}
        return {"keys": self.keys, "values": self.values, "time": self.time, **tensors}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.keys, self.values = state["keys"].clone(), state["values"].clone()
        self.usage, self.number = (state[name].numpy().copy() for name in ("usage", "number"))
        self.time = state["time"]


@njit(cache=True, error_model="numpy")
def recollect(
    squared_distances: np.ndarray, indices: np.ndarray, values: np.ndarray, bandwidth: float
) -> tuple[np.ndarray, np.ndarray]:
    """What `lookup` computes from the nearest entries, without gradients.

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
