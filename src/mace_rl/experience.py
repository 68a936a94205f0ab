"""The rollout of an update: episodes with their bonus, advantages and returns."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter

import numpy as np

from mace_rl.bonus.intrinsic import Bonus
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.arrays import mean, variance


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

    @cached_property
    def extrinsic_part(self) -> np.ndarray:
        """A_E in the total advantage A_E + β A_I."""
        return self.extrinsic_advantages / self.extrinsic_scale

    @cached_property
    def intrinsic_part(self) -> np.ndarray:
        """A_I."""
        return self.intrinsic_advantages / self.intrinsic_scale

    @cached_property
    def intrinsic_share(self) -> np.ndarray:
        """β A_I."""
        return self.beta * self.intrinsic_part

    @cached_property
    def total_advantages(self) -> np.ndarray:
        """A_E + β A_I."""
        return self.extrinsic_part + self.intrinsic_share

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


def joined(rollout: list[Experience], name: str) -> np.ndarray:
    """An attribute of the episodes, "episode.actions" say, one after the other: [N, …]."""
    part = attrgetter(name)
    return part(rollout[0]) if len(rollout) == 1 else np.concatenate([*map(part, rollout)])
