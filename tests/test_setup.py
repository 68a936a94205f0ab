"""The set-up: what `make` does when all is well and when it is not."""

import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
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
"-m venv "*) folder=${!#}; mkdir -p "$folder/bin" && cp "$0" "$folder/bin/python" && sleep 0.2 ;;
"-m pip check") echo "${CHECK_SAYS-}" && [[ -z ${CHECK_SAYS-} ]] ;;
esac
"""


@pytest.fixture
def checkout(tmp_path):
    """A copy of what set-up reads, in a folder with an awkward name."""
    folder = tmp_path / "a földer with spaces"
    folder.mkdir()
    (tmp_path / "stub").write_text(STUB)
    (tmp_path / "stub").chmod(0o755)
    for name in (*LOCKS, "Makefile", "pyproject.toml"):
        shutil.copy(ROOT / name, folder)
    return folder


def make(folder, target="setup", **settings):
    """Exit code, what was said, and the calls of Python."""
    stub, calls = folder.parent / "stub", folder.parent / "calls"
    before = calls.read_text() if calls.exists() else ""
    environment = {"PYTHON": str(stub), "CALLS": str(calls), "MAKEFLAGS": "", "MAKELEVEL": "0"}
    run = subprocess.run(
        ["make", "--no-print-directory", target],
        cwd=folder,
        env=os.environ | environment | settings,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
    )
    after = calls.read_text() if calls.exists() else ""
    return run.returncode, run.stderr, after.removeprefix(before).splitlines()


def test_setup_installs_only_what_is_pinned_then_does_and_says_nothing(checkout):
    code, said, calls = make(checkout)
    assert (code, said.count("\n")) == (0, 1)
    installs = [call for call in calls if "pip install" in call]
    assert all("--no-deps" in call and "--no-build-isolation" in call for call in installs)
    assert ["--require-hashes" in call for call in installs] == [True, True, True, False]
    assert installs[2].endswith("-r environment.lock")
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
        assert [code for code, *_ in pool.map(make, [checkout] * 3)] == [0, 0, 0]
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
