"""Which source files a result depends on, and their content as one digest.

Snakemake does not look into the modules that a script imports, and of a declared input it records
what the file contained when the job *ended*. Here the imports are followed, and the workflow hands
each job the digest of what it found when it was planned.
"""

import ast
import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TypeGuard

from mace_rl.refusal import Refusal

PACKAGE = Path(__file__).parent
NAME = PACKAGE.name  # mace_rl


class SourceError(Refusal, ImportError):
    """An import that cannot be followed; the message names the file and the line."""


def sources(path: Path) -> list[Path]:
    """`path` and the modules of this package that it imports, directly or not, in fixed order.

    Every form of import counts: absolute and relative, of packages, modules and names, inside
    functions, and references such as "mace_rl.environments.hopper:Class" in strings. Importing a
    module runs the `__init__.py` of each package around it, so these are among its sources. Raises
    `SourceError` for an import of this package that leads nowhere.
    """
    found: set[Path] = set()
    pending = [path, PACKAGE / "__init__.py"]
    while pending:
        file = pending.pop()
        if file not in found:
            found.add(file)
            pending.extend(_imported(file))
    return sorted(found, key=_label)


def digest(*paths: Path) -> str:
    """SHA-256 over the names and contents of the `sources` of all `paths`, hexadecimal.

    Of a file outside this package the file itself counts and what it imports of this package, but
    not what else it imports.
    """
    return _digest(sorted({file for path in paths for file in sources(path)}, key=_label))


@cache
def package_digest() -> str:
    """SHA-256 over every Python file of this package, hexadecimal."""
    return _digest(sorted(PACKAGE.rglob("*.py")))


def _digest(files: Iterable[Path]) -> str:
    lines = [f"{_label(file)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n" for file in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _label(file: Path) -> str:
    """The file's place in this package, or its folder and name: the same wherever both lie."""
    inside = file.is_relative_to(PACKAGE)
    return str(file.relative_to(PACKAGE.parent)) if inside else f"{file.parent.name}/{file.name}"


def _imported(file: Path) -> Iterator[Path]:
    """The files of this package that importing `file` runs."""
    own = file.relative_to(PACKAGE.parent).with_suffix("") if file.is_relative_to(PACKAGE) else None
    for node in _imports(file.read_bytes(), str(file)):
        where = f"{file}, line {node.lineno}"
        match node:
            case ast.ImportFrom(module=module, names=names, level=level):
                if level:
                    if own is None:
                        continue  # relative to a package that is not this one
                    base = [*own.parts[: len(own.parts) - level], *(module or "").split(".")]
                    module = ".".join(filter(None, base))
                if _is_ours(module):
                    for alias in names:
                        yield from _module(module, where, alias.name)
            case ast.Import(names=names):
                for alias in names:
                    if _is_ours(alias.name):
                        yield from _module(alias.name, where)
            case ast.Constant(value=str(text)) if re.fullmatch(rf"{NAME}(\.\w+)+(:\w+)?", text):
                yield from _named(text)


@cache  # the scripts of a workflow share most of their sources
def _imports(content: bytes, name: str) -> list[ast.Import | ast.ImportFrom | ast.Constant]:
    """All import statements and constants of a file with this content."""
    kinds = ast.Import | ast.ImportFrom | ast.Constant
    return [node for node in ast.walk(ast.parse(content, name)) if isinstance(node, kinds)]


def _is_ours(module: str | None) -> TypeGuard[str]:
    return module is not None and module.partition(".")[0] == NAME


def _module(module: str, where: str, name: str | None = None) -> Iterator[Path]:
    """The files that `import module`, or `from module import name`, runs."""
    place = PACKAGE.parent
    for part in module.split("."):
        place = place / part
        if (place / "__init__.py").exists():
            yield place / "__init__.py"
        elif place.with_suffix(".py").exists():
            yield place.with_suffix(".py")
        else:
            raise SourceError(f"{where}: there is no module {module!r} in this package")
    if name is not None and place.is_dir():
        if (place / f"{name}.py").exists() or (place / name / "__init__.py").exists():
            yield from _module(f"{module}.{name}", where)
        elif name not in _defined(place / "__init__.py"):
            raise SourceError(f"{where}: there is no {name!r} in {module!r}")


def _named(text: str) -> Iterator[Path]:
    """The files behind a string "mace_rl.package.module:name" or ….name; none if it is no such."""
    module = text.partition(":")[0]
    for candidate in (module, module.rpartition(".")[0]):
        try:
            yield from list(_module(candidate, ""))
        except SourceError:
            continue
        return


def _defined(file: Path) -> set[str]:
    """The names that a module's own statements bind."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_bytes(), str(file))):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add(name)
            case ast.Name(id=name, ctx=ast.Store()):
                names.add(name)
            case ast.Import(names=aliases) | ast.ImportFrom(names=aliases):
                names |= {alias.asname or alias.name for alias in aliases}
    return names
