"""Counts of hashed states (Tang et al. 2017), a pseudo-count (Bellemare et al. 2016)."""

import math
from collections import Counter

import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.config.bonus import HashCountsBonus
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.normaliser import RunningNormaliser
from mace_rl.state import Stateful


class HashCounts(Stateful, IntrinsicReward):
    """1 / √n(φ(s')) with φ(s) = sign(A g(s)), SimHash, in `bits` bits (section 2.2, algorithm 1).

    A is a fixed Gaussian matrix, so that states at a small angle share most bits. n counts this
    visit and those earlier in the episode too: a first visit earns 1.

    g whitens by the mean and standard deviation of the first `calibration_states` visited states:
    the angle would otherwise be that of the dimension with the largest numbers. While these are
    collected, all visits are counted anew after each episode; then φ stays. Discrete states are
    one-hot and stay as they are.
    """

    STATE = ("matrix", "normaliser", "early", "counts")

    largest = 1.0

    def __init__(
        self,
        config: HashCountsBonus,
        observation_space: Box | Discrete,
        observation_size: int,
        generator: np.random.Generator,
    ) -> None:
        self.config = config
        self.matrix = generator.standard_normal((config.bits, observation_size))  # A
        self.normaliser = RunningNormaliser(observation_size)
        self.discrete = isinstance(observation_space, Discrete)
        self.early = np.empty((0, observation_size), np.float32)  # what g was calibrated on
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
        if not self.discrete and len(self.early) < self.config.calibration_states:
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
