"""A critic without a network: NEC's dictionary of states and returns (Pritzel et al. 2017)."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mace_rl.agent.adam import Adam
from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.agent.ppo import Batch, Minibatches
from mace_rl.config.agent import DictionaryValue
from mace_rl.nearest import Neighbours

# States closer than this are the same: mean squared difference in standard deviations. It is what
# rounding leaves of no difference when a normalisation is undone.
SAME = 1e-8


class DictionaryCritic:
    """V(s) from the returns of the most similar remembered states; see `Critic`.

    V(s) = Σ_i w_i R_i over the k nearest, w_i ∝ 1 / (d_i² + δ) (eq. 1, 2 and 5), with d² per
    dimension of states standardised by all that was seen. Entries are states as observed, so that
    they follow the standardisation. After each update a remembered state moves its return,
    R ← R + α (λ-return - R) (eq. 4); a new one takes the place of what was least recently written
    or among the nearest. One experience thus counts at once, in full.
    """

    optimiser: Adam | None = None

    def __init__(
        self,
        kind: str,
        config: DictionaryValue,
        normaliser: RunningNormaliser,
        normalised: bool,
    ) -> None:
        """kind: of the reward; normaliser: what standardises; normalised: whether critics get
        observations that it has standardised already."""
        self.kind, self.config = kind, config
        self.normaliser, self.normalised = normaliser, normalised
        self.keys = np.zeros((config.capacity, len(normaliser.mean)), np.float32)
        self.returns = np.zeros(config.capacity, np.float32)
        # For each entry the time of its last reading or writing; 0 for an empty one. Of equally
        # old ones the first is overwritten, so entries fill up in order.
        self.usage = np.zeros(config.capacity, np.int64)
        self.time = 0

    def __len__(self) -> int:
        return int(np.count_nonzero(self.usage))

    def values(self, observations: np.ndarray) -> np.ndarray:
        """See `Critic`; 0 while nothing is remembered. What is read counts as used now."""
        if len(self) == 0:
            return np.zeros(len(observations))
        squares, indices = self.search(self.states(observations), self.config.neighbours)
        self.time += 1
        self.usage[indices] = self.time
        weights = 1 / (squares.astype(np.float64) + self.config.kernel_bandwidth)
        return (weights * self.returns[indices]).sum(1) / weights.sum(1)

    def learn(self, batch: Batch, minibatches: Minibatches) -> float:
        """See `Critic`: there is no gradient."""
        return 0.0

    def remember(self, batch: Batch) -> None:
        """See `Critic`. A state that occurs several times in `batch` is written, then moved."""
        states, rate = self.states(batch.observations), self.config.learning_rate
        unique, firsts, groups = np.unique(states, axis=0, return_index=True, return_inverse=True)
        places = np.full(len(unique), -1)  # of each state among the entries
        if len(self):
            squares, indices = self.search(unique, 1)
            places = np.where(squares[:, 0] <= SAME, indices[:, 0], -1)
        found: dict[int | np.integer, float] = {
            group: float(self.returns[place]) for group, place in enumerate(places) if place >= 0
        }
        for group, target in zip(groups.ravel().tolist(), batch.returns[self.kind], strict=True):
            before = found.get(group, float(target))
            found[group] = before + rate * (float(target) - before)
        self.time += 1
        known, new = np.flatnonzero(places >= 0), np.flatnonzero(places < 0)
        self.returns[places[known]] = [found[group] for group in known]
        self.usage[places[known]] = self.time
        new = new[np.argsort(firsts[new])][-self.config.capacity :]  # in the order of occurrence
        oldest = np.argsort(self.usage, kind="stable")[: len(new)]
        self.keys[oldest], self.returns[oldest] = unique[new], [found[group] for group in new]
        self.usage[oldest] = self.time

    def states(self, observations: np.ndarray) -> np.ndarray:
        """Observations as the environment gave them, float32 [N, observation].

        But for rounding and, if they come normalised, for what was beyond `OBSERVATION_CLIP`.
        """
        if not self.normalised:
            return observations
        return (observations * self.normaliser.std + self.normaliser.mean).astype(np.float32)

    def search(self, states: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The nearest entries to each state, [N, count]: d² per dimension, and which they are."""
        stored = len(self)
        entries = Neighbours(self.keys[:stored], self.normaliser.mean, self.normaliser.std)
        squares, indices = entries.nearest(states, min(count, stored))
        return squares / np.float32(states.shape[1]), indices

    def module(self) -> torch.nn.Module:
        """See `Critic`."""
        return DictionaryModule(self)

    def state_dict(self) -> dict[str, Any]:
        """See `Critic`."""
        arrays: dict[str, np.ndarray] = {
            "keys": self.keys,
            "returns": self.returns,
            "usage": self.usage,
        }
        stored = {name: array[: len(self)].copy() for name, array in arrays.items()}
        return {name: torch.from_numpy(array) for name, array in stored.items()} | {
            "time": self.time
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Critic`."""
        self.usage[:] = 0
        for name in ("keys", "returns", "usage"):
            getattr(self, name)[: len(state["usage"])] = state[name].numpy()
        self.time = state["time"]


class DictionaryModule(torch.nn.Module):
    """The same V(s) in torch, as it is now; reading it does not count as use."""

    keys: Tensor
    returns: Tensor
    stored: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, critic: DictionaryCritic) -> None:
        super().__init__()
        self.config, self.normalised = critic.config, critic.normalised
        buffers = {
            "keys": critic.keys,
            "returns": critic.returns,
            "stored": np.array(len(critic)),
            "mean": critic.normaliser.mean,
            "std": critic.normaliser.std,
        }
        for name, array in buffers.items():
            self.register_buffer(name, torch.from_numpy(array.copy()))

    def forward(self, observations: Tensor) -> Tensor:
        """V of each state, [N, 1]; observations: as the policy's network sees them, [N, size]."""
        stored = int(self.stored)
        if stored == 0:
            return observations.new_zeros(len(observations), 1)
        seen = observations if self.normalised else (observations - self.mean) / self.std
        keys = (self.keys[:stored] - self.mean) / self.std
        squares = (seen[:, None] - keys).square().mean(-1)
        count = min(self.config.neighbours, stored)
        squares, indices = squares.topk(count, largest=False)
        weights = 1 / (squares + self.config.kernel_bandwidth)
        return (weights * self.returns[indices]).sum(1, keepdim=True) / weights.sum(1, keepdim=True)
