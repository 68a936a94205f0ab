"""Generated tasks: seas, corridors and lakes, with and without archives, sparse and dense.

None of them is a task of the study: maps and mappings are drawn. Some have the size of one, with
another number of pages.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

SCREEN = 3  # numbers of a page where observations are coordinates


@dataclass(frozen=True)
class Map:
    """Cells and moves: what an action does in a cell; the start is cell 0."""

    places: np.ndarray  # [cells, 2], each from 0 to 1
    next: np.ndarray  # int [cells, actions]
    reward: np.ndarray  # [cells, actions]
    end: np.ndarray  # bool [cells]: the episode is over there
    goal: np.ndarray  # bool [cells, actions]: the moves that solve the task

    def distances(self) -> np.ndarray:
        """Steps to have solved the task, from each cell; inf where there is no way."""
        found = np.where(self.goal.any(1), 1.0, np.inf)
        for _ in found:
            following = np.where(self.end, np.inf, found)[self.next].min(1)
            found = np.where(self.end, np.inf, np.minimum(found, 1 + following))
        return found


def sea(size: int, rng: np.random.RandomState) -> Map:
    """A deep sea (Osband et al. 2020) with a mapping of its own."""
    cells = size * size + 1
    row, column = np.divmod(np.arange(cells - 1), size)
    right = np.arange(2) == rng.binomial(1, 0.5, cells - 1)[:, None]
    across = np.clip(column[:, None] + np.where(right, 1, -1), 0, size - 1)
    below = np.where(row[:, None] == size - 1, cells - 1, (row[:, None] + 1) * size + across)
    goal = right & ((row == size - 1) & (column == size - 1))[:, None]
    places = np.stack([column, row], 1) / size
    return closed(np.vstack([places, [[1, 1]]]), below, goal - 0.01 / size * right, goal)


def corridor(size: int, rng: np.random.RandomState) -> Map:
    """Straight on, where the action that leads on is drawn for each cell."""
    cell = np.arange(size)
    on = np.arange(2) == rng.binomial(1, 0.5, size)[:, None]
    beside = np.where(on, cell[:, None] + 1, np.maximum(cell[:, None] - 1, 0))
    goal = on & (cell == size - 1)[:, None]
    places = np.stack([np.arange(size + 1) / size, np.zeros(size + 1)], 1)
    return closed(places, beside, goal - 0.01 / size * on, goal)


def closed(places: np.ndarray, after: np.ndarray, reward: np.ndarray, goal: np.ndarray) -> Map:
    """A map with a last cell that ends an episode."""
    end = np.arange(len(places)) == len(places) - 1
    none = np.zeros((1, after.shape[1]))
    return Map(
        *(places, np.vstack([after, none]).astype(int), np.vstack([reward, none]), end),
        np.vstack([goal, none]).astype(bool),
    )


def lake(size: int, rng: np.random.RandomState) -> Map:
    """A frozen lake without slipping: a fifth of the cells are holes, and there is a way."""
    cells = np.arange(size * size)
    row, column = np.divmod(cells, size)
    steps = ((0, -1), (1, 0), (0, 1), (-1, 0))
    beside = np.stack(
        [
            np.clip(row + down, 0, size - 1) * size + np.clip(column + across, 0, size - 1)
            for down, across in steps
        ],
        1,
    )
    while True:
        end = rng.rand(len(cells)) < 0.2
        end[[0, -1]] = False, True
        if cells[-1] in reached(beside, end):
            goal = (beside == cells[-1]) & ~end[:, None]
            return Map(np.stack([column, row], 1) / (size - 1), beside, goal * 1.0, end, goal)


def reached(after: np.ndarray, end: np.ndarray) -> set[int]:
    """The cells that can be come to."""
    seen, waiting = {0}, deque([0])
    while waiting:
        cell = waiting.popleft()
        for one in set(after[cell].tolist()) - seen if not end[cell] else ():
            seen.add(one)
            waiting.append(one)
    return seen


def made_dense(world: Map) -> Map:
    """Each step toward the goal pays its share of 1, each step away costs it."""
    distance = world.distances()
    known = np.where(np.isfinite(distance), distance, distance[np.isfinite(distance)].max() + 1)
    pay = (known[:, None] - known[world.next]) / distance[0]
    pay = np.where(world.end[world.next], 0.0, pay)
    pay = np.where(world.goal, known[:, None] / distance[0], pay) * ~world.end[:, None]
    return Map(world.places, world.next, pay, world.end, world.goal)


class Generated(gymnasium.Env[Any, Any]):
    """A task on a generated map; with `pages`, an archive whose door is near its start or goal.

    Behind the door, one action more, the rest of the episode shows pages drawn anew at 0.001 a
    step. Observation: the number of the cell, then of the page; or coordinates and a screen.
    """

    MAPS = {"sea": sea, "corridor": corridor, "lake": lake}  # noqa: RUF012

    def __init__(
        self, kind: str, size: int, seed: int, pages: int, door: str, dense: bool, coordinates: bool
    ) -> None:
        world = self.MAPS[kind](size, np.random.RandomState(seed))
        self.distance = world.distances()
        self.world = made_dense(world) if dense else world
        self.cells, self.actions = world.next.shape
        near = np.flatnonzero(self.distance <= 2)
        self.doors = set() if pages == 0 else {0} if door == "start" else set(near.tolist())
        self.pages, self.coordinates = pages, coordinates
        self.action_space = Discrete(self.actions + (pages > 0))
        screen = SCREEN * (pages > 0)
        self.observation_space = (
            Box(-1, 1, (2 + screen,), np.float32) if coordinates else Discrete(self.cells + pages)
        )

    def observe(self) -> np.ndarray | int:
        """The cell, or another page."""
        if not self.coordinates:
            page = self.reading and self.cells + int(self.np_random.integers(self.pages))
            return page or self.cell
        seen = np.zeros(self.observation_space.shape or (), np.float32)
        seen[:2] = 2 * self.world.places[self.cell] - 1
        seen[2:] = self.np_random.uniform(-1, 1, len(seen) - 2) if self.reading else 0
        return seen

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """To the start."""
        super().reset(seed=seed)
        self.cell, self.reading = 0, False
        return self.observe(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One cell on, or another page."""
        self.reading |= action == self.actions and self.cell in self.doors
        if self.reading:
            return self.observe(), -0.001, False, False, {}
        move = self.cell, action % self.actions
        self.cell = int(self.world.next[move])
        end = bool(self.world.end[self.cell])
        return self.observe(), float(self.world.reward[move]), end, False, {}


gymnasium.register("Generated-v0", "extras.pretrained.tasks:Generated", max_episode_steps=100)
