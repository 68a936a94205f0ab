"""Trainings and tables under emulated processors are those made here, to the bit: make cross-cpu.

Libraries ask the processor what it can do, and who made it, and choose their code by that; under
qemu-user the emulated processor answers, and compiles everything for itself. Trainings are also
begun here and ended there, and the other way round. CROSS=short: two of them, `SHORT_CELLS`.

An emulator does what the instructions are defined to do. So this finds whatever depends on which
instructions are chosen, but not what real processors make of the same ones.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import pytest
from emulated import TABLES
from shared import ENVIRONMENTS, OUTCOME, ROOT, VARIANTS, provenance_of

pytestmark = [pytest.mark.slow, pytest.mark.emulated]

QEMU = "qemu-x86_64"
# Older ones read the wrong numbers where a gather, of which NumPy has many, has its index in ymm4:
# https://gitlab.com/qemu-project/qemu/-/issues/2474
OLDEST_QEMU = (9, 1)
HALVED = "mace_full"  # the variant with most in its checkpoint
PROCESSORS = ("Haswell", "EPYC", "Dhyana")  # by Intel, AMD, and Hygon, which few libraries know
SHORT_CELLS = {
    "Haswell": [("CartPole-v1", "mace_full")],
    "Dhyana": [("HopperBulletEnv-v0", "mace_fixed"), ("Acrobot-v1", "ppo")],
}
SHORT = os.environ.get("CROSS") == "short"
EVERY = [*product(ENVIRONMENTS, VARIANTS)]
CELLS = SHORT_CELLS if SHORT else dict.fromkeys(PROCESSORS, EVERY)
Task = tuple[str | bool, ...]  # of emulated.py


def carry_out(tasks: list[Task], scratch: Path, *prefix: str) -> None:
    """In a new process, whose command starts with `prefix`; numba's cache is in `scratch`."""
    command = [*prefix, sys.executable, str(Path(__file__).with_name("emulated.py"))]
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"NUMBA_CACHE_DIR": str(scratch / "numba"), "PYTHONPATH": paths}
    settings = {"env": environment, "capture_output": True, "text": True, "errors": "replace"}
    done = subprocess.run([*command, json.dumps(tasks)], **settings)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="session")
def emulator() -> str:
    """The emulator's path; fails with one line if it is missing, or too old to be right."""
    oldest = ".".join(map(str, OLDEST_QEMU))
    wanted = f"this wants Debian's package qemu-user, version {oldest} or newer"
    path = shutil.which(QEMU)
    if path is None:
        pytest.fail(f"there is no {QEMU}; {wanted}", pytrace=False)
    said = subprocess.run([path, "--version"], capture_output=True, text=True, check=True).stdout
    version = re.search(r"version (\d+)\.(\d+)", said)
    if version is None or tuple(map(int, version.groups())) < OLDEST_QEMU:
        pytest.fail(f"{said.splitlines()[0]} computes wrongly; {wanted}", pytrace=False)
    return path


@pytest.fixture(scope="session")
def made_here(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The folder of these trainings, and half of some, by this processor, and of the tables."""

    @cache
    def make(*cells: tuple[str, str]) -> Path:
        folder = tmp_path_factory.mktemp("here")
        tasks: list[Task] = [(*cell, str(folder / "-".join(cell)), False) for cell in cells]
        halved = [cell for cell in cells if cell[1] == HALVED]
        tasks += [(*cell, str(folder / "-".join([*cell, "half"])), True) for cell in halved]
        carry_out(tasks if SHORT else [*tasks, ("tables", str(folder / "tables"))], folder)
        return folder

    return make


@pytest.mark.parametrize("processor", CELLS)
def test_another_processor_gives_the_same_bits(processor, emulator, made_here, tmp_path) -> None:
    here = made_here(*CELLS[processor])
    there: list[Task] = []
    again: list[Task] = []  # and ended here
    wanted = {}  # by the folder of a training, that of the undisturbed one
    for cell in CELLS[processor]:
        name = "-".join(cell)
        folders = [tmp_path / f"{name}{kind}" for kind in ("", ", begun here", ", ended here")]
        whole, begun, ended = folders
        there.append((*cell, str(whole), False))
        if cell[1] == HALVED:
            shutil.copytree(here / f"{name}-half", begun)
            there += [(*cell, str(begun), False), (*cell, str(ended), True)]
            again.append((*cell, str(ended), False))
        wanted |= dict.fromkeys(folders if cell[1] == HALVED else [whole], here / name)
    if not SHORT:
        there.append(("tables", str(tmp_path / "tables")))
    carry_out(there, tmp_path, emulator, "-cpu", processor)
    carry_out(again, here)
    compared = [(new / name, old / name) for new, old in wanted.items() for name in OUTCOME]
    made = [] if SHORT else [Path("tables", name) for name in TABLES]
    compared += [(tmp_path / path, here / path) for path in made]
    assert [str(new) for new, old in compared if new.read_bytes() != old.read_bytes()] == []
    for found in wanted:
        assert provenance_of(found)["interruptions"] or "here" not in found.name, found
