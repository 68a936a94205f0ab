"""The workflow for real, at tiny budgets, in a copy of the project."""

import fcntl
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import forked
import pytest
from numba.core.caching import UserProvidedCacheLocator
from shared import OUTCOME, ROOT

from mace_rl.base import code_digest
from mace_rl.config.command_line import checked
from mace_rl.numerics import compiling

pytestmark = pytest.mark.slow

ENVIRONMENTS, VARIANTS = ["CartPole-v1", "Acrobot-v1"], ["ppo", "mace_fixed", "mace_full"]
# Instead of what config.yaml has.
TINY = {"environments": ENVIRONMENTS, "variants": VARIANTS, "seeds": [0], "  episodes": 4}
RUNS = [f"runs/{env}/{variant}/seed0" for env in ENVIRONMENTS for variant in VARIANTS]
TABLES, DRAWN = {"tables": 1}, {"pictures": 1}
EVALUATION = {"metrics": 1, **TABLES, **DRAWN}


class Project:
    """A copy of the project with a tiny study, whose files a test may change."""

    def __init__(self, folder: Path, **changes: object) -> None:
        self.folder = folder
        ignored = shutil.ignore_patterns("__pycache__")
        for name in ("config", "profiles", "workflow", "src"):
            shutil.copytree(ROOT / name, folder / name, ignore=ignored)
        for name in ("Snakefile", "config.yaml"):
            shutil.copy2(ROOT / name, folder / name)
        text = self["config.yaml"].read_text(encoding="utf-8")
        for key, value in (TINY | changes).items():
            line = f"{key}: {json.dumps(value)} "
            text, found = re.subn(rf"(?m)^{key}: [^#\n]*", line, text, count=1)
            assert found, key
        self["config.yaml"].write_text(text, encoding="utf-8")
        # numba keeps compiled code by the folder that the source is in.
        package, place = self["src/mace_rl"], UserProvidedCacheLocator.get_suitable_cache_subpath
        for name in code_digest.KERNELS:
            here, there = (place(str(top / name / "x")) for top in (code_digest.PACKAGE, package))
            goal = package / "__pycache__" / "numba" / compiling.FOLDER.name / there
            if (compiling.FOLDER / here).exists():
                unfinished = shutil.ignore_patterns("*.tmp.*", "tmp*")
                shutil.copytree(compiling.FOLDER / here, goal, ignore=unfinished)

    def __getitem__(self, name: str) -> Path:
        return self.folder / name

    @property
    def environment(self) -> dict[str, str]:
        """As where the environment is activated."""
        search = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        changes = {"PATH": search, "PYTHONPATH": str(self["src"]), "TERM": "xterm"}
        # As on a node of a cluster, which inherits it from the machine that submitted.
        changes["MACE_RL_SNAKEMAKE_PID"] = str(2**22 + 1)  # more than Linux has
        changes["MACE_RL_CHECKPOINT_SECONDS"] = "0"  # so that there is always one to resume
        return {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | changes

    def start(self, command: str, output: int) -> subprocess.Popen:
        """Begin the command, as typed in the project's folder."""
        streams = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT}
        settings = {"cwd": self.folder, "env": self.environment, "start_new_session": True}
        return subprocess.Popen(shlex.split(command), **settings, **streams)

    def typed(self, command: str) -> tuple[int, str]:
        """The exit code of a command and what it printed."""
        process = self.start(command, subprocess.PIPE)
        output, _ = process.communicate(timeout=900)
        return process.returncode, output.decode()

    def __call__(self, command: str) -> tuple[int, str]:
        """The same, in a third of the time if it is Snakemake's."""
        words = shlex.split(command)
        if words[0] != "snakemake":
            return self.typed(command)
        code = forked.run(words, self.folder, self.environment, self["said.log"])
        return code, self["said.log"].read_text(encoding="utf-8")

    def planned(self) -> dict[str, int]:
        code, output = self("snakemake -n all")
        assert code == 0, output
        jobs = re.findall(r"^(\w+) +(\d+)$", output.partition("\n\n")[0], re.MULTILINE)
        assert jobs or "Nothing to be done" in output, output
        return {rule: int(number) for rule, number in jobs if rule not in ("all", "total")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, trained) -> Project:
    """A project whose tiny study has been carried out; tests leave it as they find it."""
    for environment in ENVIRONMENTS:  # so that all there is to compile is compiled
        trained(environment, "mace_full", episodes=4)
    project = Project(tmp_path_factory.mktemp("tiny study"))
    code, output = project.typed("snakemake results/table1.tex")
    assert code == 0, output
    project["terminal.log"].write_text(output, encoding="utf-8")
    code, output = project("snakemake -j2 all")
    assert code == 0, output
    project["file.log"].write_text(output, encoding="utf-8")
    full = [log.read_text() for log in sorted(project[".snakemake/log"].glob("*.snakemake.log"))]
    cores = [re.search(r"Provided cores: (\d+)", text)[1] for text in full]
    assert cores == [str(len(os.sched_getaffinity(0))), "2"]  # without -j, and with
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


