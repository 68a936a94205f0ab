#!/usr/bin/env bash
# numba 0.68.1: the cache on disk does not notice an edit of what a cached function calls.
# Expected: with `cache=True` a changed source compiles anew, as the documentation says of the file.
# Behaviour: only the file of the cached function counts. One that it calls, in another file, is
#   compiled into it; after an edit of that file the next process still runs the old code.
# Seen: 1 then 1
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install -q numba==0.68.1 numpy==2.4.6
cd "$folder"
cat >caller.py <<'PYTHON'
from numba import njit

from callee import value


@njit(cache=True)
def ask():
    return value()


print(ask())
PYTHON
write() { printf 'from numba import njit\n\n\n@njit(cache=True)\ndef value():\n    return %s\n' "$1" >callee.py; }
export NUMBA_CACHE_DIR="$folder/cache"
write 1
before=$("$folder/env/bin/python" caller.py)
sleep 1.1 # another time stamp
write 2
after=$("$folder/env/bin/python" caller.py)
echo "$before then $after"
[ "$before then $after" = "1 then 1" ]
