"""Write benchmarks/environment.lock: what requirements.txt needs besides the project's own locks.

Called by `make bench-lock` with uv in the interpreter's own environment.
"""

import sys
from pathlib import Path

sys.path[0] = "tools"  # instead of this folder, which also has a lock.py

import lock  # noqa: E402

REQUIREMENTS = Path("benchmarks/requirements.txt")
LOCK = Path("benchmarks/environment.lock")
HEADER = """\
# What the benchmark needs besides ../environment.lock, with the sha256 of each release file.
# Written by `make bench-lock` from requirements.txt; installed by `make bench`.
"""


def main() -> None:
    """Resolve under the project's pins, and keep what is not among them."""
    project = [lock.MAIN, lock.CUDA]
    constraints = [f"--constraint={path}" for path in project]
    resolved = lock.resolve("", False, [str(REQUIREMENTS), *constraints])
    known = lock.entries("".join(path.read_text() for path in project))
    extra = {pin: entry for pin, entry in lock.entries(resolved).items() if pin not in known}
    LOCK.write_text(HEADER + "".join(extra.values()))
    print(f"{LOCK}: {', '.join(extra)}")


if __name__ == "__main__":
    main()
