#!/usr/bin/env bash
# memory-gym 1.0.2 beside gymnasium 1.4.0: pip says nothing and takes an older one, written for gym.
# Expected: the newest memory-gym, whose environments are Gymnasium's, or an error about a conflict.
# Behaviour: each release from 0.3.2 on pins another gymnasium exactly, so pip goes back to the first
#   that does not, which registers its environments with gym: none of them is in Gymnasium's registry.
# Seen: memory-gym 0.3.0, 0 in gymnasium, 8 in gym
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q gymnasium==1.4.0 'memory-gym<=1.0.2' gym==0.26.2 numpy==2.4.6 2>/dev/null
cd "$folder"
cat >main.py <<'PYTHON'
import importlib.metadata

import gym
import gymnasium
import memory_gym  # noqa: F401  (registers them)


def own(registry):
    entries = (str(spec.entry_point) for spec in registry.values())
    return sum("memory_gym" in entry for entry in entries)


version = importlib.metadata.version("memory-gym")
counts = f"{own(gymnasium.registry)} in gymnasium, {own(gym.envs.registry)} in gym"
print(f"memory-gym {version}, {counts}")
PYTHON
found=$("$folder/env/bin/python" -W ignore main.py 2>/dev/null | tail -n 1)
echo "$found"
[ "$found" = "memory-gym 0.3.0, 0 in gymnasium, 8 in gym" ]
