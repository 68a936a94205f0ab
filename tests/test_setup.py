"""The set-up: what the locks hold, and what tools/ does when all is well and when it is not."""

import ast
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
LOCKS = ("environment.lock", "environment-cuda.lock")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def pins(lock: str) -> dict[str, tuple[str, list[str]]]:
    """Return {name: (version, sha256 hashes)}, reading the lock line by line."""
    found: dict[str, tuple[str, list[str]]] = {}
    for line in (ROOT / lock).read_text(encoding="utf-8").splitlines():
        if not line.startswith((" ", "#")):
            name, version = line.removesuffix(" \\").split("==")
            found[name] = (version, [])
        elif "--hash=" in line:
            found[name][1].append(line.split("--hash=")[1].removesuffix(" \\"))
    return found


def declared() -> list[Requirement]:
    """Return the requirements that pyproject.toml names."""
    extras = PROJECT["project"]["optional-dependencies"].values()
    lines = [*PROJECT["project"]["dependencies"], *(line for extra in extras for line in extra)]
    return [Requirement(line) for line in lines]


# --- the locks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_pins_every_package_with_hashes(lock):
    assert len(pins(lock)) > 10
    for name, (version, hashes) in pins(lock).items():
        assert re.fullmatch(r"[0-9][0-9a-z.]*", version), name
        assert hashes, f"{name} has no hash"
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", value) for value in hashes), name


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_holds_nothing_but_pins_and_hashes(lock):
    """In particular no index, no address and no path of the machine that wrote it."""
    for line in (ROOT / lock).read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            assert not re.search(r"://|\bwww\.|(^|\s)/|\.(org|com|net|io)\b", line), line
        else:
            assert re.fullmatch(
                r"[a-z0-9-]+==\S+ \\|    --hash=sha256:\S+( \\)?|    #( via)?( +[a-z0-9-]+)?"
                r"( \(pyproject\.toml\))?",
                line,
            ), line


def test_torch_is_pinned_in_its_cpu_and_its_ordinary_build():
    version, hashes = pins("environment.lock")["torch"]
    cpu = PROJECT["tool"]["mace-rl"]["extra-hashes"][f"torch=={version}"]
    assert cpu
    assert {f"sha256:{value}" for value in cpu} < set(hashes), "both builds, not one of them"


def test_what_only_the_ordinary_torch_needs_is_in_the_second_lock():
    main, cuda = pins("environment.lock"), pins("environment-cuda.lock")
    assert not main.keys() & cuda.keys()
    assert not [name for name in main if re.match(r"nvidia|cuda|triton", name)]
    assert {"triton", "nvidia-cudnn-cu13", "cuda-toolkit"} <= cuda.keys()


def test_lock_fulfils_what_the_project_declares():
    locked = pins("environment.lock")
    for requirement in declared():
        version, _ = locked[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement} but {version}: make lock"


def test_lock_is_complete():
    """What a locked package requires, by its own metadata, is locked too."""
    locked = pins("environment.lock").keys()
    cuda = pins("environment-cuda.lock").keys()
    for name in locked:
        for line in metadata.requires(name) or []:
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                needed = canonicalize_name(requirement.name)
                assert needed in locked or (name == "torch" and needed in cuda), f"{name}: {line}"


def test_installed_versions_are_the_locked_ones():
    for name, (version, _) in pins("environment.lock").items():
        assert metadata.version(name).split("+")[0] == version, name


def test_every_import_is_declared():
    """A module of another package is imported only if pyproject.toml names that package."""
    sources = [
        path
        for folder in ("src", "tests", "tools", "workflow")
        for path in (ROOT / folder).rglob("*.py")
    ]
    own = {path.stem for path in sources} | {"mace_rl", "benchmarks"}
    imported = {}
    for path in sources:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module]
            imported |= {name.split(".")[0]: path.relative_to(ROOT) for name in names}
    for path in [ROOT / "Snakefile", *(ROOT / "workflow").rglob("*.smk")]:
        found = re.findall(
            r"^\s*(?:from|import) (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE
        )
        imported |= {name: path.relative_to(ROOT) for name in found}
    distributions = metadata.packages_distributions()
    allowed = {canonicalize_name(requirement.name) for requirement in declared()}
    for module, path in imported.items():
        if module not in own and module not in sys.stdlib_module_names:
            names = {canonicalize_name(name) for name in distributions.get(module, [module])}
            assert names & allowed, f"{path} imports {module}, which pyproject.toml does not name"


