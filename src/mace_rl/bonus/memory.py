"""Episodic memory: a neural dictionary (paper, supplement; Pritzel et al. 2017)."""

from typing import Any, NamedTuple

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.config.bonus import MemoryConfig
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.nearest import Neighbours


class Experiences(NamedTuple):
    """What is written, N at once."""

    keys: np.ndarray  # [N, key], like the next
    next_states: np.ndarray
    rewards: np.ndarray  # [N], like the next
    returns: np.ndarray


class Entries(NamedTuple):
    """The arrays of an `EpisodicMemory`, which has them as its attributes."""

    keys: np.ndarray
    values: np.ndarray
    usage: np.ndarray
    number: np.ndarray
    read: np.ndarray


class EpisodicMemory(Stateful):
    """A fixed number of (key, value) entries; the least recently used one is overwritten.

    Keys are states as observed, compared after the standardisation that `build_index` was given. A
    value is (next state, reward, return-to-go): what followed the state.
    """

    STATE = ("keys", "values", "usage", "number", "read", "time", "written")

    def __init__(self, config: MemoryConfig, key_size: int) -> None:
        self.config = config
        self.keys = np.zeros((config.capacity, key_size), np.float32)
        self.values = np.zeros((config.capacity, key_size + 2), np.float32)
        self.usage = np.zeros(config.capacity, np.int64)  # time of the last reading or writing
        # Their number among all that were ever written, from 1; below 0 for empty ones.
        self.number = np.arange(-config.capacity, 0)
        self.time = self.written = 0
        self.newest_first = np.empty(0, np.int64)  # entries, from the last written on
        self.read = np.zeros(config.capacity, np.bool_)  # entries read since the last `write`
        self.neighbours: Neighbours | None = None

    def __len__(self) -> int:
        return min(self.written, len(self.keys))

    def write(
        self, keys: np.ndarray, next_states: np.ndarray, rewards: np.ndarray, returns: np.ndarray
    ) -> None:
        """Store N experiences over the least recently used entries.

        keys, next_states: [N, key]; rewards, returns: [N]. Of more than `capacity` the last ones
        are stored. All that was read since the last `write` was used at the same time, before it.
        """
        self.time += 2
        new = Experiences(keys, next_states, rewards, returns)
        entries = Entries(self.keys, self.values, self.usage, self.number, self.read)
        self.newest_first = write(new, entries, self.newest_first, self.time, self.written)
        self.written += min(len(keys), len(self.keys))
        self.neighbours = None

    def build_index(self, mean: np.ndarray, std: np.ndarray) -> None:
        """From now on distances are Euclidean between (x - mean) / std; both are [key]."""
        # `Neighbours` gives the first of equally near entries: here the last written.
        newest = np.take(self.keys, self.newest_first, axis=0)
        self.neighbours = Neighbours(newest, mean, std)

    def recall(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Kernel-weighted mean of the k nearest entries' returns, and similarity of the nearest.

        states: float32 [N, key]. The kernel is 1 / (d² + δ) (Pritzel et al. 2017, eq. 5), with d²
        per dimension. Returns float32 [N] each; similarity, in (0, 1], is the kernel at the nearest
        key over that at 0. Entries are marked as read; `LookupError` if none is stored or indexed.
        """
        if not self.neighbours:
            raise LookupError("the episodic memory is empty, or not indexed since it was written")
        count = min(self.config.neighbours, len(self.neighbours))
        squared_distances, places = self.neighbours.nearest(states, count)
        return recollect(
            squared_distances,
            places,
            self.newest_first,
            self.values,
            self.read,
            states.shape[1],
            self.config.kernel_bandwidth,
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As `Stateful` says; `build_index` before the next look-up."""
        super().load_state_dict(state)
        self.newest_first = np.argsort(-self.number[: len(self)])
        self.neighbours = None


@kernel
def write(new, entries, newest_first, time, written):
    """`EpisodicMemory.write` of `Experiences` into `Entries`; returns the new `newest_first`."""
    usage, number, read = entries.usage, entries.number, entries.read
    for entry in range(len(usage)):
        if read[entry]:
            usage[entry], read[entry] = time - 1, False
    # Of equally used ones the first written goes: a long episode reads nearly every entry.
    age, order = usage * 2**32 + number, np.empty(len(usage), np.int64)
    count = min(len(new.keys), len(usage))
    for n in range(count):
        entry, experience = np.argmin(age), len(new.keys) - count + n
        age[entry] = 2**62
        key, value = entries.keys[entry], entries.values[entry]
        key[:], value[:-2] = new.keys[experience], new.next_states[experience]
        value[-2], value[-1] = new.rewards[experience], new.returns[experience]
        usage[entry], number[entry] = time, written + n + 1
        order[count - 1 - n] = entry
    for entry in newest_first:
        if number[entry] <= written:
            order[count] = entry
            count += 1
    return order[:count]


@kernel
def recollect(squared_distances, places, newest_first, values, read, size, bandwidth):
    """`EpisodicMemory.recall` from what `Neighbours.nearest` found; marks entries in `read`."""
    recalled, similarity = np.empty((2, len(squared_distances)), np.float32)
    for n in range(len(squared_distances)):
        total = weighted = 0.0
        for i in range(squared_distances.shape[1]):
            entry = newest_first[places[n, i]]
            read[entry] = True
            weight = 1 / (squared_distances[n, i] / np.float32(size) + bandwidth)
            total += weight
            weighted += weight * values[entry, -1]
        recalled[n] = weighted / total
        similarity[n] = bandwidth / (squared_distances[n, 0] / np.float32(size) + bandwidth)
    return recalled, similarity
