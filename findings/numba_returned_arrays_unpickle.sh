#!/usr/bin/env bash
# numba 0.68.1: each array that a compiled function returns costs a call into Python, which unpickles.
# Expected: a compiled function gives its results back in C; arguments are read so.
# Behaviour: for each array, numba.core.serialize._numba_unpickle looks up numpy.ndarray again.
# Seen: unpickled: 0 for three arguments, 1 for an array, 3 for three arrays, 0 for a number
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q numba==0.68.1 numpy==2.4.6
found=$("$folder/env/bin/python" - <<'PYTHON'
import sys

import numpy as np
from numba import njit

functions = {
    "three arguments": njit(lambda a, b, c: None),
    "an array": njit(lambda a, b, c: a),
    "three arrays": njit(lambda a, b, c: (a, b, c)),
    "a number": njit(lambda a, b, c: a[0]),
}
array, found = np.zeros(3), []
for name, function in functions.items():
    calls = []
    for _ in range(2):  # the first compiles
        calls.clear()
        sys.setprofile(lambda frame, event, _: calls.append((event, frame.f_code.co_name)))
        function(array, array, array)
        sys.setprofile(None)
    found.append(f"{calls.count(('call', '_numba_unpickle'))} for {name}")
print("unpickled:", ", ".join(found))
PYTHON
)
echo "$found"
[ "$found" = "unpickled: 0 for three arguments, 1 for an array, 3 for three arrays, 0 for a number" ]
