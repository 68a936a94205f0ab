#!/usr/bin/env bash
# scipy 1.17.1: the exact p value of permutation_test hangs on the unit of the data.
# Expected: sums of flipped signs of 0.1, 0.2, -0.3 are those of 1, 2, -3 over ten, so p is 5/8 for both.
# Behaviour: ties are told within a share (1e-14) of the observed statistic. Where that is 0 but for rounding
#   nothing is left to tell them by, and a sign pattern that ties counts as smaller.
# Seen: 1 2 -3: 0.625, 0.1 0.2 -0.3: 0.5
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q numpy==2.4.6 scipy==1.17.1
found=$("$folder/env/bin/python" - <<'PYTHON'
import numpy as np
from scipy.stats import permutation_test


def p(*differences):
    how = {"permutation_type": "samples", "alternative": "greater", "n_resamples": np.inf}
    return permutation_test((np.array(differences),), np.mean, **how).pvalue


print(f"1 2 -3: {p(1, 2, -3)}, 0.1 0.2 -0.3: {p(0.1, 0.2, -0.3)}")
PYTHON
)
echo "$found"
[ "$found" = "1 2 -3: 0.625, 0.1 0.2 -0.3: 0.5" ]