# --- tools/setup.sh, with a Python that only pretends to install ----------------------------------

STUB = r"""#!/usr/bin/env bash
# Pretends to be Python 3.11. Writes down its calls; fails where $BREAK matches one of them.
printf '%s\n' "$*" >>"$CALLS"
if [[ -n ${BREAK-} && "$*" == *$BREAK* ]]; then
    echo "${BREAK_SAYS-}"
    [[ -n ${BREAK_KILLS-} ]] && kill -KILL "$PPID"
    exit 1
fi
case "$*" in
*_base_executable*) echo "$0" ;;
"-m venv "*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" && sleep 0.2 ;;
"-m pip check") echo "${CHECK_SAYS-}" && [[ -z ${CHECK_SAYS-} ]] ;;
esac
"""


class Checkout:
    """A copy of what set-up reads, in a folder with an awkward name."""

    def __init__(self, folder: Path):
        self.folder = folder / "a földer with spaces"
        self.calls_file = folder / "calls"
        self.python = folder / "stub"
        self.python.write_text(STUB)
        self.python.chmod(0o755)
        (self.folder / "src").mkdir(parents=True)
        shutil.copytree(ROOT / "tools", self.folder / "tools")
        for name in (*LOCKS, "Makefile", "pyproject.toml"):
            shutil.copy(ROOT / name, self.folder)

    def environment(self, **settings) -> dict[str, str]:
        values = {"PYTHON": str(self.python), "CALLS": str(self.calls_file), **settings}
        return {**os.environ, "MAKEFLAGS": "", **values}

    def setup(self, **settings) -> subprocess.CompletedProcess:
        return subprocess.run(
            [self.folder / "tools" / "setup.sh"],
            env=self.environment(**settings),
            capture_output=True,
            text=True,
            timeout=60,
        )

    def calls(self) -> list[str]:
        """Return the Python calls since the last time this was asked."""
        calls = self.calls_file.read_text().splitlines() if self.calls_file.exists() else []
        self.calls_file.unlink(missing_ok=True)
        return calls


@pytest.fixture
def checkout(tmp_path):
    return Checkout(tmp_path)


@pytest.fixture
def installed(checkout):
    assert checkout.setup().returncode == 0
    checkout.calls()
    return checkout


def test_setup_installs_only_what_is_pinned(checkout):
    run = checkout.setup()
    assert (run.returncode, run.stdout) == (0, "")
    assert run.stderr.count("\n") == 1
    installs = [call for call in checkout.calls() if "pip install" in call]
    assert all("--no-deps" in call and "--no-build-isolation" in call for call in installs)
    assert [call for call in installs if "--require-hashes" not in call] == [
        "-m pip install --no-deps --no-build-isolation --editable ."
    ]
    assert any(call.endswith("-r environment.lock") for call in installs)
    assert not any("environment-cuda.lock" in call for call in installs)


def test_setup_adds_the_cuda_packages_for_the_torch_that_asks_for_them(checkout):
    says = "torch 2.13.0 requires triton, which is not installed."
    run = checkout.setup(CHECK_SAYS=says)
    assert any(call.endswith("-r environment-cuda.lock") for call in checkout.calls())
    assert run.returncode != 0, "the packages are still missing, says the stub"


def test_second_setup_does_and_says_nothing(installed):
    for path in installed.folder.iterdir():
        os.utime(path, (1e9, 1e9))  # a clone or a copy changes time stamps, not contents
    run = installed.setup(PYTHON="not asked for")
    assert (run.returncode, run.stdout, run.stderr, installed.calls()) == (0, "", "", [])


