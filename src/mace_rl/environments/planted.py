"""Planted problems: tasks in which it is known what β should do, to test whatever sets it.

Each step shows one of four contexts. In each, one of two actions is right and pays 1 on average,
with much noise. An entropy bonus (`config/planted.yaml`) keeps the policy from becoming sure, so
that it learns until the end. The observation also has a flag, and the bonus is the flag alone
(`mace_rl.bonus.flag`):

- PlantedHelp-v0: the flag is up after a right action. The bonus says without noise what the reward
  says with it, and β should rise.
- PlantedHarm-v0: it is up after a wrong action. The bonus teaches the opposite, and β should fall.
- PlantedNothing-v0: it is up at random, and β should stay where it is.
- PlantedMixed-v0: an episode as in PlantedHelp-v0 and one as in PlantedHarm-v0, in turn. β should
  rise for the ones and fall for the others, which takes reading what the last one was.
"""

from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

CONTEXTS = 4
NOISE = 2.0  # standard deviation of the reward


class Planted(gymnasium.Env[np.ndarray, np.int64]):
    """Observation: the context, one-hot, and the flag, float32 [CONTEXTS + 1]; two actions."""

    observation_space, action_space = Box(0, 1, (CONTEXTS + 1,), np.float32), Discrete(2)

    def __init__(self, flag: Literal["right", "wrong", "random"]) -> None:
        self.flag = flag

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(**kwargs)
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


class PlantedMixed(Planted):
    """Two kinds of episodes, in turn: in the first the flag is right, in the second it is wrong.

    A sixth number of the observation says which it is, 1 or 0, and so what the next will be.
    """

    observation_space = Box(0, 1, (CONTEXTS + 2,), np.float32)

    def __init__(self) -> None:
        super().__init__("wrong")

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode of the other kind."""
        self.flag = "wrong" if self.flag == "right" else "right"
        return super().reset(**kwargs)

    def observe(self, flag: bool) -> np.ndarray:
        planted = super().observe(flag)
        return np.append(planted[:-1], [self.flag == "right", planted[-1]]).astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """The kind of the episode."""
        return {"flag": self.flag}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.flag = state["flag"]
