"""Exploration tasks: environments in which random actions hardly ever see a reward.

id                              return of solving it; what makes it hard
SparseMountainCar-v0            1; the reward comes at the goal only
DeepSea10-v0, DeepSea20-v0      0.99; one sequence of 10 or 20 actions, each step against a cost
FrozenLake8x8Deterministic-v0   1; 14 steps without a mistake, holes around
CliffWalking200-v0              -13; random actions find the cliff, at -100 a fall
BarrenRegion-v0                 1; endless novelty elsewhere
NoisyMountainCar-v0             1; the same, as a television that an action switches on
NoisyDeepSea10-v0               0.99; the same, as an archive beside the start
NoisyDeepSea6-v0, …7-v0         0.99; an archive much larger than the sea: a bonus does harm
LateDeepSea7-v0                 0.99; an archive beside the goal: the right β changes
"""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.envs.classic_control import MountainCarEnv
from gymnasium.spaces import Box, Discrete


class SparseMountainCar(MountainCarEnv):
    """Gymnasium's MountainCar-v0 with reward 1 for reaching the goal and 0 until then."""

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        state, _, terminated, truncated, info = super().step(action)
        return state, float(terminated), terminated, truncated, info


class NoisyMountainCar(SparseMountainCar):
    """SparseMountainCar with a noisy television, which a fourth action watches.

    Watching (3) is coasting, and costs 0.001. Observation: position and velocity as in Gymnasium,
    then the picture: a new uniform number in [-1, 1] after watching, otherwise 0; float32 [3].
    """

    WATCH, COAST = 3, 1

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.action_space = Discrete(4)
        low, high = (np.append(x, np.float32(end)) for x, end in ((self.low, -1), (self.high, 1)))
        self.observation_space = Box(low, high, dtype=np.float32)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        state, info = super().reset(**kwargs)
        return np.append(state, np.float32(0)), info

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        watching = action == self.WATCH
        action = self.COAST if watching else action
        state, reward, terminated, truncated, info = super().step(action)
        shown = np.float32(self.np_random.uniform(-1, 1) if watching else 0)
        return np.append(state, shown), reward - 0.001 * watching, terminated, truncated, info


class DeepSea(gymnasium.Env):
    """Deep Sea (Osband et al. 2020, bsuite), deterministic: `size` × `size` cells, start top left.

    Every step leads one row down, and one column left or right as far as there is one. Right costs
    0.01 / `size`. Right in the last column, which only right all the way leads to, also gives 1. So
    returns are 0.99 or at most 0. bsuite's seed, not the environment's, draws for every cell which
    action is right.

    Observation: the number of the cell, row by row; `size`² after the last step.
    """

    MAPPING_SEED = 42  # of every deep sea in bsuite's sweep

    def __init__(self, size: int) -> None:
        self.size = size
        self.observation_space = Discrete(size * size + 1)
        self.action_space = Discrete(2)
        # The generator that bsuite has, whose numbers numpy keeps as they are for good.
        mapping = np.random.RandomState(self.MAPPING_SEED).binomial(1, 0.5, (size, size))
        self.right: list[int] = mapping.ravel().tolist()  # the action, for each cell

    def reset(self, **kwargs: Any) -> tuple[int, dict[str, Any]]:
        super().reset(**kwargs)
        self.row = self.column = 0
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        reward = 0.0
        if action == self.right[self.row * self.size + self.column]:
            reward = float(self.column == self.size - 1) - 0.01 / self.size
            self.column = min(self.column + 1, self.size - 1)
        else:
            self.column = max(self.column - 1, 0)
        self.row += 1
        bottom = self.row == self.size
        cell = self.size * self.size if bottom else self.row * self.size + self.column
        return cell, reward, bottom, False, {}


