"""What an update learns from: episodes with their bonus, advantages and returns."""

from dataclasses import dataclass

import numpy as np

from mace_rl.bonus.intrinsic import Bonus
from mace_rl.environments.rollout import Episode


@dataclass(frozen=True)
class Experience:
    """An episode with all that the update needs of it; arrays are [T]."""

    episode: Episode
    observations: np.ndarray  # float32 [T + 1, observation], normalised as the networks see them
    beta: float
    bonus: Bonus | None  # None in plain PPO
    extrinsic_advantages: np.ndarray
    extrinsic_returns: np.ndarray
    intrinsic_advantages: np.ndarray  # zeros without a bonus, like the next
    intrinsic_returns: np.ndarray
    extrinsic_scale: float  # what the advantages are divided by where they are added up; or 1
    intrinsic_scale: float


def steps(rollout: list[Experience]) -> tuple[np.ndarray, np.ndarray]:
    """Observations, [N, observation], and actions of the episodes, one after the other."""
    observations = np.concatenate([item.observations[:-1] for item in rollout])
    return observations, np.concatenate([item.episode.actions for item in rollout])


def joined(pieces: list[np.ndarray]) -> np.ndarray:
    """The episodes' arrays one after the other, float32 [N]."""
    return np.concatenate(pieces).astype(np.float32)


def extrinsic_part(item: Experience) -> np.ndarray:
    """What the total advantage has of the extrinsic one, [T]: it, or in units of its scale."""
    return item.extrinsic_advantages / item.extrinsic_scale


def intrinsic_part(item: Experience) -> np.ndarray:
    """What β weighs in the total advantage, [T]: the intrinsic one, or in units of its scale."""
    return item.intrinsic_advantages / item.intrinsic_scale


def total_advantages(rollout: list[Experience]) -> np.ndarray:
    """A_E + β A_I of every step, float64 [N]."""
    return np.concatenate(
        [extrinsic_part(item) + item.beta * intrinsic_part(item) for item in rollout]
    )


def intrinsic_parts(rollout: list[Experience]) -> list[np.ndarray]:
    """For each episode what `total_advantages` changes by with its β: A_I there, 0 elsewhere."""
    parts = np.zeros((len(rollout), sum(len(item.episode) for item in rollout)))
    start = 0
    for part, item in zip(parts, rollout, strict=True):
        part[start : start + len(item.episode)] = intrinsic_part(item)
        start += len(item.episode)
    return list(parts)
