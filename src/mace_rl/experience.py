"""What an update learns from: episodes with their bonus, advantages and returns."""

from dataclasses import dataclass

import numpy as np

from mace_rl.bonus.curiosity import Bonus
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


def steps(rollout: list[Experience]) -> tuple[np.ndarray, np.ndarray]:
    """Observations, [N, observation], and actions of the episodes, one after the other."""
    observations = np.concatenate([item.observations[:-1] for item in rollout])
    return observations, np.concatenate([item.episode.actions for item in rollout])


def joined(pieces: list[np.ndarray]) -> np.ndarray:
    """The episodes' arrays one after the other, float32 [N]."""
    return np.concatenate(pieces).astype(np.float32)


def total_advantages(rollout: list[Experience]) -> np.ndarray:
    """A_E + β A_I of every step, float64 [N]."""
    return np.concatenate(
        [item.extrinsic_advantages + item.beta * item.intrinsic_advantages for item in rollout]
    )


def intrinsic_parts(rollout: list[Experience]) -> list[np.ndarray]:
    """For each episode what `total_advantages` changes by with its β: A_I there, 0 elsewhere."""
    parts = np.zeros((len(rollout), sum(len(item.episode) for item in rollout)))
    start = 0
    for part, item in zip(parts, rollout, strict=True):
        part[start : start + len(item.episode)] = item.intrinsic_advantages
        start += len(item.episode)
    return list(parts)
