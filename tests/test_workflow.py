"""The workflow for real, at tiny budgets, in a copy of the project."""

import fcntl
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from mace_rl.sources import PACKAGE, digest, sources

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "workflow" / "scripts").glob("*.py"))

STUDY = {
    "results": "results/tiny",
    "environments": ["CartPole-v1", "Acrobot-v1"],
    "variants": ["ppo", "mace_full"],
    "seeds": [0],
    "training": {"episodes": 4},
}
RUNS = [
    f"runs/{env}/{variant}/seed0" for env in STUDY["environments"] for variant in STUDY["variants"]
]
OUTPUTS = [
    "metrics.csv",
    "table1.tex",
    "table1.csv",
    "supplement.tex",
    "supplement.csv",
    "table2.tex",
    "figure1.pdf",
    "figure1.png",
    "figure1.csv",
    "figure1_seeds.csv",
    *(f"{run}/{name}" for run in RUNS for name in ("episodes.csv", "run.json", "agent.pt")),
]
EVALUATION = {"metrics": 1, "table1": 1, "curves": 1, "figure1": 1}


class Project:
    """A copy of the project, whose files a test may change."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("Snakefile", "config.yaml", "config", "profiles", "workflow", "src"):
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name)
            else:
                shutil.copy2(ROOT / name, folder / name)
        (folder / "tiny.yaml").write_text(yaml.safe_dump(STUDY))

    def __getitem__(self, name: str) -> Path:
        return self.folder / name

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "snakemake", *arguments, "--configfile", "tiny.yaml"]

    @property
    def environment(self) -> dict[str, str]:
        return os.environ | {"PYTHONPATH": str(self["src"])}

    def snakemake(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """What the command printed, standard output and error together, and its exit code."""
        return subprocess.run(
            self.command(*arguments),
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=300,
            check=False,
        )

    def planned(self, *arguments: str) -> dict[str, int]:
        """How many jobs of each rule `snakemake -n` would run."""
        done = self.snakemake("-n", "all", *arguments)
        assert done.returncode == 0, done.stdout
        jobs = re.findall(r"^(\w+) +(\d+)$", done.stdout.partition("\n\n")[0], re.MULTILINE)
        assert jobs or "Nothing to be done" in done.stdout, done.stdout
        return {rule: int(number) for rule, number in jobs if rule not in ("all", "total")}

    def digests(self) -> dict[str, str]:
        results = self["results/tiny"]
        return {name: hashlib.sha256((results / name).read_bytes()).hexdigest() for name in OUTPUTS}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A project whose tiny study has been carried out; tests leave it as they find it."""
    project = Project(tmp_path_factory.mktemp("tiny study"))
    done = project.snakemake("-j2", "all")
    assert done.returncode == 0, done.stdout
    project["first.log"].write_text(done.stdout)
    return project


@pytest.fixture
def edit(finished: Project) -> Iterator:
    """`edit(file, old, new)` changes a file of the finished project until the end of the test."""
    before: dict[Path, tuple[bytes, os.stat_result]] = {}

    def replace(name: str, old: str, new: str) -> None:
        file = finished[name]
        before.setdefault(file, (file.read_bytes(), file.stat()))
        text = file.read_text(encoding="utf-8")
        assert old in text
        file.write_text(text.replace(old, new, 1), encoding="utf-8")

    yield replace
    for file, (content, stat) in before.items():
        file.write_bytes(content)
        os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))


@pytest.mark.slow
def test_everything_is_made_and_the_terminal_says_how_far_it_is(finished: Project) -> None:
    assert finished.digests()  # reads all of them
    output = finished["first.log"].read_text()
    assert "4 of 4 runs done" in output
    assert "Error" not in output
    logs = [*finished["results/tiny/logs"].rglob("*.log")]
    assert len(logs) == len(RUNS) + len(EVALUATION) + 1  # Table 2
    assert all(": done in" in log.read_text() for log in logs)
    benchmarks = [*finished["results/tiny/benchmarks"].rglob("*.tsv")]
    assert len(benchmarks) == len(RUNS)


@pytest.mark.slow
def test_time_stamps_do_not_count(finished: Project) -> None:
    for folder in ("src", "workflow", "config", "profiles", "results/tiny/runs"):
        for file in finished[folder].rglob("*"):
            os.utime(file)
    for name in ("Snakefile", "config.yaml", "tiny.yaml"):
        os.utime(finished[name])
    done = finished.snakemake("-j2", "all")
    assert "Nothing to be done" in done.stdout


