"""Write environment.lock and environment-cuda.lock from the requirements in pyproject.toml.

Called by `make lock` with uv, the resolver, in the interpreter's own environment. Pins that are
already in the locks stay as they are unless a requirement or the option --upgrade asks otherwise.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

MAIN, CUDA = Path("environment.lock"), Path("environment-cuda.lock")

MAIN_HEADER = """\
# Every package of the environment, with the sha256 of each of its release files. Python 3.11.
# Written by `make lock` from pyproject.toml: change that, not this file.
# Installed by `make` (tools/setup.sh says how, and how torch's CPU build is preferred).
"""
CUDA_HEADER = """\
# What torch's ordinary Linux build needs besides environment.lock, and its CPU build does not.
# Written by `make lock`; installed by `make` only if the torch it got asks for these packages.
"""
# How the names of the packages begin that only torch's ordinary Linux build requires.
CUDA_NAMES = ("cuda-", "nvidia-", "triton")


def resolve(
    preferences: str,
    upgrade: bool,
    requirements: Sequence[str] = ("pyproject.toml", "--all-extras"),
) -> str:
    """Return all pins with their hashes as requirements text, keeping `preferences` if it can.

    `requirements`: where they stand, as the resolver's arguments.
    """
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder, "resolved.txt")
        output.write_text(preferences)
        command = [sys.executable, "-m", "uv", "pip", "compile", *requirements]
        command += ["--python-version=3.11", "--python-platform=linux"]
        command += ["--generate-hashes", "--no-header"]
        command += ["--no-emit-index-url", "--no-emit-find-links", "--no-config", "--quiet"]
        command += ["--upgrade"] if upgrade else []
        # The resolver's settings in the environment would make the lock depend on the machine.
        environment = {k: v for k, v in os.environ.items() if not k.startswith("UV_")}
        subprocess.run([*command, f"--output-file={output}"], check=True, env=environment)
        return output.read_text()


def entries(resolved: str) -> dict[str, str]:
    """Split requirements text into {`name==version`: the whole entry}."""
    blocks = re.findall(r"^(\S+)( \\\n(?: .*\n)+)", resolved, re.MULTILINE)
    if len(blocks) != len(re.findall(r"^[^\s#]", resolved, re.MULTILINE)):
        sys.exit("lock: the resolver wrote something that is no pin with hashes; nothing changed")
    return {pin: pin + body for pin, body in blocks}


def with_hashes(entry: str, hashes: list[str]) -> str:
    """Add the sha256 `hashes` to a lock entry, keeping its hashes sorted and unique."""
    found = set(re.findall(r"--hash=sha256:([0-9a-f]{64})", entry)) | set(hashes)
    head = entry.split(" \\\n")[0]
    comments = [line for line in entry.splitlines() if line.startswith("    #")]
    lines = [f"    --hash=sha256:{value}" for value in sorted(found)]
    return " \\\n".join([head, *lines]) + "\n" + "".join(f"{line}\n" for line in comments)


def main() -> None:
    """Resolve, add the hashes that the index does not list, and write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--upgrade", action="store_true", help="take the newest allowed releases")
    upgrade = parser.parse_args().upgrade
    preferences = "".join(path.read_text() for path in (MAIN, CUDA) if path.exists())
    extra = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["mace-rl"]["extra-hashes"]
    try:
        pins = entries(resolve(preferences, upgrade))
    except subprocess.CalledProcessError as error:
        sys.exit(f"lock: the resolver failed (exit code {error.returncode}); nothing changed")
    for pin, hashes in extra.items():
        if pin not in pins:
            sys.exit(
                f"lock: pyproject.toml has extra-hashes for {pin}, which is not what was resolved: "
                "replace them by the hashes of the new version; nothing changed"
            )
        pins[pin] = with_hashes(pins[pin], hashes)
    cuda = {pin for pin in pins if pin.startswith(CUDA_NAMES)}
    MAIN.write_text(MAIN_HEADER + "".join(pins[pin] for pin in pins if pin not in cuda))
    CUDA.write_text(CUDA_HEADER + "".join(pins[pin] for pin in pins if pin in cuda))
    print(f"{MAIN}: {len(pins) - len(cuda)} packages; {CUDA}: {len(cuda)} packages")


if __name__ == "__main__":
    main()
