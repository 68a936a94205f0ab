"""Playing with a trained agent."""

from pathlib import Path

import numpy as np

from mace_rl.numerics.arrays import total
from mace_rl.runs.agent import Player
from mace_rl.runs.finished import FinishedRun
from mace_rl.training.resuming import seeded
from mace_rl.training.rollout import draw_noise, rollout_for


def evaluate(
    directory: Path, episodes: int, seed: int, deterministic: bool = False, trust: bool = False
) -> np.ndarray:
    """Undiscounted extrinsic returns, [episodes], of the agent in `directory`.

    It samples actions as in training, or takes the most probable ones if `deterministic`. Both the
    environment and the actions draw from `seed`, so the environment draws the same either way.
    """
    drawn = np.random.SeedSequence(seed)  # by networks with dropout, and some environments
    with seeded(drawn):
        player = Player.of(FinishedRun(directory.absolute(), trust))
    environment, policy = player.environment, player.acting(deterministic)
    rollout = rollout_for(environment, policy)
    generator = np.random.default_rng(seed)
    returns: list[float] = []
    with seeded(drawn):
        environment.env.reset(seed=seed)
        for _ in range(episodes):
            played = rollout(environment, policy, draw_noise(environment, generator))
            returns.append(total(played.rewards))
    environment.env.close()
    return np.array(returns)
