"""numba's `njit`, with a cache on disk that notices every edit of this package.

numba's own does not notice an edit in another file than the cached function's. So each state of
this package gets a folder to itself, set while a function of ours is decorated and not longer: what
else is compiled in this process, a program of somebody's, has its cache where it had it.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from mace_rl.sources import PACKAGE, digest

config: Any = numba.config  # which it fills as it is imported
# Where this cannot be written, numba takes the user's folder for caches.
# Not config.CACHE_DIR, which a .numba_config.yaml in the current folder sets: what is there is run.
FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or PACKAGE / "__pycache__" / "numba")
FOLDER /= digest("everything")[:16]


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """The decorator `numba.njit(**options)`."""

    def compiled(function: Callable[..., Any]) -> Any:
        before, config.CACHE_DIR = config.CACHE_DIR, str(FOLDER)
        try:
            return numba.njit(**options)(function)
        finally:
            config.CACHE_DIR = before

    return compiled


# Division by zero is Inf, not an error, which would keep loops from becoming vector operations.
kernel = njit(cache=True, error_model="numpy")
