"""Counts of hashed states (Tang et al. 2017), a pseudo-count (Bellemare et al. 2016)."""

import math
from collections import Counter
from typing import Any

import numpy as np
from pydantic import Field

from mace_rl.base.state import Stateful
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.config.section import Count, Section, check
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.normaliser import RunningNormaliser


class Settings(Section):
    """The arguments of `HashCounts`."""

    bits: int = Field(default=16, ge=1, le=62)  # k; more tell more states apart
    calibration_states: Count = 1000  # the first visited; states are hashed in their units


class HashCounts(Stateful, IntrinsicReward):
    """1 / √n(φ(s')) with φ(s) = sign(A g(s)), SimHash, in `bits` bits (section 2.2, algorithm 1).

    A is a fixed Gaussian matrix, so that states at a small angle share most bits. n counts this
    visit and those earlier in the episode too: a first visit earns 1.

    g whitens by the mean and standard deviation of the first `calibration_states` visited states:
    the angle would otherwise be that of the dimension with the largest numbers. While these are
    collected, all visits are counted anew after each episode; then φ stays. Discrete states are
    one-hot and stay as they are.

    Raises `ConfigError` for arguments that are not as `Settings` has them.
    """

    STATE = ("matrix", "normaliser", "early", "counts")

    largest = 1.0

    def __init__(self, spaces: Spaces, generator: np.random.Generator, **arguments: Any) -> None:
        self.settings, size = check(Settings, arguments, "arguments"), spaces.observation_size
        self.matrix = generator.standard_normal((self.settings.bits, size))  # A
        self.normaliser = RunningNormaliser(size)
        self.discrete = spaces.discrete_observations
        self.early = np.empty((0, size), np.float32)  # what g was calibrated on
        self.counts: Counter[int] = Counter()

    def codes(self, states: np.ndarray) -> list[int]:
        """φ of each state, [T, observation], as a number whose bits are the signs."""
        return codes(self.normaliser(states), self.matrix).tolist()

    def bonus(self, episode: Episode) -> Bonus:
        """See `IntrinsicReward`."""
        visits: Counter[int] = Counter()  # of this episode
        reward = np.empty(len(episode))
        for t, code in enumerate(self.codes(episode.observations[1:])):
            visits[code] += 1
            reward[t] = 1 / math.sqrt(self.counts[code] + visits[code])
        return Bonus(reward)

    def remember(self, episode: Episode, returns: np.ndarray) -> None:
        """See `IntrinsicReward`; the returns do not matter."""
        states = episode.observations[1:]
        if not self.discrete and len(self.early) < self.settings.calibration_states:
            self.normaliser.update(states)
            self.early = states = np.concatenate([self.early, states])
            self.counts.clear()
        self.counts.update(self.codes(states))


@kernel
def codes(states: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """For each state, [T, observation], a number whose bits are the signs of matrix · state."""
    result = np.zeros(len(states), np.int64)
    for t in range(len(states)):
        for bit in range(len(matrix)):
            total = 0.0
            for i in range(states.shape[1]):
                total += matrix[bit, i] * states[t, i]
            if total > 0:
                result[t] |= 1 << bit
    return result
