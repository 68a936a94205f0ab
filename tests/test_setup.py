"""The set-up: what the locks hold, and what `make` does when all is well and when it is not."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
TORCH, CPU_HASH = re.findall(r"^TORCH(?:_CPU_HASH)? := (.*)$", MAKEFILE, re.MULTILINE)
LOCKS = ("environment.lock", "environment-cuda.lock")
ENTRY = r"^([a-z0-9-]+)==([0-9][0-9a-z.]*)((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n(    #.*\n)+"
MAIN, CUDA = (
    {name: pin for name, *pin, _ in re.findall(ENTRY, (ROOT / lock).read_text(), re.MULTILINE)}
    for lock in LOCKS
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
DECLARED = sum(PROJECT["optional-dependencies"].values(), PROJECT["dependencies"])


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_holds_nothing_but_pins_with_hashes(lock):
    """In particular no index, no address and no path of the machine that wrote it."""
    header, _, entries = (ROOT / lock).read_text(encoding="utf-8").partition("\n")
    assert header == "# Written by `make lock` from pyproject.toml: change that, not this file."
    assert re.sub(ENTRY, "", entries, flags=re.MULTILINE) == ""
    assert not re.search(r"# .*(/|\.(org|com|net|io)\b)", entries)


def test_torch_is_pinned_in_both_builds_and_only_the_ordinary_one_brings_cuda():
    version, hashes = MAIN["torch"]
    assert f"torch=={version}" == TORCH
    assert CPU_HASH in hashes
    assert hashes.count("--hash=") > 1
    assert {"triton", "nvidia-cudnn-cu13", "cuda-toolkit"} <= CUDA.keys()
    assert not [name for name in MAIN if re.match(r"nvidia|cuda|triton", name)]


def test_lock_is_complete_and_is_what_is_installed():
    """What the project, and each locked package by its own metadata, requires is locked."""
    required = [("mace-rl", line) for line in DECLARED]
    for name, (version, _) in MAIN.items():
        assert metadata.version(name).partition("+")[0] == version, name
        required += [(name, line) for line in metadata.requires(name) or []]
    for by, requirement in ((by, Requirement(line)) for by, line in required):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            locked = MAIN | CUDA if by == "torch" else MAIN
            version, _ = locked[canonicalize_name(requirement.name)]
            assert requirement.specifier.contains(version), f"{by}: {requirement}"


def test_every_import_is_declared():
    """A module of another package is imported only if pyproject.toml names that package."""
    folders = ("src", "tests", "tools", "workflow", "benchmarks", "examples")
    sources = [path for folder in folders for path in (ROOT / folder).rglob("*.*")]
    own = {path.stem for path in [*sources, *(ROOT / "src").iterdir()]} | set(folders)
    declared = {canonicalize_name(Requirement(line).name) for line in DECLARED}
    folder = ROOT / "benchmarks"  # one file of which runs in an environment of its own
    elsewhere = (folder / "purejaxrl.in").read_text(encoding="utf-8")
    distributions = metadata.packages_distributions()
    for path in sources:
        text = path.read_text(encoding="utf-8") if path.suffix in (".py", ".smk") else ""
        found = re.findall(r"^ *(?:import (\w+)|from (\w+)[\w.]* import )", text, re.MULTILINE)
        for module in {a or b for a, b in found} - own - sys.stdlib_module_names:
            if path == folder / "purejaxrl_training.py":
                assert re.search(rf"^{module}==", elsewhere, re.MULTILINE), module
                continue
            assert declared & {canonicalize_name(n) for n in distributions[module]}, (path, module)


def test_whoever_installs_the_package_gets_its_types(tmp_path):
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    shutil.copytree(
        ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__")
    )
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "-w", "wheel", "."], cwd=tmp_path, check=True)
    (wheel,) = (tmp_path / "wheel").iterdir()
    packed = set(zipfile.ZipFile(wheel).namelist())
    found = [path.relative_to(ROOT / "src") for path in (ROOT / "src/mace_rl").rglob("*.*")]
    wanted = {str(path) for path in found if "__pycache__" not in path.parts}
    assert "mace_rl/report/page.html" in wanted and wanted <= packed


# --- make, with a Python that only pretends to install ------------------------------------------

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
"-m uv "*) printf "$RESOLVED" >"${!#}" ;;
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


def test_setup_adds_the_cuda_packages_for_the_torch_that_asks_for_them(checkout):
    says = "torch 2.13.0 requires triton, which is not installed."
    code, _, calls = make(checkout, CHECK_SAYS=says)
    assert any(call.endswith("-r environment-cuda.lock") for call in calls)
    assert code != 0, "the packages are still missing, says the stub"


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


def test_lock_splits_the_resolution_and_keeps_the_hash_of_torchs_cpu_build(checkout):
    a = f" \\\n    --hash=sha256:{'a' * 64}\n    # via x\n"
    resolved = f"numpy==2.4.6{a}{TORCH}{a}triton==3.7.1{a}".replace("\\", "\\\\")
    code, said, _ = make(checkout, "lock", RESOLVED=resolved)
    assert code == 0, said
    locks = [(checkout / lock).read_text().partition("\n")[2] for lock in LOCKS]
    assert locks[0] == f"numpy==2.4.6{a}{TORCH} \\\n    --hash={CPU_HASH}{a}"
    assert locks[1] == f"triton==3.7.1{a}"
    assert make(checkout, "lock", RESOLVED="torch==9")[0] != 0
    assert (checkout / LOCKS[0]).read_text().endswith(locks[0]), "left alone"


def test_workflow_lint_accepts_only_the_missing_conda_environment(tmp_path):
    snakefile = tmp_path / "Snakefile"
    command = [sys.executable, ROOT / "tools" / "lint_workflow.py"]

    def lint(rule: str) -> tuple[int, str]:
        snakefile.write_text(f"rule a:\n    output: 'a'\n{rule}    shell: 'touch {{output}}'\n")
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        return run.returncode, run.stderr

    assert lint("    log: 'b'\n") == (0, "")
    of_the_file = f'{snakefile}: Absolute path "/b" in line 3\n'
    of_the_rule = "rule a: No log directive defined\n"
    assert lint("    input: '/b'\n") == (1, of_the_file + of_the_rule)
    code, said = lint("    logs: 'b'\n")
    assert code == 1 and "Unexpected keyword logs" in said, "no rule could be read"


def test_make_help_lists_every_target():
    targets = re.search(r"^\.PHONY:(.*)$", MAKEFILE, re.MULTILINE)[1].split()
    run = subprocess.run(["make", "-s", "help"], cwd=ROOT, capture_output=True, text=True)
    assert set(re.findall(r"^make (\S+)", run.stdout, re.MULTILINE)) == set(targets)


def test_what_would_slow_every_process_down_is_taken_away():
    target = "shown:; @echo $${PYTHONDONTWRITEBYTECODE-unset}"
    run = subprocess.run(
        ["make", "-s", "--eval", target, "shown"],
        cwd=ROOT,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
    )
    assert run.stdout == "unset\n", run.stderr
