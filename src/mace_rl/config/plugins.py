"""Code of the user's own that the configuration names as "package.module:Name".

Modules are looked for where Python finds them and, after that, in the folder that the command is
given in.
"""

import importlib
import importlib.util
import inspect
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from mace_rl.config.section import ConfigError


def load(reference: str, key: str) -> Any:
    """What "package.module:Name" names; `ConfigError` with the `key` that names it if nothing."""
    name = reference.partition(":")[2]
    module = import_module(reference, key)
    if not hasattr(module, name):
        raise ConfigError(f"{key} has {reference!r}, but {module.__file__} has no {name!r}")
    return getattr(module, name)


def make(reference: str, key: str, *given: Any, **arguments: Any) -> Any:
    """What "package.module:Name" returns; `ConfigError` if it does not take these arguments."""
    factory = load(reference, key)
    try:
        inspect.signature(factory).bind(*given, **arguments)
    except TypeError as error:
        raise ConfigError(f"{key} has {reference!r} with {arguments}: {error}") from None
    return factory(*given, **arguments)


def import_module(reference: str, key: str) -> ModuleType:
    """The module in "package.module:Name", imported; `ConfigError` if it cannot be."""
    _look_here_too()
    try:
        return importlib.import_module(reference.partition(":")[0])
    except ImportError as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{key} has {reference!r}, which cannot be imported: {reason}") from None


def source_file(reference: str, key: str) -> Path:
    """The Python file of the module in "package.module:Name", found without importing it."""
    _look_here_too()
    module = reference.partition(":")[0]
    try:
        spec = importlib.util.find_spec(module)
    except ImportError:
        spec = None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        raise ConfigError(
            f"{key} has {reference!r}, but there is no Python module {module!r}, neither installed "
            f"nor in {os.getcwd()}"
        )
    return Path(spec.origin)


def _look_here_too() -> None:
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
