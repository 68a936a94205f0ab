"""stable-baselines3's PPO on MiniGrid, with the curiosity reward.

    python examples/minigrid_sb3.py --steps 60000

The bonus counts what MiniGrid gives, image and direction; the agent sees the image, flattened.
"""

import argparse
import sys

import mace_rl.base.cpu_features  # noqa: F401  # isort: skip  (before NumPy: equal bits on every processor)

import gymnasium
import minigrid  # noqa: F401  (registers its environments)
import numpy as np
from gymnasium.wrappers import FlattenObservation
from minigrid.wrappers import ImgObsWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

from mace_rl import CuriosityReward

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--environment", default="MiniGrid-DoorKey-5x5-v0", help="default: %(default)s")
parser.add_argument("--steps", type=int, default=60_000, help="default: %(default)s")
parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
arguments = parser.parse_args()
if arguments.steps < 1:
    parser.error(f"--steps is {arguments.steps}, but should be at least 1")
if arguments.environment not in gymnasium.registry:
    parser.error(f"--environment is {arguments.environment!r}, which nobody has registered")

monitor = Monitor(gymnasium.make(arguments.environment))  # inside: it sees extrinsic rewards
env = FlattenObservation(ImgObsWrapper(CuriosityReward(monitor, seed=arguments.seed)))
PPO("MlpPolicy", env, seed=arguments.seed, device="cpu").learn(arguments.steps)
returns = monitor.get_episode_rewards()
if not returns:
    sys.exit(f"no episode ended in --steps {arguments.steps}: give more")
last = returns[-max(1, len(returns) // 5) :]
print(f"mean extrinsic return of the last fifth of {len(returns)} episodes: {np.mean(last):.2f}")
