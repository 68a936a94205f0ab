"""The set-up: what `make` does when all is well and when it is not."""

import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from shared import ROOT

pytestmark = pytest.mark.slow
LOCKS = ("environment.lock", "environment-cuda.lock")


STUB = r"""#!/usr/bin/env bash
# Pretends to be Python 3.11. Writes down its calls; fails where $BREAK matches one of them.
printf '%s\n' "$*" >>"$CALLS"
if [[ -n ${BREAK-} && "$*" == *$BREAK* ]]; then
    echo "the cause"
    [[ -n ${KILLS-} ]] && kill -KILL "$PPID"
    exit 1
fi
case "$*" in
"-m venv "*) bin=${!#}/bin; mkdir -p "$bin" && cp "$0" "$bin/python" && sleep "${SLOW-0}" ;;
"-m pip check") echo "${CHECK_SAYS-}" && [[ -z ${CHECK_SAYS-} ]] ;;
esac
"""


@pytest.fixture
def checkout(tmp_path):
    folder = tmp_path / "a földer with spaces"
    folder.mkdir()
    (tmp_path / "stub").write_text(STUB)
    (tmp_path / "stub").chmod(0o755)
    for name in (*LOCKS, "Makefile", "pyproject.toml", "tools/setup"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    return folder


def make(folder, target="setup", **settings):
    """Exit code, what was said, and the calls of Python."""
    stub, calls = folder.parent / "stub", folder.parent / "calls"
    before = calls.read_text() if calls.exists() else ""
    environment = {"PYTHON": str(stub), "CALLS": str(calls), "MAKEFLAGS": "", "MAKELEVEL": "0"}
    how = {"cwd": folder, "env": os.environ | environment | settings, "timeout": 60}
    command = ["make", "--no-print-directory", target]
    run = subprocess.run(command, stderr=subprocess.PIPE, text=True, **how)
    after = calls.read_text() if calls.exists() else ""
    return run.returncode, run.stderr, after.removeprefix(before).splitlines()


def test_setup_installs_only_what_is_pinned_then_does_and_says_nothing(checkout):
    code, said, calls = make(checkout)
    assert (code, said.count("\n")) == (0, 1)
    installs = [call for call in calls if "pip install" in call]
    assert all("--no-deps" in call and "--no-build-isolation" in call for call in installs)
    assert ["--require-hashes" in call for call in installs] == [True, True, True, True, False]
    assert installs[3].startswith("-m uv") and installs[3].endswith("-r environment.lock")
    for path in checkout.iterdir():
        os.utime(path, (1e9, 1e9))  # a clone or a copy changes time stamps, not contents
    assert make(checkout, PYTHON="not asked for") == (0, "", [])


@pytest.mark.parametrize("change", [*LOCKS, "pyproject.toml", "the folder", "its Python"])
def test_what_has_changed_is_made_anew(checkout, change):
    make(checkout)
    if change == "the folder":
        checkout = checkout.rename(checkout.with_name("moved"))
    elif change == "its Python":
        (checkout / ".venv/bin/python").unlink()  # as where a link has lost what it leads to
    else:
        (checkout / change).write_text("# changed\n" + (ROOT / change).read_text())
    code, _, calls = make(checkout)
    assert (code, calls[-1]) == (0, "-m pip check")
    assert ("-m venv --clear .venv" in calls) == (change != "pyproject.toml")


@pytest.mark.parametrize("kills", ["", "yes"], ids=["fails", "killed"])
@pytest.mark.parametrize("where", ["-m venv", "-r environment.lock", "--editable", "pip check"])
def test_setup_that_breaks_off_is_not_taken_for_complete(checkout, where, kills):
    assert make(checkout, BREAK=where, KILLS=kills)[0] != 0
    code, _, calls = make(checkout)
    assert (code, calls[-1]) == (0, "-m pip check")
    assert make(checkout) == (0, "", [])


def test_setups_at_once_make_one_environment(checkout):
    with ThreadPoolExecutor(3) as pool:
        at_once = pool.map(partial(make, SLOW="0.2"), [checkout] * 3)
        assert [code for code, *_ in at_once] == [0, 0, 0]
    assert (checkout.parent / "calls").read_text().count("-m venv --clear .venv\n") == 1


@pytest.mark.parametrize("settings", [{"PYTHON": "no-such-python"}, {"BREAK": "version_info"}])
def test_another_python_is_refused_in_one_line(checkout, settings):
    code, said, _ = make(checkout, **settings)
    assert code != 0
    assert said.startswith("This needs Python 3.11, and '")
    assert not (checkout / ".venv").exists()


def test_any_other_failure_shows_the_end_of_pips_output(checkout):
    assert "the cause" in make(checkout, BREAK="-r environment.lock")[1]
    assert "the cause" in (checkout / "setup.log").read_text()


HIDDEN = re.compile("python|pip|uv|pydoc")


@pytest.fixture
def without_python(tmp_path, monkeypatch):
    """A search path with this machine's programs but its Pythons; returns the folder."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for program in [*Path("/bin").iterdir(), *Path("/usr/bin").iterdir()]:
        if not HIDDEN.match(program.name) and not (folder / program.name).exists():
            (folder / program.name).symlink_to(program)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("MAKEFLAGS", "")
    monkeypatch.delenv("PYTHON", raising=False)
    return folder


def fetched(checkout):
    command = ["tools/setup", "fetched"]
    run = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=300)
    return run.stdout.strip(), run.stderr


PYTHON3 = {  # what is there to begin with, and what is said
    "": "python3 makes no environment for uv, which would fetch it (Debian, Ubuntu: apt install",
    "mkdir -p $3/bin; echo exit 1 >$3/bin/python; chmod +x $3/bin/python": "pip cannot install uv",
}


@pytest.mark.parametrize("python3", PYTHON3)
def test_without_a_python_one_line_says_what_to_do(checkout, without_python, python3):
    if python3:
        (without_python / "python3").write_text(f"#!/bin/sh\n{python3}\n")
        (without_python / "python3").chmod(0o755)
    path, said = fetched(checkout)
    assert (path, said.count("\n")) == ("", 1)
    assert said.startswith(f"This needs Python 3.11: there is none, and {PYTHON3[python3]}")


def test_uv_fetches_a_python_where_there_is_none(checkout, without_python, monkeypatch):
    """From a mirror of this one. Its list, too: uv knows by heart what the real ones hash to."""
    version, place = "{}.{}.{}".format(*sys.version_info), checkout.parent / "mirror" / "1"
    name = f"cpython-{version}+1-x86_64-unknown-linux-gnu-install_only.tar.gz"
    place.mkdir(parents=True)
    ignored = shutil.ignore_patterns("site-packages", "dist-packages", "__pycache__", "test")
    for part in ("bin/python3.11", "lib/python3.11", "lib/libpython3.11.so.1.0"):
        target, found = place.parent / "python" / part, Path(sys.base_prefix, part)
        if found.is_dir():
            shutil.copytree(found, target, ignore=ignored)
        elif found.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(found, target)
    command = ["tar", "-C", place.parent, "-I", "gzip -1", "-cf", place / name, "python"]
    subprocess.run(command, check=True)
    known = {"name": "cpython", "arch": {"family": "x86_64", "variant": None}, "os": "linux"}
    known |= dict(zip(("major", "minor", "patch"), sys.version_info[:3], strict=True))
    known |= {"libc": "gnu", "prerelease": "", "sha256": None, "variant": None, "build": "1"}
    releases = "https://github.com/astral-sh/python-build-standalone/releases/download"
    listing = {f"cpython-{version}-linux-x86_64-gnu": known | {"url": f"{releases}/1/{name}"}}
    (checkout.parent / "list.json").write_text(json.dumps(listing))
    monkeypatch.setenv("UV_PYTHON_DOWNLOADS_JSON_URL", str(checkout.parent / "list.json"))
    monkeypatch.setenv("UV_PYTHON_INSTALL_MIRROR", place.parent.as_uri())
    (without_python / "python3").symlink_to(sys.executable)
    path, said = fetched(checkout)
    assert Path(path).is_relative_to(checkout / ".python") and said.count("\n") == 1
    subprocess.run([path, "-c", "import ensurepip"], check=True)