def test_everything_is_made_and_the_terminal_says_how_far_it_is(finished: Project) -> None:
    terminal, file = finished["terminal.log"].read_text(), finished["file.log"].read_text()
    assert "6 of 6 runs to train; how far they are: mace-rl status results" in terminal
    assert "4 episodes are too few for convergence_steps, " in terminal  # moving averages of 50
    assert "train CartPole-v1 ppo 0" in terminal and "0 of 6 runs to train" in file
    assert "Error" not in terminal + file
    for output in (terminal, file):
        shown = output.partition("Table 1: ")[2].splitlines()
        assert shown[2].split() == ["Algorithm", *ENVIRONMENTS]
        assert max(map(len, shown)) <= 100 and "results/table1.tex" in shown[7]
    assert finished("mace-rl status results") == (0, "6 of 6 runs done\n")
    logs = [*finished["results/logs"].rglob("*.log")]
    assert len(logs) == len(RUNS) + sum(EVALUATION.values())
    assert all(": done in" in log.read_text() for log in logs)
    assert len([*finished["results/benchmarks"].rglob("*.tsv")]) == len(RUNS)


def test_time_stamps_do_not_count(finished: Project) -> None:
    for folder in ("src", "workflow", "config", "profiles", "results/runs"):
        for file in finished[folder].rglob("*"):
            os.utime(file)
    for name in ("Snakefile", "config.yaml"):
        os.utime(finished[name])
    output = finished("snakemake all")[1]
    assert "Nothing to be done" in output
    assert output.endswith(finished["file.log"].read_text().partition("Table 1")[2])


MODES = {  # options, with a file taken away before, and what the last lines then have
    "--touch": ("table1.csv", "Not there, and not made now: results/table1.csv"),
    "--until train": (f"{RUNS[0]}/agent.pt", "Not there, and not made now: results/runs/"),
    "--omit-from pictures": ("figure1.pdf", "results/table1.tex, results/table2.tex"),
    "--batch all=1/2": (None, "results/table1.tex"),
    "--summary": (None, "no update"),
    "--config replace=true": (None, "Nothing to be done"),
    "--delete-all-output --dry-run": (None, "Would delete results/"),
}


@pytest.mark.parametrize("mode", MODES)
def test_the_last_lines_are_true_in_each_of_snakemake_s_modes(finished: Project, mode) -> None:
    name, said = MODES[mode]
    away = finished[f"results/{name}"] if name else None
    if away:
        away.rename(away.with_suffix(".away"))
    try:
        code, output = finished(f"snakemake -j2 all {mode}")
    finally:
        if away:
            away.with_suffix(".away").rename(away)
    assert code == 0 and said in output and "Traceback" not in output and "File " not in output
    last = output.partition("Table 1: ")[2] or output[output.rfind("Complete log") :]
    for path in re.findall(r"results/\S+\.\w+(?=,|\n)", last.partition("Not there")[0]):
        assert finished[path].exists() and path != f"results/{name}"


def test_the_report_has_each_picture_with_a_caption_of_its_own(finished: Project) -> None:
    code, output = finished("snakemake all --report r.html")
    assert code == 0 and "Report created" in output and "Traceback" not in output
    report = finished["r.html"].read_text(encoding="utf-8")
    names = [path.stem for path in finished["results"].glob("*.png")]
    captions = [finished[f"workflow/report/{name}.rst"].read_text() for name in names]
    said = [re.search(r"[A-Za-z ]{15,}", caption)[0] for caption in captions]
    assert len({*said}) == len(names) >= 4
    assert [words for words in said if words not in report] == []


CONFIG, PPO = "config.yaml", "src/mace_rl/agent/ppo.py"


def test_what_has_no_meaning_runs_nothing_again(finished: Project, edit) -> None:
    """Settings of a variant that is not run, the order of keys, comments."""
    edit(CONFIG, "tab:purple", "tab:pink")
    clip, gae = "    clip: 0.2 # [P] Table 2, ε (clip_range)\n", "    gae_lambda: 0.99 # [C]"
    edit(CONFIG, clip + gae, "    gae_lambda: 0.99\n    clip: 0.2 # [C]")
    edit(PPO, "\n\nimport", "\n# Of no meaning.\n\nimport")
    assert finished.planned() == {}


