"""MACE-RL: PPO with episodic memory, curiosity and a meta-learnt curiosity weight β."""

import os
import sys
from pathlib import Path

from mace_rl.pins import pin
from mace_rl.sources import PACKAGE, digest

pin()  # before NumPy and what computes with it is imported

# numba's cache on disk does not notice an edit in another file than the cached function's own, so
# each state of this package gets a folder to itself. numba reads the variable when it is imported.
_cache = Path(os.environ.get("NUMBA_CACHE_DIR", PACKAGE / "__pycache__" / "numba"))
_state = digest("everything")[:16]
_cache = _cache if _cache.name == _state else _cache / _state
os.environ["NUMBA_CACHE_DIR"] = str(_cache)
if "numba" in sys.modules:
    sys.modules["numba"].config.CACHE_DIR = str(_cache)
