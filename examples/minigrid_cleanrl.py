"""PPO in one file, in the style of CleanRL, on MiniGrid, with the curiosity reward.

    python examples/minigrid_cleanrl.py --steps 60000

Only the two lines with `CuriosityReward` and `reward_extrinsic` are about the bonus.
"""

import argparse
import sys

import mace_rl.base.cpu_features  # noqa: F401  # isort: skip  (before NumPy: equal bits on every processor)

import gymnasium
import minigrid  # noqa: F401  (registers its environments)
import numpy as np
import torch
from gymnasium.wrappers import FlattenObservation
from minigrid.wrappers import ImgObsWrapper
from torch import nn
from torch.distributions import Categorical

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
ROLLOUT, EPOCHS, MINIBATCH, DISCOUNT, GAE, CLIP = 512, 4, 128, 0.99, 0.95, 0.2

torch.manual_seed(arguments.seed)
base = CuriosityReward(gymnasium.make(arguments.environment), seed=arguments.seed)
env = FlattenObservation(ImgObsWrapper(base))
size, actions = env.observation_space.shape[0], int(env.action_space.n)


def network(outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    )


actor, critic = network(actions), network(1)
optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-4, eps=1e-5)
observation, _ = env.reset(seed=arguments.seed)
returns, extrinsic = [], 0.0
for _ in range(max(1, arguments.steps // ROLLOUT)):
    seen = torch.zeros(ROLLOUT + 1, size)
    taken = torch.zeros(ROLLOUT, dtype=torch.int64)
    log_probs, rewards, ended = torch.zeros(3, ROLLOUT)
    for t in range(ROLLOUT):
        seen[t] = torch.as_tensor(observation, dtype=torch.float32) / 10
        with torch.no_grad():
            policy = Categorical(logits=actor(seen[t]))
        taken[t] = policy.sample()
        log_probs[t] = policy.log_prob(taken[t])
        observation, reward, terminated, truncated, info = env.step(int(taken[t]))
        rewards[t], ended[t] = float(reward), float(terminated or truncated)
        extrinsic += info["reward_extrinsic"]
        if terminated or truncated:
            returns.append(extrinsic)
            extrinsic, (observation, _) = 0.0, env.reset()
    seen[ROLLOUT] = torch.as_tensor(observation, dtype=torch.float32) / 10
    with torch.no_grad():
        values = critic(seen)[:, 0]
    advantages, following = torch.zeros(ROLLOUT), torch.zeros(())
    for t in reversed(range(ROLLOUT)):
        goes_on = 1 - ended[t]
        delta = rewards[t] + DISCOUNT * goes_on * values[t + 1] - values[t]
        advantages[t] = following = delta + DISCOUNT * GAE * goes_on * following
    targets = advantages + values[:-1]
    for _ in range(EPOCHS):
        for chosen in torch.randperm(ROLLOUT).split(MINIBATCH):
            policy = Categorical(logits=actor(seen[chosen]))
            ratio = (policy.log_prob(taken[chosen]) - log_probs[chosen]).exp()
            own = advantages[chosen]
            own = (own - own.mean()) / (own.std() + 1e-8)
            surrogate = torch.min(ratio * own, ratio.clip(1 - CLIP, 1 + CLIP) * own).mean()
            error = (critic(seen[chosen])[:, 0] - targets[chosen]).square().mean()
            loss = -surrogate + 0.5 * error - 0.01 * policy.entropy().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters()], 0.5)
            optimiser.step()
if not returns:
    sys.exit(f"no episode ended in --steps {arguments.steps}: give more")
last = returns[-max(1, len(returns) // 5) :]
print(f"mean extrinsic return of the last fifth of {len(returns)} episodes: {np.mean(last):.2f}")
