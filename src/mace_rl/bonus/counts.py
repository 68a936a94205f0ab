"""Novelty by visitation counts, for states of whole numbers (paper, supplement)."""

import logging
from collections import Counter
from collections.abc import Mapping
from hashlib import blake2b
from typing import Any

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.bonus.novelty import Novelty
from mace_rl.config.bonus import NoveltyConfig

KEY_BYTES = 16  # of a state among hashed counts
TOLD_APART = 2.0**24  # below which float32 has every whole number

logger = logging.getLogger(__name__)


class CountNovelty(Stateful, Novelty):
    """1 / n(s) with counts that decay (paper, supplement): for Discrete observations.

    n(s) includes this visit and those earlier in the episode, so a first visit has novelty 1. After
    each episode all counts are multiplied by `count_decay`.
    """

    STATE = ("counts",)

    def __init__(self, config: NoveltyConfig, observation_size: int) -> None:
        self.config = config
        self.counts = np.zeros(observation_size)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        return self.continued(states, {})

    def continued(self, states: np.ndarray, visits: Mapping[bytes, int]) -> np.ndarray:
        counts: dict[int, float] = {}  # of these states alone
        novelty = np.empty(len(states))
        for t, state in enumerate(states.argmax(axis=1).tolist()):
            if state not in counts:
                counts[state] = float(self.counts[state]) + visits.get(states[t].tobytes(), 0)
            counts[state] += 1
            novelty[t] = 1 / counts[state]
        return novelty

    def observe(self, states: np.ndarray) -> None:
        self.counts = (self.counts + states.sum(axis=0)) * self.config.count_decay


class HashedCountNovelty(Stateful, Novelty):
    """`CountNovelty` for vectors of whole numbers, such as images: counts of exact states.

    A state's key is a hash of its bytes. Its count is brought up to date when it is asked for.
    """

    STATE = ("episodes", "keys", "counts", "since")

    def __init__(self, config: NoveltyConfig) -> None:
        self.decay, self.episodes, self.warned = config.count_decay, 0, False
        self.known: dict[bytes, tuple[float, int]] = {}  # count, and after how many episodes

    def __call__(self, states: np.ndarray) -> np.ndarray:
        return self.continued(states, {})

    def continued(self, states: np.ndarray, visits: Mapping[bytes, int]) -> np.ndarray:
        seen, novelty = Counter[bytes](), np.empty(len(states))
        for t, state in enumerate(map(np.ndarray.tobytes, states)):
            seen[state] += 1
            novelty[t] = 1 / (self.count(hashed(state)) + visits.get(state, 0) + seen[state])
        return novelty

    def count(self, key: bytes) -> float:
        """Of all earlier episodes, each visit `count_decay` ** its age in episodes."""
        count, since = self.known.get(key, (0.0, self.episodes))
        return count * self.decay ** (self.episodes - since)

    def observe(self, states: np.ndarray) -> None:
        if not self.warned and abs(states).max() >= TOLD_APART:
            self.warned = True
            logger.warning("whole numbers of 2^24 and more are not told apart, but count as one")
        visits = Counter(map(np.ndarray.tobytes, states))
        counts = {(key := hashed(state)): self.count(key) + n for state, n in visits.items()}
        self.episodes += 1
        self.known |= {key: (count * self.decay, self.episodes) for key, count in counts.items()}

    @property
    def keys(self) -> np.ndarray:
        """Of all known states, uint8 [states, bytes]."""
        return np.frombuffer(bytearray().join(self.known), np.uint8).reshape(-1, KEY_BYTES)

    @property
    def counts(self) -> np.ndarray:
        """In the order of keys, float64 [states]."""
        return np.array([count for count, _ in self.known.values()], np.float64)

    @property
    def since(self) -> np.ndarray:
        """After how many episodes they were, int64 [states]."""
        return np.array([since for _, since in self.known.values()], np.int64)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        values = zip(state["counts"].tolist(), state["since"].tolist(), strict=True)
        keys = map(np.ndarray.tobytes, state["keys"].numpy())
        self.episodes, self.known = state["episodes"], dict(zip(keys, values, strict=True))


def hashed(state: bytes) -> bytes:
    """The key of a state: two in 10¹⁸ states share one with a probability of 10⁻³."""
    return blake2b(state, digest_size=KEY_BYTES).digest()
