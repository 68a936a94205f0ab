"""numba's `njit`, with a cache on disk that notices every edit of kernels.

numba's own notices edits only in the file of the cached function. So each version of what kernels
come from gets its own folder, which is set only while a function of ours is decorated.
"""

import logging
import os
import stat
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

from mace_rl.base.code_digest import PACKAGE, kernels
from mace_rl.base.errors import Refusal

config: Any = numba.config  # which it fills as it is imported
if config.DISABLE_JIT:
    raise Refusal("NUMBA_DISABLE_JIT is set, but this code runs compiled only: unset it")
# If this cannot be written, numba takes the user's folder for caches. config.CACHE_DIR is not read:
# a .numba_config.yaml in the current folder sets it, and what is there is run.
FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or PACKAGE / "__pycache__" / "numba")
FOLDER /= kernels()[:16]


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """The decorator `numba.njit(**options)`."""

    def compiled(function: Callable[..., Any]) -> Any:
        before, config.CACHE_DIR = config.CACHE_DIR, str(FOLDER)
        try:
            return without_full_disks(numba.njit(**options)(function))
        except RuntimeError as error:
            if "no locator available" not in str(error):
                raise
            config.CACHE_DIR = spare_folder()
            return without_full_disks(numba.njit(**options)(function))
        finally:
            config.CACHE_DIR = before

    return compiled


def without_full_disks(function: Any) -> Any:
    """The same compiled function; if its code cannot be kept, it goes on without, and warns."""
    store = getattr(function, "_cache", None)  # nothing public is there
    if store is None:
        return function
    save = store.save_overload

    def save_if_possible(*compiled: Any) -> None:
        try:
            save(*compiled)
        except OSError as error:
            warn_unkept(f"{FOLDER.parent} ({error.strerror or error})")

    store.save_overload = save_if_possible
    return function


@cache
def warn_unkept(where: str) -> None:
    said = "compiled code cannot be kept in %s, and the next start compiles it again"
    logging.getLogger(__name__).warning(said, where)


@cache  # so it warns once
def spare_folder() -> str:
    """A temporary folder that only this user can write, since numba runs what it finds there."""
    folder = Path(tempfile.gettempdir(), f"mace-rl-numba-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if (found.st_mode, found.st_uid) != (stat.S_IFDIR | 0o700, os.getuid()):
        raise Refusal(f"{folder} is not this user's alone: let NUMBA_CACHE_DIR name a folder")
    said = "compiled code is kept in %s, since %s cannot be written; NUMBA_CACHE_DIR names another"
    logging.getLogger(__name__).warning(said, folder, FOLDER.parent)
    return str(folder / FOLDER.name)


# Division by zero gives Inf: an error would keep loops from becoming vector operations.
kernel = njit(cache=True, error_model="numpy")
