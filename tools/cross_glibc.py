"""Train under other versions of the C library and compare to the bit.

    .venv/bin/python -m tools.cross_glibc FOLDER ...

Compiled code takes exp, log, sin, cos and pow from the system's C library, and so do Bullet and
Python itself. A FOLDER holds an unpacked libc6 package of Debian, newer than this system's:

    apt-get download libc6=VERSION && dpkg-deb -x libc6_*.deb FOLDER
"""

import argparse
import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from mace_rl import files

# Every environment of the paper, with everything that the method has.
EPISODES = {"CartPole-v1": 80, "Acrobot-v1": 30, "HopperBulletEnv-v0": 100}
LIBRARIES = Path("usr", "lib", sysconfig.get_config_var("MULTIARCH"))
LOADER = "ld-linux-x86-64.so.2"


def started_by(folder: Path | None) -> list[str]:
    """How to start this Python with the C library in `folder`; None: with the system's."""
    if folder is None:
        return [sys.executable]
    libraries = folder / LIBRARIES
    path = f"{libraries}:{Path('/') / LIBRARIES}"  # all else is the system's
    loader = [str(libraries / LOADER), "--library-path", path, "--argv0", sys.executable]
    return [*loader, os.path.realpath(sys.executable)]


def version(start: list[str]) -> str:
    """The version of the C library that a Python so started has, as it says itself."""
    code = "import os; print(os.confstr('CS_GNU_LIBC_VERSION'))"
    found = subprocess.run([*start, "-c", code], capture_output=True, text=True)
    if found.returncode:
        sys.exit(f"cross-glibc: {' '.join(start[:1])}: {last_line(found)}")
    return found.stdout.strip()


def last_line(said: subprocess.CompletedProcess[str]) -> str:
    """What a process that failed said last, or how it ended."""
    return (said.stderr.strip().splitlines() or [f"it ended with {said.returncode}"])[-1]


def train(start: list[str], environment: str, folder: Path) -> dict[str, bytes]:
    """The results of one training in `folder`, by file."""
    command = [*start, "-m", "mace_rl.cli", "train", "--env", environment, "--seed", "0"]
    command += ["--variant", "mace_full", "--episodes", str(EPISODES[environment])]
    done = subprocess.run([*command, "--out", str(folder)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"cross-glibc: a training failed: {last_line(done)}")
    return {name: (folder / name).read_bytes() for name in files.RESULTS}


def main() -> None:
    """Entry point; exits with 1 if anything differs."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.cross_glibc libc6_unpacked",
    )
    parser.add_argument("folder", nargs="+", type=Path, help="an unpacked libc6 package")
    folders = parser.parse_args().folder
    for folder in folders:
        if not (folder / LIBRARIES / LOADER).exists():
            sys.exit(f"cross-glibc: {folder}: no {LIBRARIES / LOADER} in it")
    different = 0
    with tempfile.TemporaryDirectory() as temporary:
        # What is compiled under one version is not for the next.
        os.environ["NUMBA_CACHE_DIR"] = f"{temporary}/native"
        here = started_by(None)
        expected = {env: train(here, env, Path(temporary, "native", env)) for env in EPISODES}
        print(f"{version(here)}: trained", flush=True)
        for number, folder in enumerate(folders):
            os.environ["NUMBA_CACHE_DIR"] = f"{temporary}/{number}"
            start = started_by(folder.resolve())
            for env, results in expected.items():
                found = train(start, env, Path(temporary, str(number), env))
                unequal = [name for name in results if found[name] != results[name]]
                different += bool(unequal)
                verdict = f"different: {', '.join(unequal)}" if unequal else "equal to the bit"
                print(f"{version(start)}, {env}: {verdict}", flush=True)
    if different:
        sys.exit(f"cross-glibc: {different} trainings differ")


if __name__ == "__main__":
    main()
