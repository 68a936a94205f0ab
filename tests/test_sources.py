"""What a result depends on: everything that is really imported, and nothing by time or place."""

import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

from mace_rl import sources

SCRIPTS = sources.PACKAGE.parents[1] / "workflow" / "scripts"
PARTS = dict.fromkeys((path.stem for path in SCRIPTS.glob("*.py")), "evaluation")
PARTS |= {"train": "training", "report": "everything"}


@pytest.mark.slow
@pytest.mark.parametrize("script", PARTS)
def test_whatever_a_script_imports_counts(script: str) -> None:
    """As `code` in workflow/rules/study.smk has it; the script's own imports stand inside it."""
    text = (SCRIPTS / f"{script}.py").read_text(encoding="utf-8")
    imports = [
        line.strip() for line in text.splitlines() if line.strip().startswith("from mace_rl")
    ]
    code = "\n".join([*imports, "import sys", "print(*sys.modules)"])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = [name.replace(".", "/") for name in done.stdout.split() if name.startswith("mace_rl.")]
    places = [sources.PACKAGE.parent / name for name in names]
    loaded = {place / "__init__.py" if place.is_dir() else Path(f"{place}.py") for place in places}
    assert imports and loaded
    assert loaded <= set(sources.files(PARTS[script]))


CHANGES = [  # of a file, and what then has other sources
    ("agent/ppo.py", {"training", "everything"}),
    ("config/agent.py", {"training", "evaluation", "everything"}),
    ("results/metrics.py", {"evaluation", "everything"}),
    ("results/records.py", {"training", "evaluation", "everything"}),
    ("report/page.py", {"everything"}),
    ("runs/progress.py", {"everything"}),
    ("a_new_file.py", {"training", "evaluation", "everything"}),
]


@pytest.mark.parametrize(("name", "expected"), CHANGES)
def test_what_an_edit_changes(tmp_path: Path, name: str, expected: set[str]) -> None:
    """By content: the digests are those of the package itself, and come back with it."""

    def digests(*own: Path) -> dict[str, str]:
        spec = spec_from_file_location("sources_of_a_copy", tmp_path / "mace_rl" / "sources.py")
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return {part: module.digest(part, *own) for part in module.NO_PART}

    copytree(sources.PACKAGE, tmp_path / "mace_rl", ignore=ignore_patterns("__pycache__"))
    before = digests()
    assert before == {part: sources.digest(part) for part in sources.NO_PART}
    file = tmp_path / "mace_rl" / name
    content = file.read_bytes() if file.exists() else None
    file.write_bytes((content or b"") + b"\n")
    assert {part for part, value in digests().items() if value != before[part]} == expected
    own = tmp_path / "own.py"
    own.touch()
    with_own = digests(own)
    own.write_text("x = 1\n")
    assert all(digests(own)[part] != value for part, value in with_own.items())


def test_what_takes_no_part_exists() -> None:
    for names in sources.NO_PART.values():
        assert all((sources.PACKAGE / name).exists() for name in names)