TRAIN = {"train": 6, **EVALUATION}
CHANGES = [  # of a file, from one text to another, and what is to be done then
    (CONFIG, "tab:blue", "tab:cyan", DRAWN),
    (CONFIG, "PPO (", "Plain PPO (", TABLES | DRAWN),
    (CONFIG, "clip: 0.2", "clip: 0.3", TRAIN),
    (CONFIG, "capacity: 1000", "capacity: 999", TRAIN | {"train": 4}),  # what the bonus uses
    (CONFIG, "window: 50, noise", "window: 40, noise", TRAIN | {"train": 2}),
    (CONFIG, "seeds: [0]", "seeds: [0, 1]", TRAIN),
    (PPO, "\n\nimport", "\n\nN = 1\nimport", TRAIN),
    ("src/mace_study/measure/metrics.py", "\n\nimport", "\n\nN = 1\nimport", EVALUATION),
    ("workflow/scripts/train.py", "\n\nimport", "\n\nN = 1\nimport", TRAIN),
    ("workflow/scripts/tables.py", "\n\nfrom", "\n\nN = 1\nfrom", TABLES),
    ("config/claims.yaml", "[140, 660]", "[141, 660]", EVALUATION),
    (*("results/metrics.csv", "CartPole-v1,ppo,0", "CartPole-v1,ppo,7"), TABLES | DRAWN),
]


@pytest.mark.parametrize(("file", "old", "new", "expected"), CHANGES)
def test_what_a_change_runs_again(finished: Project, edit, file, old, new, expected) -> None:
    edit(file, old, new)
    if file.startswith("src"):
        os.utime(finished[file], (1, 1))  # content counts
    assert finished.planned() == expected


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--config seeds=[0,0]", "config.yaml: seeds is [0, 0], but 0 should be there once"),
        ("--config sedes=[0]", "config.yaml: unknown key 'sedes'"),
        ("--configfile /nowhere.yaml", "/nowhere.yaml: cannot be read: No such file"),
        ("--config claims=latin1.yaml", "config.yaml: latin1.yaml: cannot be read: it is"),
        ("-j2 --cores 1", "-j 2 and --cores 1 contradict each other"),
        ("--configfile config.yaml --configfiles config.yaml", "--configfile is there 2 times"),
        (
            "--workflow-profile profiles/slurm --config a=1 --config b=2",
            "--config is there 2 times",
        ),
        ("--config metrics.threshold=1", "--config has 'metrics.threshold=1', but should have"),
    ],
)
def test_mistakes_end_in_one_line(finished: Project, options: str, expected: str) -> None:
    finished["latin1.yaml"].write_bytes(b"a: \xff")
    code, output = finished(f"snakemake -n all {options}")
    assert code == 1 and "Traceback" not in output
    assert output.splitlines()[-1].startswith(f"Error in the configuration: {expected}")


def test_on_a_cluster_jobs_and_cores_are_two_things(monkeypatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["snakemake", "-j9", "--cores", "1"])
    assert checked(cluster=True).cores == "1"
    with pytest.raises(SystemExit, match="-j 9 and --cores 1 contradict"):
        checked()


def test_one_snakemake_at_a_time(finished: Project, edit) -> None:
    edit("config.yaml", "tab:blue", "tab:cyan")  # something to do
    with finished["results/.lock"].open("w") as lock:
        lock.write("Snakemake (process 7 on moon)")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)
        code, output = finished("snakemake all")
        assert code == 1
        refusal = "Error: Snakemake (process 7 on moon) is at work in results; wait for it"
        assert refusal in output.splitlines()
        assert finished.planned() == DRAWN  # looking is allowed


def test_success_removes_the_checkpoints_of_finished_runs_alone(finished: Project) -> None:
    """Those that runs on a cluster left."""
    done, unfinished = (finished[f"part/runs/CartPole-v1/{name}/seed0"] for name in VARIANTS[:2])
    for run in (done, unfinished):
        run.mkdir(parents=True)
        (run / "checkpoint.pt").touch()
    (done / "run.json").write_text("{}")
    code, output = finished(f"snakemake part/{RUNS[-1]}/run.json --config results=part")
    assert code == 0, output
    assert not (done / "checkpoint.pt").exists() and (unfinished / "checkpoint.pt").exists()


def test_runs_from_elsewhere_are_taken_if_whole_and_this_study_s(finished: Project) -> None:
    """Snakemake knows nothing of them."""
    shutil.copytree(finished["results/runs"], finished["copied/runs"])
    episodes = finished[f"copied/{RUNS[0]}/episodes.csv"]
    content = episodes.read_bytes()
    episodes.write_bytes(content[:-10])
    code, output = finished("snakemake -j1 copied/metrics.csv --config results=copied")
    assert code == 1
    (line,) = [line for line in output.splitlines() if "metrics failed: " in line]
    assert f"RecordError: copied/{RUNS[0]}/episodes.csv: line" in line
    assert "log: copied/logs/metrics.log" in output and RUNS[1] not in output
    assert "Traceback" not in output
    assert "Traceback" in finished["copied/logs/metrics.log"].read_text()
    episodes.write_bytes(content)  # what failed is made again
    code, output = finished("snakemake copied/tables.md --config results=copied")
    assert code == 0 and "train" not in re.findall(r"^(\w+) +\d", output, re.MULTILINE), output
    shutil.rmtree(finished["copied/runs"])
    shutil.copytree(finished["results/runs"], finished["other/runs"])
    changed = "results=other 'training={ppo: {clip: 0.3}}'"
    code, output = finished(f"snakemake other/metrics.csv --config {changed}")
    assert code == 1 and f"other/{RUNS[0]}/run.json is of another run: ppo.clip was 0.2" in output


