"""The rollout of an update: episodes with their bonus, advantages and returns."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mace_rl.bonus.intrinsic import Bonus
from mace_rl.environments.episode import Episode
from mace_rl.numerics.arrays import mean, variance
from mace_rl.numerics.compiling import kernel


@dataclass(frozen=True)
class Experience:
    """An episode with all that the update needs; arrays are [T]."""

    episode: Episode
    observations: np.ndarray  # float32 [T, observation], normalised as the networks see them
    beta: float
    bonus: Bonus | None  # None in plain PPO
    extrinsic_advantages: np.ndarray
    extrinsic_returns: np.ndarray
    intrinsic_advantages: np.ndarray  # zeros without a bonus, like the next
    intrinsic_returns: np.ndarray
    extrinsic_scale: float  # `PPO.advantage_scale`, by which the advantages are divided
    intrinsic_scale: float

    def with_normalised_returns(self) -> "Experience":
        """With returns less their mean, over the deviation of the total reward's, R_E + β R_I."""
        old = {k: getattr(self, f"{k}_returns") for k in ("extrinsic", "intrinsic")}
        returns = old["extrinsic"] + self.beta * old["intrinsic"]
        unit = math.sqrt(variance(returns) * len(returns) / max(len(returns) - 1, 1)) + 1e-7
        new = {f"{k}_returns": (part - mean(part)) / unit for k, part in old.items()}
        new |= {
            f"{k}_advantages": getattr(self, f"{k}_advantages") + new[f"{k}_returns"] - part
            for k, part in old.items()
        }
        return replace(self, **new)


class Advantages(NamedTuple):
    """Of a rollout's steps, float64 [N] each, as β weighs them."""

    extrinsic: np.ndarray  # A_E, in units of its scale
    intrinsic: np.ndarray  # A_I, alike
    share: np.ndarray  # β A_I
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
                item.extrinsic_advantages,
                item.intrinsic_advantages,
                item.extrinsic_scale,
                item.intrinsic_scale,
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

    def returns(self, kind: str) -> np.ndarray:
        """The λ-returns of the "extrinsic" or "intrinsic" reward, float64 [N]."""
        if kind == "extrinsic":
            return self.joined(lambda item: item.extrinsic_returns)
        return self.joined(lambda item: item.intrinsic_returns)


@kernel
def weigh(extrinsic, intrinsic, extrinsic_scale, intrinsic_scale, beta):
    """`Advantages` of an episode, from both kinds before scaling, float64 [T] each."""
    own, added = extrinsic / extrinsic_scale, intrinsic / intrinsic_scale
    share = beta * added
    return own, added, share, own + share
