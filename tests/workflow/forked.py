"""Snakemake in a copy of a process that has imported it, which is most of what planning takes."""

import multiprocessing
import os
import sys
from pathlib import Path

FORKS = multiprocessing.get_context("forkserver")
# Nothing of this project: its code is that of the folder where Snakemake runs.
FORKS.set_forkserver_preload(["gymnasium", "matplotlib.colors", "snakemake.cli"])


def run(words: list[str], folder: Path, environment: dict[str, str], output: Path) -> int:
    """Carry out `words`, a command of Snakemake; returns its exit code."""
    process = FORKS.Process(target=_run, args=(words, folder, environment, output))
    process.start()
    process.join(900)
    if process.exitcode is None:
        process.kill()
        raise TimeoutError(f"{words} does not end")
    return process.exitcode


def _run(words: list[str], folder: Path, environment: dict[str, str], output: Path) -> None:
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:0] = environment["PYTHONPATH"].split(os.pathsep)
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(file, stream.fileno())
    sys.argv = words
    from snakemake.cli import main

    main()
