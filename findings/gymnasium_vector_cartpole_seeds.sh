#!/usr/bin/env bash
# gymnasium 1.4.0: with a seed, make_vec("CartPole-v1") begins nowhere that make("CartPole-v1") does.
# Expected: reset(seed=0) of n environments begins number i as make(...).reset(seed=i), which is what
#   SyncVectorEnv documents, and the first one's start does not depend on n.
# Behaviour: by default make_vec takes a CartPole of its own, which fills an array of all starts from one
#   generator, variable by variable. So the same seed gives other episodes, and others for each n.
# Seen: sync like make, default unlike make; first of 1, 2, 3: other, other
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q gymnasium==1.4.0 numpy==2.4.6
found=$("$folder/env/bin/python" - <<'PYTHON'
import gymnasium
import numpy as np


def starts(count, **how):
    return gymnasium.make_vec("CartPole-v1", count, **how).reset(seed=0)[0]


alone = np.array([gymnasium.make("CartPole-v1").reset(seed=seed)[0] for seed in range(3)])
found = []
for name, how in {"sync": {"vectorization_mode": "sync"}, "default": {}}.items():
    found.append(f"{name} {'like' if np.array_equal(starts(3, **how), alone) else 'unlike'} make")
firsts = [starts(count)[0] for count in (1, 2, 3)]
words = ["equal" if np.array_equal(a, b) else "other" for a, b in zip(firsts, firsts[1:])]
print(f"{', '.join(found)}; first of 1, 2, 3: {', '.join(words)}")
PYTHON
)
echo "$found"
[ "$found" = "sync like make, default unlike make; first of 1, 2, 3: other, other" ]