def test_a_study_does_not_replace_the_runs_of_another(finished: Project) -> None:
    """Unless that is said; and what is replaced is set aside."""
    run = f"mine/{RUNS[0]}"

    def train(clip: float, option: str = "", more: str = "") -> tuple[int, str]:
        changes = f"results=mine {more} 'training={{ppo: {{clip: {clip}}}}}'"
        return finished(f"snakemake -j1 {run}/episodes.csv {option} --config {changes}")

    def clips() -> list[float]:
        records = sorted(finished[run].rglob("run.json"))  # those that were set aside are first
        return [json.loads(one.read_text())["config"]["ppo"]["clip"] for one in records]

    assert train(0.2)[0] == 0 and clips() == [0.2]
    code, said = train(0.1)
    assert code == 1 and clips() == [0.2]
    assert "ppo.clip was 0.2 and is 0.1" in said and "--config results=NAME" in said
    assert train(0.1, more="replace=true")[0] == 0 and clips() == [0.2, 0.1]
    assert train(0.3, option="-F")[0] == 0 and sorted(clips()) == [0.1, 0.2, 0.3]


def test_another_config_yaml_where_snakemake_starts_is_not_read(finished: Project) -> None:
    finished["elsewhere"].mkdir()
    finished["elsewhere/config.yaml"].write_text("- a")
    code, output = finished("sh -c 'cd elsewhere && snakemake -s ../Snakefile -n ../results/x'")
    assert code == 1 and "config.yaml" not in output and "MissingRuleException" in output


def test_the_same_command_after_it_was_interrupted_killed_and_ended(finished: Project) -> None:
    place, said = "runs/Acrobot-v1/mace_full/seed0", "environments=[Acrobot-v1]"
    said += " variants=[mace_full] 'training={episodes: 3000}' results="
    command = f"snakemake killed/metrics.csv --config {said}killed"
    whole = f"snakemake whole/{place}/run.json --config {said}whole"
    run = finished["killed"] / place
    told = run / "progress.json"
    for sent in (signal.SIGINT, signal.SIGKILL, signal.SIGTERM):
        with finished["killed.log"].open("w") as log:
            process = finished.start(command, log.fileno())
        deadline = time.monotonic() + 200
        while not (told.exists() and (run / "checkpoint.pt").exists()):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        training = json.loads(told.read_text())["pid"]
        assert "0 of 1 runs done, 1 running" in finished("mace-rl status killed")[1]
        with finished["killed/.lock"].open() as lock, pytest.raises(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if sent == signal.SIGINT:  # which a terminal sends to all
            os.killpg(process.pid, sent)
        else:
            process.send_signal(sent)  # at SIGTERM it lets jobs come to their end
        while Path(f"/proc/{training}").exists():  # it notices that Snakemake is gone ...
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.wait()  # ... even if nobody has asked how it ended
        assert (run / "run.json").exists() == (sent == signal.SIGTERM)
        told.unlink(missing_ok=True)
        output = finished["killed.log"].read_text()
        assert (": interrupted" in output) == (sent == signal.SIGINT)
        assert "failed: " not in output and "Traceback" not in output
    code, output = finished(command)
    assert code == 0, output
    assert "Nothing to be done" in finished(f"{command} -n")[1]
    record = json.loads((run / "run.json").read_text())
    assert len(record["interruptions"]) == 2
    code, output = finished(whole)
    assert code == 0, output
    for name in OUTCOME:
        assert (run / name).read_bytes() == (finished["whole"] / place / name).read_bytes()


@pytest.mark.parametrize("option", ["--core=1", "-j1"])
def test_no_more_jobs_run_at_once_than_cores_are_given(tmp_path, option):
    (tmp_path / "Snakefile").write_text(
        "rule all:\n    input: expand('{n}', n=range(2))\n"
        "rule one:\n    output: '{n}'\n"
        "    shell: 'echo begin >>said; sleep 0.5; echo end >>said; touch {output}'\n"
    )
    command = [sys.executable, "-m", "snakemake", *option.split()]
    command += ["--workflow-profile", str(ROOT / "profiles" / "default")]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "said").read_text().split() == ["begin", "end"] * 2
