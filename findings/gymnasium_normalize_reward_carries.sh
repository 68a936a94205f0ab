#!/usr/bin/env bash
# gymnasium 1.4.0: NormalizeReward carries the discounted return from one episode into the next.
# Expected: its running return, whose variance scales rewards, begins at 0 in each episode, as in
#   stable-baselines3's VecNormalize. With reward 1 and γ = 0.9 it is 1 after an episode's first step.
# Behaviour: a termination forgets what came before the last reward, but not that; a truncation by a
#   time limit, and `reset`, forget nothing.
# Seen: terminated 1.90, truncated 9.66
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q gymnasium==1.4.0 numpy==2.4.6
cd "$folder"
cat >main.py <<'PYTHON'
import gymnasium
import numpy as np
from gymnasium.wrappers import NormalizeReward, TimeLimit


class One(gymnasium.Env):
    """Pays 1 in each of 32 steps, the last of which ends it, unless a time limit comes first."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(1, np.float32), 1.0, self.steps == 32, False, {}


def after_one_step(env):
    """The running return after the first step of the second episode."""
    env = NormalizeReward(env, gamma=0.9)
    env.reset(seed=0)
    while not any(env.step(0)[2:4]):
        pass
    env.reset()
    env.step(0)
    return env.discounted_reward.item()


found = after_one_step(One()), after_one_step(TimeLimit(One(), 31))
print(f"terminated {found[0]:.2f}, truncated {found[1]:.2f}")
PYTHON
found=$("$folder/env/bin/python" -W ignore main.py)
echo "$found"
[ "$found" = "terminated 1.90, truncated 9.66" ]