@pytest.mark.parametrize("lock", LOCKS)
def test_changed_lock_rebuilds(installed, lock):
    stray = installed.folder / ".venv" / "stray"
    stray.touch()
    with (installed.folder / lock).open("a") as file:
        file.write("# changed\n")
    assert installed.setup().returncode == 0
    assert "-m venv .venv" in installed.calls()
    assert not stray.exists(), "rebuilt from nothing"


def test_changed_pyproject_reinstalls_the_project_only(installed):
    with (installed.folder / "pyproject.toml").open("a") as file:
        file.write("# changed\n")
    assert installed.setup().returncode == 0
    assert installed.calls() == [
        "-c import sys; sys.exit(sys.version_info[:2] != (3, 11))",
        "-c import ensurepip, venv",
        "-m pip install --no-deps --no-build-isolation --editable .",
        "-m pip check",
    ]


def test_moved_folder_rebuilds(installed):
    installed.folder = installed.folder.rename(installed.folder.with_name("moved"))
    assert installed.setup().returncode == 0
    assert "-m venv .venv" in installed.calls()


@pytest.mark.parametrize("kills", ["", "yes"], ids=["fails", "killed"])
@pytest.mark.parametrize("where", ["-m venv", "-r environment.lock", "--editable", "pip check"])
def test_setup_that_breaks_off_is_not_taken_for_complete(checkout, where, kills):
    run = checkout.setup(BREAK=where, BREAK_SAYS="oh", BREAK_KILLS=kills)
    assert run.returncode != 0
    checkout.calls()
    assert checkout.setup().returncode == 0
    calls = checkout.calls()
    assert any(call.endswith("-r environment.lock") for call in calls) == (
        where in ("-m venv", "-r environment.lock")
    )
    assert "-m pip install --no-deps --no-build-isolation --editable ." in calls
    run = checkout.setup()
    assert (run.returncode, checkout.calls()) == (0, [])


def test_two_setups_at_once_make_one_environment(checkout):
    command = [checkout.folder / "tools" / "setup.sh"]
    runs = [
        subprocess.Popen(command, env=checkout.environment(), stderr=subprocess.DEVNULL)
        for _ in range(3)
    ]
    assert [run.wait(timeout=60) for run in runs] == [0, 0, 0]
    assert checkout.calls().count("-m venv .venv") == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"PYTHON": "no-such-python"}, "set-up: needs Python 3.11"),
        ({"BREAK": "version_info"}, "set-up: needs Python 3.11"),
        ({"BREAK": "import ensurepip"}, "lacks the venv module"),
        ({"BREAK": "-r environment.lock", "BREAK_SAYS": "NewConnectionError"}, "no connection"),
        ({"BREAK": "-r environment.lock", "BREAK_SAYS": "No space left on device"}, "disk is full"),
        ({"BREAK": "-r environment.lock", "BREAK_SAYS": "DO NOT MATCH THE HASHES"}, "differs"),
    ],
)
def test_what_is_missing_is_said_in_one_line(checkout, settings, message):
    run = subprocess.run(
        ["make", "setup"],
        cwd=checkout.folder,
        env=checkout.environment(**settings),
        capture_output=True,
        text=True,
        timeout=60,
    )
    lines = [
        line for line in run.stderr.splitlines() if not line.startswith(("make", "Setting up"))
    ]
    assert run.returncode != 0
    assert len(lines) == 1, run.stderr
    assert message in lines[0]
    assert not (checkout.folder / ".venv").exists()


def test_unknown_failure_shows_the_end_of_pips_output(checkout):
    run = checkout.setup(BREAK="-r environment.lock", BREAK_SAYS="something new")
    assert "something new" in run.stderr
    assert "something new" in (checkout.folder / "setup.log").read_text()


# --- the other tools ------------------------------------------------------------------------------


def tool(name: str):
    """Import a script of tools/."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


A, B, C = "a" * 64, "b" * 64, "c" * 64
RESOLVED = f"""\
numpy==2.4.6 \\
    --hash=sha256:{B} \\
    --hash=sha256:{A}
    # via torch
nvidia-nccl-cu13==2.29.7 \\
    --hash=sha256:{A}
    # via torch
torch==2.13.0 \\
    --hash=sha256:{B}
    # via mace-rl (pyproject.toml)
