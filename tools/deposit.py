"""The committed tree as one file for a DOI repository, equal to the bit when made again.

    .venv/bin/python -m tools.deposit [FOLDER]        make archive      (FOLDER: dist)

FOLDER/mace-rl-VERSION.tar has what is committed (source, locks, reference runs), and SHA256SUMS of
all that. Times, owners and order depend on the commit only. It is not compressed: compressors
differ from version to version, and most of it is compressed already.
"""

import argparse
import hashlib
import io
import sys
import tarfile
import tomllib
from pathlib import Path

from mace_rl.base.files import write_atomically
from mace_rl.runs.provenance import GitError, git

ROOT = Path(__file__).resolve().parent.parent
SUMS = "SHA256SUMS"


class DepositError(RuntimeError):
    """A tree that is not to be deposited; the message says why."""


def committed(repository: Path) -> dict[str, tuple[bytes, int, str]]:
    """Content, mode and what it links to of each file at HEAD; `DepositError` if there is more."""
    if changed := git(repository, "status", "--porcelain").decode().splitlines():
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        raise DepositError(f"not committed: {changed[0][3:]}{more}")
    with tarfile.open(fileobj=io.BytesIO(git(repository, "archive", "HEAD"))) as tar:
        members = ((member, tar.extractfile(member)) for member in tar.getmembers())
        return {m.name: (f.read(), m.mode & 0o100, m.linkname) for m, f in members if f is not None}


def deposit(repository: Path) -> tuple[str, bytes]:
    """Name and content of the archive of HEAD; the same for the same commit, wherever it is."""
    found = committed(repository)
    project = tomllib.loads(found["pyproject.toml"][0].decode())["project"]
    root = f"{project['name']}-{project['version']}"
    sums = {name: hashlib.sha256(data).hexdigest() for name, (data, *_) in found.items()}
    lines = "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))
    found[SUMS] = lines.encode(), 0, ""
    commit, seconds = git(repository, "log", "-1", "--format=%H %ct").decode().split()
    buffer = io.BytesIO()
    named = {"comment": commit}  # where git itself puts it: `git get-tar-commit-id` reads it
    with tarfile.open(
        fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT, pax_headers=named
    ) as tar:
        for name, (data, executable, link) in sorted(found.items()):
            member = tarfile.TarInfo(f"{root}/{name}")
            member.size, member.mtime = 0 if link else len(data), int(seconds)
            member.type, member.linkname = tarfile.SYMTYPE if link else tarfile.REGTYPE, link
            member.mode = 0o755 if executable else 0o644
            tar.addfile(member, io.BytesIO(data))
    return f"{root}.tar", buffer.getvalue()


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.deposit /tmp/dist"
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", default=Path("dist"), help="(default: dist)"
    )
    folder: Path = parser.parse_args().folder
    try:
        name, data = deposit(ROOT)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / name, data)
    except (DepositError, GitError, OSError) as error:
        sys.exit(f"deposit: {error}")
    print(f"{hashlib.sha256(data).hexdigest()}  {folder / name}")


if __name__ == "__main__":
    main()