CHANGES = {
    "the colour of a variant": ("config.yaml", "tab:blue", "tab:cyan", {"figure1": 1}),
    "the colour of another variant": ("config.yaml", "tab:purple", "tab:pink", {}),
    "the name of a variant": ("config.yaml", "PPO (", "Plain PPO (", {"table1": 1, "figure1": 1}),
    "how runs are measured": ("config.yaml", "threshold: 0.75", "threshold: 0.7", EVALUATION),
    "a hyperparameter": (
        "config.yaml",
        "clip: 0.2",
        "clip: 0.3",
        {"train": 4, "table2": 1, **EVALUATION},
    ),
    "a hyperparameter of one variant": (
        "config.yaml",
        "beta: {kind: meta, initial: 0.4}",
        "beta: {kind: meta, initial: 0.5}",
        {"train": 2, **EVALUATION},
    ),
    "the order of keys and a comment": (
        "config.yaml",
        "    clip: 0.2 # [P] Table 2, ε\n    gae_lambda: 1.0 # [C]",
        "    gae_lambda: 1.0\n    clip: 0.2 # [C]",
        {},
    ),
    "another seed": ("tiny.yaml", "seeds:\n- 0", "seeds:\n- 0\n- 1", {"train": 4, **EVALUATION}),
    "one environment less": (
        "tiny.yaml",
        "- Acrobot-v1\n",
        "",
        {"table2": 1, **EVALUATION},
    ),
    "the code of PPO": ("src/mace_rl/ppo.py", "\n", "\n\n", {"train": 4, **EVALUATION}),
    "the code of tables": ("src/mace_rl/tables.py", "\n", "\n\n", {"table1": 1, "table2": 1}),
    "the code of figures": ("src/mace_rl/figures.py", "\n", "\n\n", {"curves": 1, "figure1": 1}),
    "the code of metrics": ("src/mace_rl/metrics.py", "\n", "\n\n", {**EVALUATION, "table2": 1}),
    "the code of the progress report": ("src/mace_rl/progress.py", "\n", "\n\n", {}),
    "a script": ("workflow/scripts/train.py", "\n", "\n\n", {"train": 4, **EVALUATION}),
    "a result": (
        "results/tiny/metrics.csv",
        "CartPole-v1,ppo,0",
        "CartPole-v1,ppo,7",
        {"table1": 1},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGES)
def test_what_a_change_runs_again(finished: Project, edit, name: str) -> None:
    file, old, new, expected = CHANGES[name]
    edit(file, old, new)
    assert finished.planned() == expected


@pytest.mark.slow
def test_a_change_with_an_old_time_stamp_is_seen(finished: Project, edit) -> None:
    edit("src/mace_rl/tables.py", "\n", "\n\n")
    os.utime(finished["src/mace_rl/tables.py"], (1, 1))
    assert finished.planned() == {"table1": 1, "table2": 1}


@pytest.mark.slow
def test_a_colour_redraws_the_figure_and_touches_nothing_else(finished: Project, edit) -> None:
    before = finished.digests()
    edit("config.yaml", "tab:blue", "tab:cyan")
    assert finished.snakemake("-j2", "all").returncode == 0
    changed = {name for name, value in finished.digests().items() if value != before[name]}
    assert changed == {"figure1.pdf", "figure1.png"}
    edit("config.yaml", "tab:cyan", "tab:blue")
    assert finished.snakemake("-j1", "results/tiny/figure1.pdf").returncode == 0
    assert finished.digests() == before  # drawing is deterministic


@pytest.mark.slow
def test_a_damaged_result_is_named_on_the_terminal(finished: Project) -> None:
    episodes = finished[f"results/tiny/{RUNS[0]}/episodes.csv"]
    content, stat = episodes.read_bytes(), episodes.stat()
    episodes.write_bytes(content[:-10])
    done = finished.snakemake("-j1", "results/tiny/metrics.csv")
    assert done.returncode == 1
    lines = [line for line in done.stdout.splitlines() if line.startswith("metrics failed: ")]
    assert len(lines) == 1
    assert f"RecordError: results/tiny/{RUNS[0]}/episodes.csv: line" in lines[0]
    assert lines[0].endswith("(more in results/tiny/logs/metrics.log)")
    assert "Traceback" not in done.stdout
    assert "Traceback" in finished["results/tiny/logs/metrics.log"].read_text()
    episodes.write_bytes(content)
    os.utime(episodes, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert finished.snakemake("-j2", "all").returncode == 0
    assert finished.planned() == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["--config", "seeds=[0,0]"], "seeds is [0, 0], but 0 should be there once"),
        (["--config", "seeds=3"], "seeds is 3, but should be a valid list"),
        (["--config", "training={episodes: -1}"], "episodes is -1, but should be greater than 0"),
        (["--config", "sedes=[0]"], "unknown key 'sedes'"),
    ],
)
def test_mistakes_end_in_one_line(finished: Project, arguments: list[str], fragment: str) -> None:
    done = finished.snakemake("-n", "all", *arguments)
    assert done.returncode == 1
    lines = [line for line in done.stdout.splitlines() if fragment in line]
    assert len(lines) == 1
    assert lines[0].startswith("Error in the configuration: config.yaml + tiny.yaml: ")
    assert "Traceback" not in done.stdout
    assert done.stdout.splitlines()[-1] == lines[0]


