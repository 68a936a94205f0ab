"""Episodic memory: a differentiable neural dictionary (paper, supplement; Pritzel et al. 2017)."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mace_rl.hyperparameters import MemoryConfig
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
        # For each entry the time of its last reading or writing; 0 for an empty one.
        self.usage = torch.zeros(config.capacity, dtype=torch.int64)
        self.time = 0

    def __len__(self) -> int:
        return int((self.usage > 0).sum())

    @property
    def returns(self) -> Tensor:
        """Return-to-go of every remembered state, [len(self)]."""
        return self.values[self.usage > 0, -1]

    def write(self, keys: Tensor, next_states: Tensor, rewards: Tensor, returns: Tensor) -> None:
        """Store N experiences over the least recently used entries.

        keys, next_states: [N, key]; rewards, returns: [N]. Of more than `capacity` the last ones
        are stored.
        """
        values = torch.cat([next_states, rewards[:, None], returns[:, None]], dim=1)
        keys, values = keys[-self.config.capacity :], values[-self.config.capacity :]
        self.time += 1
        oldest = torch.argsort(self.usage, stable=True)[: len(keys)]
        self.keys[oldest] = keys.float()
        self.values[oldest] = values.float()
        self.usage[oldest] = self.time

    def lookup(self, queries: Tensor, mean: Tensor, std: Tensor) -> Recollection:
        """Kernel-weighted mean of the k nearest entries' values for each query, [N, key].

        Distances are Euclidean between (x - mean) / std of query and key; the kernel is
        1 / (d² + δ) (Pritzel et al. 2017, eq. 5), with d² per dimension so that δ does not depend
        on the number of dimensions. Differentiable with respect to queries and values. Every
        entry that is read counts as used now. Raises `LookupError` if nothing is stored.
        """
        stored = (self.usage > 0).nonzero().squeeze(1)
        if len(stored) == 0:
            raise LookupError("the episodic memory is empty")
        embedded = (queries - mean) / std
        keys = (self.keys[stored] - mean) / std
        neighbours = min(self.config.neighbours, len(stored))
        places = nearest(
            embedded.detach().float().numpy(), keys.detach().float().numpy(), neighbours
        )[1]  # int64 [N, k]; which ones are nearest has no gradient
        chosen = torch.from_numpy(places)
        squares = (embedded[:, None] - keys[chosen]).square().mean(-1)  # [N, k]
        kernel = 1 / (squares + self.config.kernel_bandwidth)
        weights = kernel / kernel.sum(1, keepdim=True)
        read = stored[chosen]
        self.time += 1
        self.usage[read.ravel()] = self.time
        return Recollection(
            values=(weights[..., None] * self.values[read]).sum(1),
            similarity=self.config.kernel_bandwidth * kernel.max(1).values,
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""
        return {"keys": self.keys, "values": self.values, "usage": self.usage, "time": self.time}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.keys, self.values = state["keys"].clone(), state["values"].clone()
        self.usage, self.time = state["usage"].clone(), state["time"]
