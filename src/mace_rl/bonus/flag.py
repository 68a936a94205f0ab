"""The bonus of the planted problems (`mace_rl.environments.planted`): their flag, nothing else."""

import numpy as np

from mace_rl.base.state import Stateful
from mace_rl.bonus.novelty import Novelty


class FlagNovelty(Stateful, Novelty):
    """The last number of an observation; it never becomes known."""

    def __init__(self, size: int, generator: np.random.Generator) -> None:
        pass

    def __call__(self, states: np.ndarray) -> np.ndarray:
        return states[:, -1].astype(np.float64)

    def observe(self, states: np.ndarray) -> None:
        pass