@pytest.mark.slow
def test_lists_on_the_command_line_are_lists_of_numbers(finished: Project) -> None:
    assert finished.planned("--config", "seeds=[0]") == {}


@pytest.mark.slow
def test_one_snakemake_at_a_time(finished: Project, edit) -> None:
    edit("config.yaml", "tab:blue", "tab:cyan")  # something to do
    with finished["results/tiny/.lock"].open("w") as lock:
        lock.write("Snakemake (process 7 on moon)")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = finished.snakemake("-j2", "all")
        assert done.returncode == 1
        refusal = "Error: Snakemake (process 7 on moon) is at work in results/tiny; wait for it"
        assert refusal in done.stdout.splitlines()
        assert finished.planned() == {"figure1": 1}  # looking is allowed


@pytest.mark.slow
def test_the_same_command_after_a_kill(tmp_path: Path) -> None:
    project = Project(tmp_path)
    study = STUDY | {
        "environments": ["Acrobot-v1"],
        "variants": ["mace_full"],
        "training": {"episodes": 150},
    }
    project["tiny.yaml"].write_text(yaml.safe_dump(study))
    progress = project["results/tiny/runs/Acrobot-v1/mace_full/seed0/progress.json"]
    with project["first.log"].open("w") as log:
        first = subprocess.Popen(
            project.command("-j2", "all"),
            cwd=tmp_path,
            env=project.environment,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    deadline = time.monotonic() + 200
    while not progress.exists():
        assert first.poll() is None and time.monotonic() < deadline, project[
            "first.log"
        ].read_text()
        time.sleep(0.05)
    training = json.loads(progress.read_text())["pid"]
    with project["results/tiny/.lock"].open() as lock, pytest.raises(BlockingIOError):
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    first.send_signal(signal.SIGKILL)
    first.wait()
    again = project.snakemake("-j2", "all")
    assert again.returncode == 0, again.stdout
    assert "1 of 1 runs done" in again.stdout
    assert not Path(f"/proc/{training}").exists()  # the killed Snakemake's training has ended
    assert project.planned() == {}


@pytest.mark.slow
def test_planning_three_thousand_runs(tmp_path: Path) -> None:
    project = Project(tmp_path)
    study = STUDY | {
        "environments": ["CartPole-v1"],
        "variants": ["ppo", "mace_fixed", "mace_full"],
        "seeds": list(range(1000)),
    }
    project["tiny.yaml"].write_text(yaml.safe_dump(study))
    start = time.monotonic()
    jobs = project.planned()
    print(f"planning 3,000 runs took {time.monotonic() - start:.1f} s")
    assert jobs == {"train": 3000, "table2": 1, **EVALUATION}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_sources_are_what_is_imported(script: Path) -> None:
    """Everything of the package that Python loads for a script is among its sources."""
    imports = "\n".join(re.findall(r"^\s*((?:from|import) (?!job\b).*)", script.read_text(), re.M))
    imports = re.sub(r"^\s+", "", imports, flags=re.M)
    code = f"import sys\n{imports}\nprint(*(m for m in sys.modules if m.startswith('mace_rl')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[2] or "__init__" for name in done.stdout.split()}
    followed = {file.stem for file in sources(script) if file.parent == PACKAGE}
    assert loaded <= followed | {"__init__"}


def test_sources_follow_imports_in_functions_and_strings(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        '"""Not mace_rl.tables."""\n'
        "from mace_rl import streams\n"
        'faster = "mace_rl.records:write_episodes"\n'
        "def later():\n    import mace_rl.figures\n"
    )
    found = {file.stem for file in sources(script)}
    assert {"script", "__init__", "streams", "records", "figures", "metrics"} <= found
    assert "tables" not in found


def test_digest_goes_by_content_and_not_by_place(tmp_path: Path) -> None:
    digests = set()
    for place in ("one", "two"):
        script = tmp_path / place / "scripts" / "train.py"  # named like a module it imports
        script.parent.mkdir(parents=True)
        script.write_text("from mace_rl.train import Trainer\n")
        digests |= {digest(script) for _ in range(5)}
    assert len(digests) == 1
    script.write_text("from mace_rl.train import Trainer, Record\n")
    assert digest(script) not in digests
