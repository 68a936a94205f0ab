"""An episode as it was played."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Episode:
    """One episode of T steps as it was played."""

    observations: np.ndarray  # float32 [T + 1, observation], the last one after the last step
    actions: np.ndarray  # int64 [T] or [T, parts] from 0, or float32 [T, actions] before clipping
    log_probs: np.ndarray  # float32 [T], of the actions when they were taken
    rewards: np.ndarray  # float64 [T], extrinsic
    terminated: bool  # False: cut off by the time limit

    def __len__(self) -> int:
        return len(self.rewards)
