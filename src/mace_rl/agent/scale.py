"""Running scales, which make rewards and advantages of different tasks comparable."""

import math

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.matmul import dot
from mace_rl.numerics.normaliser import RunningNormaliser


class RewardScale(Stateful):
    """The divisor of rewards: the standard deviation of their discounted sums so far.

    The sum at a step is r_t + γ r_{t-1} + γ² r_{t-2} + … within its episode (as in the code of
    Schulman et al. 2017; Engstrom et al. 2020). The divisor is at least `smallest`.
    """

    STATE = ("sums",)

    def __init__(self, discount: float, smallest: float) -> None:
        self.discount, self.smallest = discount, smallest
        self.sums = RunningNormaliser(1)

    def update(self, rewards: np.ndarray) -> None:
        """Take in one episode's rewards, [T]."""
        self.sums.update(discounted_sums(rewards, self.discount)[:, None])

    @property
    def value(self) -> float:
        """The divisor."""
        return max(float(self.sums.std[0]), self.smallest)  # 1 while the sums have not varied


class AdvantageScale(Stateful):
    """The divisor of advantages: their root mean square so far, at least `smallest`."""

    STATE = ("count", "squares")

    def __init__(self, smallest: float) -> None:
        self.smallest = smallest
        self.count, self.squares = 0, 0.0

    def update(self, advantages: np.ndarray) -> None:
        """Take in one episode's advantages, [T]."""
        self.count += len(advantages)
        self.squares += dot(advantages, advantages)

    @property
    def value(self) -> float:
        """The divisor."""
        return max(math.sqrt(self.squares / max(self.count, 1)), self.smallest)


@kernel
def discounted_sums(rewards: np.ndarray, discount: float) -> np.ndarray:
    """r_t + γ r_{t-1} + γ² r_{t-2} + … at each step of an episode, float64 [T]."""
    result = np.empty(len(rewards))
    total = 0.0
    for t in range(len(rewards)):
        total = discount * total + rewards[t]
        result[t] = total
    return result
