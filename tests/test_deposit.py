"""The archive for a DOI: what is committed, as other programs see it, equal each time."""

import subprocess
from pathlib import Path

import pytest

from tools.deposit import DepositError, deposit

ROOT = Path(__file__).parents[1]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (ROOT / ".git").exists(), reason="only a clone can be deposited"),
]


def run(*command: str | Path, cwd: Path) -> str:
    """What a command prints."""
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A clone of this project as it is committed."""
    run("git", "clone", "-q", ROOT, tmp_path / "clone", cwd=tmp_path)
    return tmp_path / "clone"


def test_the_archive_is_the_commit_and_its_checksums_hold(clone, tmp_path):
    name, data = deposit(clone)
    (tmp_path / name).write_bytes(data)
    run("tar", "-xf", name, cwd=tmp_path)
    folder = tmp_path / name.removesuffix(".tar")
    run("sha256sum", "--check", "--quiet", "--strict", "SHA256SUMS", cwd=folder)
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    tracked = run("git", "ls-files", "-z", cwd=clone).split("\0")[:-1]
    assert files == {*tracked, "SHA256SUMS"}
    assert {"environment.lock", "LICENSE", "reference/README.md"} <= files
    assert all((folder / path).read_bytes() == (clone / path).read_bytes() for path in tracked)
    assert (folder / ".ci/run").stat().st_mode & 0o111
    assert (folder / "src/mace_rl/config/defaults.yaml").is_symlink()
    with (tmp_path / name).open("rb") as file:
        said = subprocess.run(["git", "get-tar-commit-id"], stdin=file, capture_output=True)
    assert said.stdout.decode() == run("git", "rev-parse", "HEAD", cwd=clone)


def test_equal_bytes_again_from_another_clone(clone, tmp_path):
    run("git", "clone", "-q", clone, tmp_path / "a second clöne", cwd=tmp_path)
    for path in (tmp_path / "a second clöne").rglob("*.py"):
        path.touch()
        path.chmod(0o600)
    assert deposit(tmp_path / "a second clöne") == deposit(clone) == deposit(clone)


@pytest.mark.parametrize("change", ["README.md", "a new file"])
def test_what_is_not_committed_is_refused(clone, change):
    (clone / change).write_text("changed")
    with pytest.raises(DepositError, match=rf"^not committed: .*{change}\W*$"):
        deposit(clone)