"""


@pytest.fixture
def lock(tmp_path, monkeypatch):
    """Run tools/lock.py in an empty folder, with a resolver that returns a fixed text."""

    def run(resolved: str, extra: str):
        module = tool("lock")
        (tmp_path / "pyproject.toml").write_text(f"[tool.mace-rl.extra-hashes]\n{extra}\n")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["lock.py"])
        monkeypatch.setattr(module, "resolve", lambda preferences, upgrade: resolved)
        module.main()
        return [(tmp_path / name).read_text() for name in LOCKS]

    return run


def test_lock_splits_and_adds_hashes(lock):
    main, cuda = lock(RESOLVED, f'"torch==2.13.0" = ["{C}", "{A}"]')
    hashes = " \\\n".join(f"    --hash=sha256:{value}" for value in (A, B, C))
    assert f"torch==2.13.0 \\\n{hashes}\n    # via" in main
    assert f"numpy==2.4.6 \\\n    --hash=sha256:{B} \\\n    --hash=sha256:{A}\n" in main
    assert "nvidia" not in main
    assert f"nvidia-nccl-cu13==2.29.7 \\\n    --hash=sha256:{A}\n" in cuda
    assert "torch==" not in cuda


@pytest.mark.parametrize(
    ("resolved", "extra"),
    [
        (RESOLVED, f'"torch==2.14.0" = ["{C}"]'),
        (RESOLVED + "six==1.17.0\n", ""),
        (RESOLVED + "-e .\n", ""),
    ],
    ids=["hash of another version", "pin without hash", "not a pin"],
)
def test_lock_refuses_and_leaves_the_files_alone(lock, tmp_path, resolved, extra):
    with pytest.raises(SystemExit, match="nothing changed"):
        lock(resolved, extra)
    assert not (tmp_path / LOCKS[0]).exists()


SAFE = {"name": "numpy", "version": "2.4.6", "vulns": []}
UNSAFE = {"name": "torch", "version": "2.13.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["3"]}]}
UNKNOWN = {"name": "six", "skip_reason": "Dependency not found"}


@pytest.mark.parametrize(
    ("packages", "code", "says"),
    [
        ([SAFE], 0, "1 packages, 0 known vulnerabilities, 0 not checked"),
        ([SAFE, UNSAFE], 1, "torch 2.13.0: PYSEC-1, fixed in 3"),
        ([SAFE, UNKNOWN], 1, "six: unknown to the service, not checked"),
        (
            [UNKNOWN],
            1,
            "audit: nothing was checked; the vulnerability service could not be reached",
        ),
        (None, 1, "audit: nothing was checked; pip-audit could not ask its service: no route"),
    ],
)
def test_audit_says_what_was_checked(tmp_path, packages, code, says):
    report = "" if packages is None else json.dumps({"dependencies": packages})
    fake = f"import sys\nprint({report!r})\nprint('no route', file=sys.stderr)\n"
    (tmp_path / "pip_audit.py").write_text(fake)
    run = subprocess.run(
        [sys.executable, ROOT / "tools" / "audit.py"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == code
    assert says in run.stdout + run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize(("log", "code"), [("log: 'a.log'", 0), ("", 1)], ids=["good", "no log"])
def test_workflow_lint_accepts_only_the_missing_conda_environment(tmp_path, log, code):
    (tmp_path / "Snakefile").write_text(
        f"rule a:\n    output: 'a'\n    {log}\n    shell: 'touch {{output}}'\n"
    )
    run = subprocess.run(
        [sys.executable, ROOT / "tools" / "lint_workflow.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert run.returncode == code, run.stderr
    assert ("rule a: No log directive defined" in run.stderr) == bool(code)


def test_make_help_lists_every_target():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.search(r"^\.PHONY:(.*)$", makefile, re.MULTILINE)[1].split()
    run = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(re.findall(r"^make (\S+)", run.stdout, re.MULTILINE)) == set(targets)


@pytest.mark.parametrize("script", [".ci/run", "tools/setup.sh", "tools/in_throwaway_venv.sh"])
def test_scripts_are_executable(script):
    assert os.access(ROOT / script, os.X_OK)
