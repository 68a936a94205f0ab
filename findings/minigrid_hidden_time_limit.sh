#!/usr/bin/env bash
# minigrid 3.2.0 under gymnasium 1.4.0: the time limit is one that Gymnasium neither knows nor can lengthen.
# Expected: spec.max_episode_steps says after how many steps an episode is truncated, as in Gymnasium's own
#   environments, and make(max_episode_steps=N) makes it N.
# Behaviour: the spec says None; the environment counts by itself, to a max_steps of its constructor, so a
#   longer limit given to make changes nothing (a shorter one does). None means no limit elsewhere.
# Seen: CartPole-v1 says 500, with 1000 given 1000; MiniGrid-DoorKey-5x5-v0 says None, with 1000 given 250
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q gymnasium==1.4.0 minigrid==3.2.0 numpy==2.4.6
found=$("$folder/env/bin/python" -W ignore - <<'PYTHON'
import gymnasium
import minigrid

TURN = {"CartPole-v1": None, "MiniGrid-DoorKey-5x5-v0": 0}  # None: keep the pole up
found = []
for name, action in TURN.items():
    env = gymnasium.make(name, max_episode_steps=1000)
    observation, _ = env.reset(seed=0)
    steps, truncated, terminated = 0, False, False
    while not (truncated or terminated):
        upright = int(observation @ (0.1, 0.5, 6.0, 1.0) > 0) if action is None else action
        observation, _, terminated, truncated, _ = env.step(upright)
        steps += 1
    said = gymnasium.spec(name).max_episode_steps
    found.append(f"{name} says {said}, with 1000 given {steps if truncated else 'terminated'}")
print("; ".join(found))
PYTHON
)
echo "$found"
[ "$found" = "CartPole-v1 says 500, with 1000 given 1000; MiniGrid-DoorKey-5x5-v0 says None, with 1000 given 250" ]