class NoisyDeepSea(DeepSea):
    """DeepSea with an archive of `pages` pages beside its start: much novelty, no reward.

    In the first row a third action leads into the archive for the rest of the episode: whatever the
    action, each step costs 0.001 and shows a random page. Elsewhere the third action does what 0
    does.

    Observation: the number of the cell as in DeepSea, `size`² after the last step; then the pages.
    """

    def __init__(self, size: int, pages: int) -> None:
        super().__init__(size)
        self.cells, self.pages = size * size + 1, pages
        self.observation_space = Discrete(self.cells + pages)
        self.action_space = Discrete(3)

    def reset(self, **kwargs: Any) -> tuple[int, dict[str, Any]]:
        self.reading = False
        return super().reset(**kwargs)

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.reading |= action == 2 and self.row == 0
        if not self.reading:
            return super().step(action % 2)
        self.row += 1
        page = self.cells + int(self.np_random.integers(self.pages))
        return page, -0.001, self.row == self.size, False, {}


class LateDeepSea(NoisyDeepSea):
    """DeepSea with an archive of `pages` pages beside its goal: the right β changes.

    In the last two cells of the diagonal a third action leads into the archive, where each step
    costs 0.001 and shows a page drawn anew, until the time limit. Elsewhere the third action does
    what 0 does. Without a bonus the diagonal is hardly found; if the bonus stays large, the policy
    that has found it turns aside for news.

    Observation: as in NoisyDeepSea.
    """

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """One row down, or another page."""
        self.reading |= action == 2 and self.row == self.column >= self.size - 2
        if not self.reading:
            return DeepSea.step(self, action % 2)
        page = self.cells + int(self.np_random.integers(self.pages))
        return page, -0.001, False, False, {}


class BarrenRegion(gymnasium.Env):
    """A corridor that leads to the reward, and a room with endless novelty that does not.

    From the start (S) one step east leads to the room (~), where every step costs 0.001. Twenty
    steps west, north and east lead to the goal (G), which gives 1 and ends the episode. Actions 0
    to 3 go north, east, south and west, or nowhere if there is a wall (#). In the room the
    observation has a screen with new random numbers every step; elsewhere these are 0.

    `screen=0` is the control: no numbers.

    Observation: east and north of the map's middle, each from -1 to 1; then `screen` numbers in
    [-1, 1]; float32 [2 + screen].
    """

    MAP = (
        "........G#####",
        ".#############",
        "........######",
        "#######.#~~~~~",
        "#######.S~~~~~",
    )
    REWARD: ClassVar = {"~": -0.001, "G": 1.0}  # for a step that ends there
    MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))  # in rows and columns

    def __init__(self, screen: int = 1) -> None:
        places = [(i, j) for i, row in enumerate(self.MAP) for j, c in enumerate(row) if c != "#"]
        self.kinds = [self.MAP[i][j] for i, j in places]
        last_row, last_column = len(self.MAP) - 1, len(self.MAP[0]) - 1
        self.coordinates = [(2 * j / last_column - 1, 1 - 2 * i / last_row) for i, j in places]
        number = {place: n for n, place in enumerate(places)}
        self.next = [  # cell, for each cell and action
            [number.get((i + down, j + right), n) for down, right in self.MOVES]
            for n, (i, j) in enumerate(places)
        ]
        self.screen = screen
        self.observation_space = Box(-1, 1, (2 + screen,), np.float32)
        self.action_space = Discrete(len(self.MOVES))

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(**kwargs)
        self.cell = self.kinds.index("S")
        return self._observe(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.cell = self.next[self.cell][action]
        kind = self.kinds[self.cell]
        return self._observe(), self.REWARD.get(kind, 0.0), kind == "G", False, {}

    def _observe(self) -> np.ndarray:
        observation = np.zeros(2 + self.screen, np.float32)
        observation[:2] = self.coordinates[self.cell]
        if self.kinds[self.cell] == "~":
            observation[2:] = self.np_random.uniform(-1, 1, self.screen)
        return observation
