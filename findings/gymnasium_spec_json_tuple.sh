#!/usr/bin/env bash
# gymnasium 1.4.0: an environment's spec that went through JSON cannot remake a ResizeObservation.
# Expected: `gymnasium.make(EnvSpec.from_json(env.spec.to_json()))` gives the environment again, since
#   the wrapper records its constructor's arguments and the spec has its own JSON.
# Behaviour: the tuple `shape` comes back as a list, which the wrapper refuses.
# Seen: TypeError ResizeObservation requires shape to be a tuple, got <class 'list'>
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q gymnasium==1.4.0 numpy==2.4.6 opencv-python-headless==5.0.0.93
cd "$folder"
cat >picture.py <<'PYTHON'
import gymnasium
import numpy as np


class Picture(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (96, 96, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros((96, 96, 3), np.uint8), {}

    def step(self, action):
        return np.zeros((96, 96, 3), np.uint8), 0.0, True, False, {}
PYTHON
cat >main.py <<'PYTHON'
import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import ResizeObservation

gymnasium.register("Picture-v0", "picture:Picture")
env = ResizeObservation(gymnasium.make("Picture-v0"), (64, 64))
gymnasium.make(env.spec)  # the spec itself does it
try:
    gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    print("made")
except Exception as error:
    print(type(error).__name__, error)
PYTHON
found=$("$folder/env/bin/python" -W ignore main.py | tail -n 1)
echo "$found"
[ "$found" = "TypeError ResizeObservation requires shape to be a tuple, got <class 'list'>" ]
