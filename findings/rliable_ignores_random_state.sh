#!/usr/bin/env bash
# rliable 1.2.0: get_interval_estimates takes a random_state and draws from NumPy's global one.
# Expected: equal scores and an equal random_state give equal intervals.
# Behaviour: its bootstrap hands random_state on, but picks runs by np.random.choice; so only
#   np.random.seed repeats an interval, and a call moves everyone's generator.
# Seen: equal random_state other, np.random.seed equal
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q rliable==1.2.0 arch==7.2.0 numpy==2.4.6 pandas==2.3.3 scipy==1.17.1
found=$("$folder/env/bin/python" -W ignore - <<'PYTHON'
import numpy as np
from rliable import library, metrics

scores = {"agent": np.random.default_rng(0).normal(size=(10, 3))}  # [runs, tasks]


def interval(**how):
    def iqm(values):
        return np.array([metrics.aggregate_iqm(values)])

    return library.get_interval_estimates(scores, iqm, reps=500, **how)[1]["agent"].ravel().tolist()


given = [interval(random_state=np.random.RandomState(0)) for _ in range(2)]
seeded = []
for _ in range(2):
    np.random.seed(0)
    seeded.append(interval())
words = ["equal" if a == b else "other" for a, b in (given, seeded)]
print(f"equal random_state {words[0]}, np.random.seed {words[1]}")
PYTHON
)
echo "$found"
[ "$found" = "equal random_state other, np.random.seed equal" ]
