"""Whether a long `mace_full` run slows down or grows: a row for each tenth of it.

The environments are random walks of fixed length that cost next to nothing, so that every episode
is the same work and nearly all of it our own.
"""

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from benchmarks.measuring import (
    ACROBOT,
    FIRST_SEED,
    HOPPER,
    Scale,
    in_fresh_process,
    memory_mb,
)
from benchmarks.speed import our_config

# Shaped like Acrobot and like Hopper, with their settings and time limits.
WALKS = {"AcrobotLikeWalk-v0": ACROBOT, "HopperLikeWalk-v0": HOPPER}


class Walk(gymnasium.Env):
    """States wander around 0 whatever the action; the reward is the first coordinate."""

    def __init__(self, size: int, action_space: gymnasium.Space) -> None:
        self.observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        """Start at 0."""
        super().reset(seed=seed)
        self.state = np.zeros(self.observation_space.shape, np.float32)
        return self.state, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """An AR(1) process; never terminates."""
        noise = self.np_random.standard_normal(self.state.shape, np.float32)
        self.state = np.float32(0.95) * self.state + np.float32(0.3) * noise
        return self.state, float(self.state[0]), False, False, {}


def register() -> None:
    """Make the walks known to Gymnasium."""
    for name, size, action_space, limit in (
        ("AcrobotLikeWalk-v0", 6, Discrete(3), 500),
        ("HopperLikeWalk-v0", 15, Box(-1, 1, (3,), np.float32), 1000),
    ):
        arguments = {"size": size, "action_space": action_space}
        gymnasium.register(name, entry_point=Walk, max_episode_steps=limit, kwargs=arguments)


def measure(scale: Scale) -> list[dict[str, Any]]:
    """Ten rows for `mace_full` on each of the walks."""
    found = [in_fresh_process(tenths, walk, scale.growth_episodes) for walk in WALKS]
    return [row for rows in found for row in rows]


def tenths(walk: str, episodes: int) -> list[dict[str, Any]]:
    """Steps and CPU time until the end of each tenth of one run, and memory there."""
    from mace_rl.training.trainer import Trainer

    register()
    config = our_config("mace_full", WALKS[walk], FIRST_SEED)
    trainer = Trainer(config.model_copy(update={"environment": walk, "episodes": episodes}))
    rows, start = [], time.process_time()
    for records in trainer.run():
        if records[-1].episode % (episodes // 10) == 0:
            times = {"cpu_seconds": time.process_time() - start, "memory_mb": memory_mb("VmRSS")}
            rows.append({"env": walk, "part": str(len(rows) + 1)} | times)
            rows[-1]["steps"] = records[-1].env_steps
    return rows
