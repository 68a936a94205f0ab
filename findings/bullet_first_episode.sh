#!/usr/bin/env bash
# pybullet-envs-gymnasium 0.6.0, pybullet 3.2.7: the first episode after gymnasium.make is one of its own.
# Expected: reset(seed=0) and equal actions give equal rewards, whenever it is called.
# Behaviour: the robot's joints are moved to their random start before Bullet's state is saved, once; later
#   resets restore that state first, and so begin otherwise. Reacher, which saves none, repeats itself.
# Seen: Hopper, Walker2D, HalfCheetah, Ant: other equal equal; Reacher: equal equal equal
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q gymnasium==1.4.0 pybullet==3.2.7 pybullet-envs-gymnasium==0.6.0 numpy==2.4.6
"$folder/env/bin/python" - >"$folder/found" <<'PYTHON'
import gymnasium
import numpy as np
import pybullet_envs_gymnasium


def rewards(env):
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (10, *env.action_space.shape))
    return [float(env.step(action.astype(np.float32))[1]) for action in actions]


robots = {}
for robot in ("Hopper", "Walker2D", "HalfCheetah", "Ant", "Reacher"):
    env = gymnasium.make(f"{robot}BulletEnv-v0")
    played = [rewards(env) for _ in range(4)]
    words = ["equal" if a == b else "other" for a, b in zip(played, played[1:])]
    robots.setdefault(" ".join(words), []).append(robot)
print("seen:", "; ".join(f"{', '.join(names)}: {words}" for words, names in robots.items()))
PYTHON
found=$(grep -o "seen: .*" "$folder/found") # among what Bullet prints
echo "$found"
[ "$found" = "seen: Hopper, Walker2D, HalfCheetah, Ant: other equal equal; Reacher: equal equal equal" ]
