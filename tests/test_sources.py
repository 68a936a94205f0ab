"""What a result depends on, by content: tests/test_run.py compares it with what is imported."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

from mace_rl import sources

PARTS = ("training", "everything")
CHANGES = [  # of a file, and whether a training has other sources then
    ("agent/ppo.py", True),
    ("config/agent.py", True),
    ("study/measure/metrics.py", False),
    ("records.py", True),
    ("study/show/report.py", False),
    ("a_new_file.py", True),
    ("beta/weights.npz", True),
]


@pytest.mark.parametrize(("name", "expected"), CHANGES)
def test_what_an_edit_changes(tmp_path: Path, name: str, expected: bool) -> None:
    """By content: the digests are those of the package itself, and come back with it."""

    def digests(*own: Path) -> dict[str, str]:
        spec = spec_from_file_location("sources_of_a_copy", tmp_path / "mace_rl" / "sources.py")
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return {part: module.digest(part, *own) for part in PARTS}

    copytree(sources.PACKAGE, tmp_path / "mace_rl", ignore=ignore_patterns("__pycache__"))
    before = digests()
    assert before == {part: sources.digest(part) for part in PARTS}
    file = tmp_path / "mace_rl" / name
    content = file.read_bytes() if file.exists() else None
    file.write_bytes((content or b"") + b"\n")
    changed = {part for part, value in digests().items() if value != before[part]}
    assert changed == ({"training", "everything"} if expected else {"everything"})
    own = tmp_path / "own.py"
    own.touch()
    with_own = digests(own)
    own.write_text("x = 1\n")
    assert all(digests(own)[part] != value for part, value in with_own.items())


def test_what_takes_no_part_exists() -> None:
    assert all((sources.PACKAGE / name).exists() for name in sources.NO_PART)
