"""The user's own code, which the configuration names as "package.module:Name".

Modules are looked for where Python finds them, then in the current folder. A `run.json` may come
from somebody else: what it names from outside this package is imported only if it is trusted.
"""

import ast
import importlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from mace_rl.base.errors import Refusal, in_one_line
from mace_rl.config.section import ConfigError, short_repr


def code_outside(settings: Any) -> dict[str, str]:
    """By key, every text in plain settings, arguments too, that may name code from outside.

    That is every text with a ':', as in "package.module:Name" and ids of environments.
    """
    found, waiting = {}, [("", settings)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, Mapping):
            waiting += [(f"{key}.{name}".lstrip("."), part) for name, part in value.items()]
            waiting += [(key, name) for name in value]
        elif isinstance(value, list | tuple):
            waiting += [(key, part) for part in value]
        elif isinstance(value, str) and re.match(r"(?!mace_rl[.:]).*:", value, re.DOTALL):
            found[key] = value
    return found


def call_of(text: str) -> tuple[str, dict[str, Any]]:
    """Name and arguments in "name(key=literal, …)", or "name"; nothing in it is evaluated.

    Raises `ValueError` for anything else.
    """
    name, bracket, rest = text.partition("(")
    if not bracket:
        return text, {}
    try:
        call: Any = ast.parse(f"f({rest}", mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.args:
            raise ValueError
        names = [one.arg for one in call.keywords]
        if None in names or len({*names}) < len(names):
            raise ValueError
        return name, {str(one.arg): ast.literal_eval(one.value) for one in call.keywords}
    except (SyntaxError, TypeError, ValueError):  # TypeError: a list as the key of a dictionary
        raise ValueError("it should be a name, or name(key=literal, ...)") from None


def load(reference: str, key: str) -> Any:
    """The object at "package.module:Name"; `ConfigError`, with the `key`, if there is none."""
    name = reference.partition(":")[2]
    module = import_module(reference, key)
    if not hasattr(module, name):
        raise ConfigError(f"{key} has {reference!r}, but {module.__file__} has no {name!r}")
    return getattr(module, name)


def make(
    reference: str, key: str, kind: type, functions: bool, /, *given: Any, **arguments: Any
) -> Any:
    """An instance of the class "package.module:Name", made from `given` and `arguments`.

    The class has to be a subclass of `kind`. With `functions` it may be a function that returns a
    `kind`, but none of Python or this package. Raises `ConfigError` for anything else, before
    calling it, and if it does not take these arguments or raises one itself.
    """
    factory: Any = load(reference, key)
    if isinstance(factory, FunctionType):
        package = str(factory.__module__).partition(".")[0]
        fits = functions and package not in (*sys.stdlib_module_names, "mace_rl")
    else:
        fits = isinstance(factory, type) and issubclass(factory, kind)
    if not fits:
        wanted = f"a subclass of {kind.__module__}.{kind.__name__}"
        wanted += ", or a function of your own that returns one" if functions else ""
        raise ConfigError(f"{key} has {reference!r}, but it should name {wanted}")
    try:
        inspect.signature(factory).bind(*given, **arguments)
    except TypeError as error:
        raise ConfigError(f"{key} has {reference!r} with {arguments}: {error}") from None
    with noted(f"making {reference!r}"):
        try:
            made = factory(*given, **arguments)
        except ConfigError as error:
            raise ConfigError(f"{key} has {reference!r}: {error}") from None
    if not isinstance(made, kind):
        raise ConfigError(f"{key} has {reference!r}, which returned {short_repr(made)}")
    return made


@contextmanager
def noted(place: str) -> Iterator[None]:
    """A context in which an error of the user's code says where it was."""
    try:
        yield
    except Refusal:
        raise
    except Exception as error:
        error.add_note(f"in {place}")
        raise


def import_module(reference: str, key: str) -> ModuleType:
    """The module in "package.module:Name", imported; `ConfigError` if it cannot be."""
    _look_here_too()
    module = reference.partition(":")[0]
    try:
        if not all(part.isidentifier() for part in module.split(".")):
            raise ImportError(f"{module!r} is no module's name")
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise _unimportable(reference, key, error) from error


def _unimportable(reference: str, key: str, error: BaseException) -> ConfigError:
    return ConfigError(f"{key} has {reference!r}, which cannot be imported: {in_one_line(error)}")


def source_files(reference: str, key: str) -> list[Path]:
    """The Python file of a module; in a package all there, and weights.

    The packages that it is in are imported, not the module itself.
    """
    _look_here_too()
    module = reference.partition(":")[0]
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):  # the latter for __main__
        spec = None
    except (Exception, SystemExit) as error:
        raise _unimportable(reference, key, error) from error
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        raise ConfigError(
            f"{key} has {reference!r}, but there is no Python module {module!r}, neither installed "
            f"nor in {os.getcwd()}"
        )
    file = Path(spec.origin)
    in_package = (file.parent / "__init__.py").exists()
    return sorted([*file.parent.glob("*.py"), *file.parent.glob("*.npz")]) if in_package else [file]


def _look_here_too() -> None:
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
