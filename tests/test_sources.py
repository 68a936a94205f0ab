"""What a result depends on: every form of import, in a small package of the same name."""

import os
import re
import shutil
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from mace_rl import sources

SCRIPTS = sorted((sources.PACKAGE.parents[1] / "workflow" / "scripts").glob("*.py"))


@pytest.fixture
def package(tmp_path: Path) -> ModuleType:
    """`sources` of a package with mace_rl/top.py, mace_rl/a/b.py, mace_rl/other/c.py."""
    folder = tmp_path / "mace_rl"
    for name in ("a", "other"):
        (folder / name).mkdir(parents=True)
    for name in ("__init__", "top", "a/__init__", "a/b", "other/__init__", "other/c"):
        (folder / f"{name}.py").write_text("x = 1\n")
    shutil.copy(sources.__file__, folder)
    spec = spec_from_file_location("sources_of_a_copy", folder / "sources.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def depends(package: ModuleType, importer: Path, imported: str) -> bool:
    """Whether the importer's digest changes with the imported file, and back with it."""
    file = package.PACKAGE / imported
    before, content = package.digest(importer), file.read_text()
    file.write_text("x = 2\n")
    after = package.digest(importer)
    file.write_text(content)
    assert package.digest(importer) == before
    return after != before


ABSOLUTE = [
    "import mace_rl.a.b",
    "import os, mace_rl.a.b as b",
    "from mace_rl.a import b",
    "from mace_rl.a import (\n    x,\n    b as c,\n)",
    "from mace_rl.a.b import x",
    "from mace_rl.a.b import *",
    "def later():\n    import mace_rl.a.b",
    "try:\n    from mace_rl.a import b\nexcept ImportError:\n    pass",
    'where = "mace_rl.a.b:x"',
    'where = ["mace_rl.a.b"]',
    'where = f("mace_rl.a.b.x")',
]
RELATIVE = {  # from which file
    "from . import b": "a/own",
    "from .b import x": "a/own",
    "from .a import b": "own",
    "from .a.b import x": "own",
    "from ..a import b": "other/own",
    "from ..a.b import x": "other/own",
    "from .. import a\nfrom ..a.b import x": "other/own",
    "from .a.b import x as y": "__init__",
    "from .b import x as z": "a/__init__",
}


@pytest.mark.parametrize("text", ABSOLUTE)
@pytest.mark.parametrize("place", ["script", "mace_rl/own", "mace_rl/other/own"])
def test_absolute_imports(package: ModuleType, place: str, text: str) -> None:
    importer = package.PACKAGE.parent / f"{place}.py"
    importer.write_text(text)
    assert depends(package, importer, "a/b.py") and depends(package, importer, "a/__init__.py")
    assert depends(package, importer, "__init__.py")
    assert not depends(package, importer, "other/c.py") and not depends(package, importer, "top.py")


@pytest.mark.parametrize("text", RELATIVE)
def test_relative_and_indirect_imports(package: ModuleType, text: str) -> None:
    importer, script = (
        package.PACKAGE / f"{RELATIVE[text]}.py",
        package.PACKAGE.parent / "script.py",
    )
    importer.write_text(text)
    module = f"mace_rl/{RELATIVE[text]}".removesuffix("/__init__").replace("/", ".")
    script.write_text(f"import {module}")
    for file in (importer, script):
        assert depends(package, file, "a/b.py") and not depends(package, file, "top.py")


NOWHERE = {
    "import mace_rl.nothing": "there is no module 'mace_rl.nothing'",
    "import mace_rl.a.b.nothing": "there is no module 'mace_rl.a.b.nothing'",
    "from mace_rl import nothing": "there is no 'nothing' in 'mace_rl'",
    "from mace_rl.a import x, nothing": "there is no 'nothing' in 'mace_rl.a'",
    "from mace_rl.a.nothing import x": "there is no module 'mace_rl.a.nothing'",
    "def later():\n    from . import nothing": "there is no 'nothing' in 'mace_rl'",
    "from .nothing import x": "there is no module 'mace_rl.nothing'",
}


@pytest.mark.parametrize("text", NOWHERE)
def test_imports_that_lead_nowhere_are_refused(package: ModuleType, text: str) -> None:
    importer = package.PACKAGE / "own.py"
    importer.write_text(text)
    with pytest.raises(package.SourceError, match=NOWHERE[text]) as refusal:
        package.digest(importer)
    lines = len(text.splitlines())
    assert str(refusal.value).startswith(f"{importer}, line {lines}: ")


def test_what_is_no_import_of_this_package(package: ModuleType) -> None:
    script = package.PACKAGE.parent / "script.py"
    script.write_text(
        '"""See mace_rl.top."""\nimport mace_rlx.top, numpy\nfrom .mace_rl import top\n'
        '# import mace_rl.top\nnames = "mace_rl.nothing:x", "mace_rl.top and more"\n'
    )
    assert not depends(package, script, "top.py")


def test_a_digest_goes_by_content_and_not_by_place(package: ModuleType) -> None:
    digests = set()
    for place in ("one", "two"):
        script = package.PACKAGE.parent / place / "scripts" / "top.py"  # named like a module
        script.parent.mkdir(parents=True)
        script.write_text("import mace_rl.top\n")
        digests |= {package.digest(script) for _ in range(3)}
    assert len(digests) == 1
    other = package.PACKAGE.parent / "other.py"
    other.write_text("import mace_rl.a\n")
    both = package.digest(script, other)
    assert both == package.digest(other, script) and both not in digests
    script.write_text("import mace_rl.top as top\n")
    assert package.digest(script) not in digests


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_sources_are_what_is_imported(script: Path) -> None:
    """Everything of the package that Python loads for a script is among its sources."""
    imports = re.findall(r"^\s*((?:from|import) (?!job\b).*)", script.read_text(), re.M)
    code = "\n".join(["import sys", *imports, "for m in sys.modules.copy().values():"])
    code += "\n    print(getattr(m, '__file__', ''))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {Path(line) for line in done.stdout.splitlines() if "/mace_rl/" in line}
    assert loaded <= {*sources.sources(script), Path(sources.__file__)}
    assert len(loaded) > 3 or script.name == "job.py"


@pytest.mark.slow
def test_compiled_code_notices_an_edit_in_another_file(tmp_path: Path) -> None:
    """numba keeps what it compiled; of a caller's file alone it would notice an edit."""
    ignored = shutil.ignore_patterns("__pycache__")
    package = shutil.copytree(sources.PACKAGE, tmp_path / "mace_rl", ignore=ignored)
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    del environment["NUMBA_CACHE_DIR"]
    command = [sys.executable, "-c", "from mace_rl.beta.lstm import sigmoid; print(sigmoid(1.0))"]

    def outcome() -> float:
        return float(subprocess.run(command, env=environment, stdout=-1, check=True).stdout)

    assert outcome() == pytest.approx(0.7310586)
    kernels = package / "agent" / "kernels.py"
    text = kernels.read_text(encoding="utf-8")
    assert "return np.float32(2) * p * q" in text
    kernels.write_text(text.replace("return np.float32(2) *", "return np.float32(4) *"))
    assert outcome() == pytest.approx(0.5 + 2 * 0.2310586)
    kernels.write_text(text)
    assert outcome() == pytest.approx(0.7310586)
