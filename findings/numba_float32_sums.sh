#!/usr/bin/env bash
# numba 0.68.1: np.mean and np.std of float32 are far from NumPy's.
# Expected: inside a compiled function they differ from NumPy's by rounding.
# Behaviour: NumPy adds float32 pairwise; numba one after the other, in float32. Of a million numbers around
#   1000, of deviation 1, as observations or returns are, the mean is 9 too large and the deviation ninefold.
# Seen: NumPy 1000.0 and 1.0, numba 1008.9 and 9.0
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q numba==0.68.1 numpy==2.4.6
found=$("$folder/env/bin/python" - <<'PYTHON'
import numpy as np
from numba import njit

values = np.random.default_rng(0).normal(1000, 1, 10**6).astype(np.float32)


def moments(values):
    return np.mean(values), np.std(values)


told = ["{:.1f} and {:.1f}".format(*function(values)) for function in (moments, njit(moments))]
print(f"NumPy {told[0]}, numba {told[1]}")
PYTHON
)
echo "$found"
[ "$found" = "NumPy 1000.0 and 1.0, numba 1008.9 and 9.0" ]
