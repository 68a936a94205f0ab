"""β by a bandit that follows the returns (Badia et al. 2020, appendix D)."""

import math
from collections import deque
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeFloat, ValidationInfo, field_validator

from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController
from mace_rl.config.section import Count, Section, check
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import total


class Settings(Section):
    """The arguments of `Bandit`."""

    arms: list[Annotated[float, Field(ge=0, le=1)]] = Field(min_length=1)  # the βs to choose from
    window: Count  # pulls that count, the last ones
    exploration: NonNegativeFloat  # of the bonus √(1 / pulls), in ranges of the return
    epsilon: float = Field(ge=0, le=1)  # probability of an arm at random

    @field_validator("arms")
    @classmethod
    def _differ(cls, arms: list[float]) -> list[float]:
        if len(set(arms)) < len(arms):
            raise ValueError("should have each β once")
        return arms

    @field_validator("window")
    @classmethod
    def _holds_the_arms(cls, window: int, before: ValidationInfo) -> int:
        if window < len(arms := before.data.get("arms", [])):
            raise ValueError(f"should hold each of the {len(arms)} arms")
        return window


class Bandit(Stateful, BetaController):
    """β by Agent57's bandit: sliding-window UCB with ε-greedy (Badia et al. 2020, appendix D).

    Each arm a is a β. Every arm is pulled once, in order; then, with N(a) the pulls of an arm among
    the last `window` and μ(a) their mean reward, the next is

        argmax_a μ(a) + exploration · √(1 / N(a)),   or with probability ε any arm.

    Agent57's arm plays an episode and is paid its return. Here β acts in the update *after* its
    episodes, so an arm is pulled for a rollout (one episode if `rollout_steps` is 1) and paid what
    the next rollout's episodes return, on average. Returns count from the worst, 0, to the best, 1,
    of all episodes so far, so that `exploration` means the same in every task.

    Raises `ConfigError` for arguments that are not as `Settings` has them.
    """

    STATE = ("arm", "pulls", "unpaid", "paid", "worst", "best", "returns", "generator")

    one_at_a_time = True

    def __init__(self, generator: np.random.Generator, **arguments: Any) -> None:
        self.settings, self.generator = check(Settings, arguments, "arguments"), generator
        self.arm, self.pulls = 0, 1
        self.unpaid: int | None = None  # the last rollout's arm, for which this one's returns speak
        self.paid: deque[tuple[int, float]] = deque(maxlen=self.settings.window)  # arm, return
        self.worst, self.best = math.inf, -math.inf
        self.returns: list[float] = []  # of this rollout's episodes

    def next_beta(self) -> float:
        """See `BetaController`."""
        return self.settings.arms[self.arm]

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.returns.append(total(episode.rewards))
        self.worst = min(self.worst, self.returns[-1])
        self.best = max(self.best, self.returns[-1])

    def end_rollout(self) -> None:
        """See `BetaController`."""
        if self.unpaid is not None:
            self.paid.append((self.unpaid, sum(self.returns) / len(self.returns)))
        self.unpaid = self.arm
        self.arm, self.pulls = self.choose(), self.pulls + 1
        self.returns = []

    def choose(self) -> int:
        """The next arm."""
        arms = len(self.settings.arms)
        if self.pulls < arms:
            return self.pulls
        if self.generator.random() < self.settings.epsilon:
            return int(self.generator.integers(arms))
        return int(np.argmax([self.score(arm) for arm in range(arms)]))

    def score(self, arm: int) -> float:
        """The upper confidence bound of one arm, its mean reward in [0, 1] plus the uncertainty."""
        found = [value for one, value in self.paid if one == arm]
        if not found:  # go there first, unless its reward is on the way
            return -math.inf if arm == self.unpaid else math.inf
        span = self.best - self.worst
        mean = (sum(found) / len(found) - self.worst) / span if span > 0 else 0.0
        return mean + self.settings.exploration * math.sqrt(1 / len(found))
