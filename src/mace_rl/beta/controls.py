"""Controls of the learned β: what it must beat, a draw of chance and a bandit."""

import math
from collections import deque

import numpy as np

from mace_rl.beta.controller import BetaController
from mace_rl.config.beta import BanditBeta, RandomBeta
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.arrays import total
from mace_rl.state import Stateful


class RandomDraw(Stateful, BetaController):
    """β uniform in [low, high), drawn anew for every episode."""

    STATE = ("_beta", "generator")

    def __init__(self, config: RandomBeta, generator: np.random.Generator) -> None:
        self.config, self.generator = config, generator
        self._beta = self.draw()

    @property
    def beta(self) -> float:
        """See `BetaController`."""
        return self._beta

    def draw(self) -> float:
        """One β."""
        return float(self.generator.uniform(self.config.low, self.config.high))

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self._beta = self.draw()


class SlidingWindowBandit(Stateful, BetaController):
    """β by Agent57's bandit: sliding-window UCB with ε-greedy (Badia et al. 2020, appendix D).

    Each arm a is a β. Every arm is pulled once, in order; then, with N(a) the pulls of an arm among
    the last `window` and μ(a) their mean reward, the next is

        argmax_a μ(a) + exploration · √(1 / N(a)),   or with probability ε any arm.

    Agent57's arm plays an episode and is paid its return. Here β acts in the update *after* its
    episodes, so an arm is pulled for a rollout (one episode if `rollout_steps` is 1) and paid what
    the next rollout's episodes return, on average. Returns count from the worst, 0, to the best, 1,
    of all episodes so far, so that `exploration` means the same in every task.
    """

    STATE = ("arm", "pulls", "unpaid", "paid", "worst", "best", "returns", "steps", "generator")

    def __init__(
        self, config: BanditBeta, rollout_steps: int, generator: np.random.Generator
    ) -> None:
        self.config, self.rollout_steps, self.generator = config, rollout_steps, generator
        self.arm, self.pulls = 0, 1
        self.unpaid: int | None = None  # the last rollout's arm, for which this one's returns speak
        self.paid: deque[tuple[int, float]] = deque(maxlen=config.window)  # arm, return
        self.worst, self.best = math.inf, -math.inf
        self.returns: list[float] = []  # of this rollout's episodes
        self.steps = 0  # of this rollout

    @property
    def beta(self) -> float:
        """See `BetaController`."""
        return self.config.arms[self.arm]

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.returns.append(total(episode.rewards))
        self.worst = min(self.worst, self.returns[-1])
        self.best = max(self.best, self.returns[-1])
        self.steps += len(episode)
        if self.steps < self.rollout_steps:
            return
        if self.unpaid is not None:
            self.paid.append((self.unpaid, sum(self.returns) / len(self.returns)))
        self.unpaid = self.arm
        self.arm, self.pulls = self.choose(), self.pulls + 1
        self.returns, self.steps = [], 0

    def choose(self) -> int:
        """The next arm."""
        arms = len(self.config.arms)
        if self.pulls < arms:
            return self.pulls
        if self.generator.random() < self.config.epsilon:
            return int(self.generator.integers(arms))
        return int(np.argmax([self.score(arm) for arm in range(arms)]))

    def score(self, arm: int) -> float:
        """The upper confidence bound of one arm, its mean reward in [0, 1] plus the uncertainty."""
        found = [value for one, value in self.paid if one == arm]
        if not found:  # go there first, unless its reward is on the way
            return -math.inf if arm == self.unpaid else math.inf
        span = self.best - self.worst
        mean = (sum(found) / len(found) - self.worst) / span if span > 0 else 0.0
        return mean + self.config.exploration * math.sqrt(1 / len(found))
