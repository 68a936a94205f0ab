"""Which source files a result depends on, and their content as one digest.

Snakemake does not look into the modules that a script imports, and of a declared input it records
what the file contained when the job *ended*. Here the imports are followed, and the workflow hands
each job the digest of what it found when it was planned.
"""

import ast
import hashlib
import re
from pathlib import Path

PACKAGE = Path(__file__).parent


def sources(path: Path) -> list[Path]:
    """`path` and the modules of this package that it imports, directly or not, in fixed order.

    Imports inside functions count, and so do references such as "mace_rl.hopper:Class" in strings.
    """
    found = {PACKAGE / "__init__.py"}
    pending = [path]
    while pending:
        file = pending.pop()
        if file not in found:
            found.add(file)
            modules = [PACKAGE / f"{name}.py" for name in _imported(file)]
            pending.extend(module for module in modules if module.exists())
    return sorted(found, key=_name)


def digest(path: Path) -> str:
    """SHA-256 over the names and contents of `sources(path)`, hexadecimal."""
    lines = [
        f"{_name(file)} {hashlib.sha256(file.read_bytes()).hexdigest()}\n" for file in sources(path)
    ]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _name(file: Path) -> str:
    """Folder and name: the same wherever the project lies."""
    return f"{file.parent.name}/{file.name}"


def _imported(file: Path) -> set[str]:
    """The names following `mace_rl.` in what a file imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_bytes(), str(file))):
        match node:
            case ast.ImportFrom(module="mace_rl", names=imported):
                names |= {alias.name for alias in imported}
            case ast.ImportFrom(module=str(module)):
                names |= _submodule(module)
            case ast.Import(names=imported):
                for alias in imported:
                    names |= _submodule(alias.name)
            case ast.Constant(value=str(text)):
                names |= _submodule(text)
    return names


def _submodule(reference: str) -> set[str]:
    found = re.fullmatch(r"mace_rl\.(\w+)([.:][\w.]+)?", reference)
    return {found[1]} if found else set()
