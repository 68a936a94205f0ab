"""Lives in generated tasks, continued from the same point under several βs."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from extras.pretrained.gauge import WINDOWS, Gauge
from extras.pretrained.tasks import Generated
from mace_rl.base.state import Stateful
from mace_rl.beta.controller import BetaController
from mace_rl.config.run import RunConfig
from mace_rl.environments.episode import Episode
from mace_rl.library import settings
from mace_rl.numerics.arrays import total
from mace_rl.training.trainer import Trainer

GRID = (0.01, 0.2, 0.99)  # the βs under which a life goes on
LATEST = 0.85  # the share of a life after which it is not continued any more

Choice = Callable[[Gauge], float]  # β after a window


@dataclass
class Branch:
    """A point of a life: what was seen so far, and what was still earned under each β of `GRID`."""

    task: int
    seen: list[list[float]]  # the features of each window
    earned: list[float]  # per episode of the whole budget, in units of solving the task


class Chosen(Stateful, BetaController):
    """β from a choice after each window."""

    STATE = ("gauge", "now")

    def __init__(self, episodes: int, choose: Choice) -> None:
        self.gauge, self.choose, self.now = Gauge(episodes), choose, 0.4

    def next_beta(self) -> float:
        """See `BetaController`."""
        return self.now

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        if self.gauge.update(total(episode.rewards), total(bonus), len(episode)):
            self.now = self.choose(self.gauge)


def by_chance(rng: np.random.Generator) -> Choice:
    """A constant β of the grid, changed up to three times."""
    times = np.sort(rng.integers(0, WINDOWS, rng.integers(0, 4)))
    values = rng.choice(GRID, len(times) + 1)
    return lambda gauge: float(values[np.searchsorted(times, len(gauge.windows), side="right")])


def task_config(number: int) -> RunConfig:
    """Task `number`, drawn: its map, archive, budget and the rates with which PPO learns it."""
    rng = np.random.default_rng([number, 5000])
    hard = rng.random() < 0.6  # where nothing is found without a bonus; else where one may harm
    kind = str(rng.choice(["sea", "corridor", "lake"]))
    sizes = {"sea": (8, 13), "corridor": (13, 21), "lake": (6, 9)}
    size = int(rng.integers(*sizes[kind])) if hard else int(rng.integers(4, 9))
    size -= size == 10 and kind == "sea"  # the study's own
    arguments: dict[str, Any] = {
        "kind": kind,
        "size": size,
        "seed": int(rng.integers(1, 10**6)),
        "pages": 0 if rng.random() < (0.7 if hard else 0.4) else int(rng.integers(100, 801)),
        "door": "end" if rng.random() < 0.3 else "start",
        "dense": not hard and rng.random() < 0.25,
        "coordinates": kind != "sea" and rng.random() < 0.35,
    }
    shortest = Generated(**arguments).distance[0]
    limit = int(shortest * rng.uniform(1.1, 1.8 if hard else 3)) + 1
    if kind == "sea":
        limit = size + 4 * (arguments["door"] == "end" and arguments["pages"] > 0)
    rate = float(rng.choice([0.0007, 0.001, 0.002]))
    changes: dict[str, Any] = {
        "episodes": int(rng.choice([400, 600, 900])),
        "environment_arguments": arguments,
        "max_episode_steps": limit,
        "beta": {"kind": "constant", "value": 0.4},  # replaced by `Chosen`
        "memory": {"capacity": 200},
        "ppo": {
            "rollout_steps": int(rng.choice([32, 64, 96])),
            "actor_learning_rate": rate,  # lives in fast motion
            "critic_learning_rate": 3 * rate,
        },
    }
    return settings("Generated-v0", "mace_fixed", **changes)


def constant(beta: float, gauge: Gauge) -> float:
    """The same β after every window."""
    return beta


def begin(config: RunConfig, choose: Choice) -> Trainer:
    """A training whose β is chosen so."""
    trainer = Trainer(config)
    trainer.controller = Chosen(config.episodes, choose)
    return trainer


def branches(number: int, seed: int, choose: Choice | None, count: int = 2) -> list[Branch]:
    """Live in task `number`, by chance or as `choose` says; branch at up to `count` windows."""
    rng = np.random.default_rng([number, seed])
    config = task_config(number).model_copy(update={"seed": seed})
    points = sorted({max(1, int(WINDOWS * LATEST * u * u)) for u in rng.random(count)})
    trainer = begin(config, choose or by_chance(rng))
    found = []
    with threadpool_limits(1):
        for _ in trainer.run():
            assert isinstance(trainer.controller, Chosen)
            gauge = trainer.controller.gauge
            if points and len(gauge.windows) >= points[0]:
                points.pop(0)
                found.append(Branch(number, [*gauge.windows], futures(config, trainer)))
            if not points:
                return found
    return found


def futures(config: RunConfig, trainer: Trainer) -> list[float]:
    """What is still earned under each β of the grid, with the same random numbers."""
    state, played = trainer.state_dict(), len(trainer.records)
    earned = []
    for beta in GRID:
        future = begin(config, partial(constant, beta))
        future.load_state_dict(copy.deepcopy(state))
        assert isinstance(future.controller, Chosen)
        future.controller.now = beta
        for _ in future.run():
            pass
        rest = sum(record.extrinsic_return for record in future.records[played:])
        earned.append(rest / config.episodes)
    return earned
