"""Planted problems: tasks in which it is known what β should do, to test whatever sets it.

Each step shows one of a few contexts, in which one of two actions is right and pays 1 on average,
with much noise. An entropy bonus (`config/planted.yaml`) keeps the policy from being sure, so that
there is something to learn until the end. Beside the context the observation has a flag, and
`FlagNovelty` pays a bonus for nothing but it:

- PlantedHelp-v0: it is up after a right action, so the bonus tells without noise what the reward
  tells with it, and β should rise;
- PlantedHarm-v0: it is up after a wrong action, the bonus teaches the opposite, and β should fall;
- PlantedNothing-v0: it is up at random, and β should stay where it is.
"""

from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.bonus.novelty import Novelty

CONTEXTS = 4
NOISE = 2.0  # standard deviation of the reward


class Planted(gymnasium.Env[np.ndarray, np.int64]):
    """Observation: the context, one-hot, and the flag, float32 [CONTEXTS + 1]; two actions."""

    observation_space, action_space = Box(0, 1, (CONTEXTS + 1,), np.float32), Discrete(2)

    def __init__(self, flag: Literal["right", "wrong", "random"]) -> None:
        self.flag = flag

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode."""
        super().reset(seed=seed)
        return self.observe(False), {}

    def observe(self, flag: bool) -> np.ndarray:
        """A random context with this flag."""
        self.context = int(self.np_random.integers(CONTEXTS))
        observation = np.zeros(CONTEXTS + 1, np.float32)
        observation[self.context], observation[-1] = 1, flag
        return observation

    def step(self, action: int | np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Pay for the action in this context and show another one."""
        right = action == self.context % 2
        reward = float(right) + NOISE * self.np_random.standard_normal()
        coin = self.np_random.random() < 0.5  # drawn in each problem, so that they stay alike
        flag = {"right": right, "wrong": not right, "random": coin}[self.flag]
        return self.observe(flag), reward, False, False, {}


class FlagNovelty(Novelty):
    """The flag itself; nothing is ever known."""

    def __init__(self, size: int, generator: np.random.Generator) -> None:
        pass

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """See `Novelty`."""
        return states[:, -1].astype(np.float64)

    def observe(self, states: np.ndarray) -> None:
        """See `Novelty`."""

    def state_dict(self) -> dict[str, Any]:
        """See `Novelty`."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `Novelty`."""
