"""The rollout of an update: episodes with their bonus, advantages and returns."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mace_rl.agent.ppo import Evaluation
from mace_rl.bonus.intrinsic import Bonus
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import mean, variance
from mace_rl.numerics.compiling import kernel


@dataclass(frozen=True)
class Experience:
    """An episode of T steps with all that the update needs."""

    episode: Episode
    observations: np.ndarray  # float32 [T, observation], normalised as the networks see them
    beta: float
    bonus: Bonus | None  # None in plain PPO
    extrinsic: Evaluation
    intrinsic: Evaluation  # zeros in plain PPO, `without_bonus`

    def with_normalised_returns(self) -> "Experience":
        """With centred returns, over the deviation of the total reward's, R_E + β R_I."""
        returns = self.extrinsic.returns + self.beta * self.intrinsic.returns
        unit = math.sqrt(variance(returns) * len(returns) / max(len(returns) - 1, 1)) + 1e-7

        def in_units(of: Evaluation) -> Evaluation:
            new = (of.returns - mean(of.returns)) / unit
            return of._replace(advantages=of.advantages + new - of.returns, returns=new)

        extrinsic, intrinsic = in_units(self.extrinsic), in_units(self.intrinsic)
        return replace(self, extrinsic=extrinsic, intrinsic=intrinsic)


def without_bonus(steps: int) -> Evaluation:
    """That of a reward which is always 0."""
    return Evaluation(np.zeros(steps), np.zeros(steps), 1.0)


class Advantages(NamedTuple):
    """Of a rollout's steps, float64 [N] each, as β weighs them."""

    extrinsic: np.ndarray  # A_E, in units of its scale
    intrinsic: np.ndarray  # A_I, alike
    weighted: np.ndarray  # β A_I
    total: np.ndarray  # A_E + β A_I, the advantage of the total reward


class Rollout(list[Experience]):
    """The episodes of an update."""

    def joined(self, part: Callable[[Experience], np.ndarray]) -> np.ndarray:
        """A part of the episodes, one after the other, [N, …]."""
        return part(self[0]) if len(self) == 1 else np.concatenate([*map(part, self)])

    @cached_property
    def advantages(self) -> Advantages:
        """Those of all steps."""
        weighed = [
            weigh(
                item.extrinsic.advantages,
                item.intrinsic.advantages,
                item.extrinsic.scale,
                item.intrinsic.scale,
                item.beta,
            )
            for item in self
        ]
        if len(weighed) == 1:
            return Advantages(*weighed[0])
        return Advantages(*map(np.concatenate, zip(*weighed, strict=True)))

    @cached_property
    def observations(self) -> np.ndarray:
        """Float32 [N, observation], normalised."""
        return self.joined(lambda item: item.observations)

    @cached_property
    def actions(self) -> np.ndarray:
        """As in an `Episode`, [N, …]."""
        return self.joined(lambda item: item.episode.actions)

    @property
    def log_probs(self) -> np.ndarray:
        """Float32 [N], when the actions were taken."""
        return self.joined(lambda item: item.episode.log_probs)

    def advantages_of(self, kind: str) -> np.ndarray:
        """Of the "extrinsic" or "intrinsic" reward, before scaling, float64 [N]."""
        return self.joined(lambda item: getattr(item, kind).advantages)

    def returns(self, kind: str) -> np.ndarray:
        """The λ-returns of the "extrinsic" or "intrinsic" reward, float64 [N]."""
        return self.joined(lambda item: getattr(item, kind).returns)


@kernel
def weigh(extrinsic, intrinsic, extrinsic_scale, intrinsic_scale, beta):
    """`Advantages` of an episode, from both kinds before scaling, float64 [T] each."""
    extrinsic, intrinsic = extrinsic / extrinsic_scale, intrinsic / intrinsic_scale
    weighted = beta * intrinsic
    return extrinsic, intrinsic, weighted, extrinsic + weighted
