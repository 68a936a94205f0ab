"""The reduced study on a Slurm cluster of one node, with mishaps: make slurm-test.

It has to write the configuration where Slurm looks for it, outside the project, so it needs root;
all else of the cluster is in a folder of its own.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
import yaml
from shared import ROOT, contents, provenance_of

from mace_rl.base import files
from mace_rl.runs import slurm

# Slurm looks here only: Snakemake's Slurm plugin hands no SLURM_* variables on.
CONFIGURATION = Path("/etc/slurm/slurm.conf")
PROGRAMS = "munged slurmctld slurmd sbatch srun squeue scancel scontrol sinfo"
PATIENCE = 60.0  # seconds for daemons to start, and for processes to end
MARK = "MACE_RL_SLURM_TEST"  # in the environment of whatever the test starts

STUDY = ["all", "--configfile", "config/reduced.yaml", "--config"]
# Long enough to be hit: a fast machine is done before a first checkpoint would be due.
STUDY += ["environment_settings={HopperBulletEnv-v0: {episodes: 500}}"]
LONG = "HopperBulletEnv-v0"
# In place of the profile's numbers, so that long runs, too, share entries in a study this small:
# the 14 shortest are an entry, and every two of Hopper's 4 with a bonus.
ON_SLURM = ["--workflow-profile", "profiles/slurm", "--group-components", "runs_18=18", "runs_2=2"]
ON_SLURM += ["--slurm-init-seconds-before-status-checks", "5"]
ON_SLURM += ["--seconds-between-status-checks", "5"]
FIRST, SECOND = ("killed", "preempted"), "cancelled"  # in the first or second run of an entry


def unfit() -> str:
    """Why no cluster can be started here, or would be in somebody's way; "" if neither."""
    missing = [name for name in PROGRAMS.split() if not shutil.which(name)]
    if missing:
        return f"{', '.join(missing)} missing; Debian and Ubuntu: apt-get install slurm-wlm munge"
    if "SLURM_CONF" in os.environ or CONFIGURATION.exists():  # or left, when a machine stopped
        found = os.environ.get("SLURM_CONF", CONFIGURATION)
        return f"there is a Slurm configuration already, {found}; not touched"
    return "" if os.geteuid() == 0 else f"has to write {CONFIGURATION}, so it needs root"


def ask(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def configuration(scratch: Path) -> str:
    """Of a cluster that is this machine alone and leaves nothing outside `scratch`."""
    # NodeName=… CPUs=… Boards=… … RealMemory=…, and a line with the time since the machine started.
    node = ask("slurmd", "-C").splitlines()[0]
    name = node.split()[0].partition("=")[2]
    return f"""
ClusterName=slurm-test
SlurmctldHost={name}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
# A job that is put back into the queue may start again when its credential is void: in 5 seconds.
AuthInfo=socket={scratch}/munge.socket,cred_expire=5
StateSaveLocation={scratch}/state
SlurmdSpoolDir={scratch}/spool
SlurmctldPidFile={scratch}/slurmctld.pid
SlurmdPidFile={scratch}/slurmd.pid
# Without control groups, which a container may not have. By process groups, not by parents: at
# scancel a job's shell dies first, and what it started would have no parent to be found by.
ProctrackType=proctrack/pgid
TaskPlugin=task/affinity
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
KillWait=5
MailProg=/bin/true
{node} NodeAddr=127.0.0.1
PartitionName=test Nodes={name} Default=YES
"""


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited in vain for {what}")
        time.sleep(0.2)


def marked(scratch: Path) -> list[psutil.Process]:
    """What this test has started and still runs, whoever its parent is by now."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # it has just ended
            if process.environ().get(MARK) == str(scratch):
                found.append(process)
    return found


@pytest.fixture
def scratch(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for all that the test leaves; fails if a process is left, and ends it."""
    with tempfile.TemporaryDirectory(prefix="slurm-test-") as folder:
        monkeypatch.setenv(MARK, folder)
        for number in (signal.SIGTERM, signal.SIGHUP):  # like Ctrl-C: all is taken down
            signal.signal(number, signal.default_int_handler)
        yield Path(folder)
        with suppress(TimeoutError):
            wait_for(lambda: not marked(Path(folder)), "processes to end")
        left = [" ".join(process.cmdline()) for process in marked(Path(folder))]
        for process in marked(Path(folder)):
            process.kill()
        assert not left


@pytest.fixture
def cluster(scratch: Path) -> Iterator[None]:
    """A running cluster, which is taken down afterwards, however the test ended."""
    if reason := unfit():
        pytest.fail(f"slurm test: {reason}", pytrace=False)
    (scratch / "state").mkdir()
    (scratch / "spool").mkdir()
    key = scratch / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(os.urandom(128))
    munge = [f"--{name}={scratch}/munge.{name}" for name in ("socket", "pid-file", "seed-file")]
    commands = [
        # --force: it distrusts folders that others could write, as the one for temporary files.
        ["munged", "--foreground", "--force", f"--key-file={key}", *munge],
        ["slurmctld", "-D"],
        ["slurmd", "-D"],
    ]
    daemons = []
    try:
        CONFIGURATION.write_text(configuration(scratch), encoding="utf-8")
        for command in commands:
            # In sessions of their own, so that Ctrl-C reaches them last.
            with (scratch / f"{command[0]}.log").open("wb") as log:
                own = {"stdout": log, "stderr": log, "start_new_session": True}
                daemons.append(subprocess.Popen(command, **own))
            if command[0] == "munged":
                wait_for((scratch / "munge.socket").exists, "munged to start")
        wait_for(lambda: "idle" in ask("sinfo", "-h", "-o", "%t"), "the cluster's node")
        yield
    finally:
        with suppress(subprocess.CalledProcessError, TimeoutError):  # it may not have come up
            ask("scancel", "--user=root")
            wait_for(lambda: not ask("squeue", "-h"), "the jobs to end")
        for daemon in reversed(daemons):
            daemon.terminate()
        CONFIGURATION.unlink(missing_ok=True)
        for daemon in daemons:
            daemon.wait(PATIENCE)


@contextmanager
def snakemake(results: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """A Snakemake that carries out the study while the block runs, and well when it ends."""
    command = [sys.executable, "-m", "snakemake", *STUDY, f"results={results}", *options]
    variables = os.environ | {"MACE_RL_CHECKPOINT_SECONDS": "1"}
    log = results.with_suffix(".log")
    with log.open("wb") as said:
        streams = {"stdout": said, "stderr": said, "start_new_session": True}
        process = subprocess.Popen(command, cwd=ROOT, env=variables, **streams)
    try:
        yield process
        assert process.wait() == 0, log.read_text(errors="replace")[-3000:]
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def running(results: Path) -> Iterator[tuple[Path, int, str]]:
    """The folders of the runs that train now, their processes, and their entries of the queue."""
    for told in results.glob(f"runs/*/*/*/{files.PROGRESS}"):
        with suppress(OSError, ValueError, psutil.Error):  # file or process were there until now
            pid = json.loads(told.read_bytes())["pid"]
            yield told.parent, pid, psutil.Process(pid).environ()["SLURM_JOB_ID"]


def disturb(process: subprocess.Popen[bytes], results: Path) -> dict[str, Path]:
    """Let each mishap happen to a training that has a checkpoint; to which run.

    Each to another entry. One is cancelled when it has a finished run, which has to be there again
    without being trained again.
    """
    entries: dict[Path, str] = {}
    hit: dict[str, Path] = {}
    while process.poll() is None and len(hit) < 3:
        time.sleep(0.5)
        for run, pid, entry in running(results):
            entries[run] = entry
            done = [its for its in entries if (its / files.RECORD).exists()]
            spared = any(entries[its] == entry for its in done)
            fitting = [how for how in ((SECOND,) if spared else FIRST) if how not in hit]
            taken = {entries[its] for its in hit.values()}
            long_enough = LONG in run.parts and (run / files.CHECKPOINT).exists()
            if not fitting or not long_enough or entry in taken or run in hit.values():
                continue
            with suppress(ProcessLookupError, subprocess.CalledProcessError):  # it has just ended
                if fitting[0] == "killed":
                    os.kill(pid, signal.SIGKILL)
                else:
                    command = ["scancel"] if fitting[0] == SECOND else ["scontrol", "requeue"]
                    ask(*command, entry)
                hit[fitting[0]] = run
    return hit


@pytest.mark.slow
@pytest.mark.slurm
def test_a_study_on_a_cluster_with_mishaps_is_that_of_one_machine(scratch, cluster) -> None:
    """One training is killed, one entry cancelled, one put back, as a preemption does."""
    here, there = scratch / "local", scratch / "slurm"
    with snakemake(here, "--cores", str(len(os.sched_getaffinity(0)))):
        pass
    with snakemake(there, *ON_SLURM, "--slurm-logdir", str(scratch / "logs")) as process:
        hit = disturb(process, there)
    assert hit.keys() == {*FIRST, SECOND}
    records = {run: provenance_of(run) for run in there.glob("runs/*/*/*")}
    for how, run in hit.items():
        assert records[run]["interruptions"], f"{how}: not resumed"
    last = [(one["interruptions"][-1:], one["config"]["episodes"]) for one in records.values()]
    # Done already when their entry ended early: not trained again.
    assert any(told and told[0]["after_episode"] == episodes for told, episodes in last)
    assert not list(there.rglob(files.CHECKPOINT))
    wanted, found = contents(here), contents(there)
    assert found.keys() == wanted.keys()
    assert [name for name in wanted if found[name] != wanted[name]] == []
    [following] = re.findall(r"NEXT_JOB_ID *= (\d+)", ask("scontrol", "show", "config"))
    print(f"{int(following) - 1} entries of the queue for {len(records)} runs; {len(wanted)} files")


# --- The profile ----------------------------------------------------------------------------------

PROFILE = ROOT / "profiles" / "slurm" / "config.yaml"


def test_the_profile_has_all_of_the_default_one() -> None:
    default = yaml.safe_load((ROOT / "profiles" / "default" / "config.yaml").read_text())
    slurm = yaml.safe_load(PROFILE.read_text())
    # What is computed is of one machine: as many jobs as it has cores.
    wanted = {key: value for key, value in default.items() if not key.startswith(("__", "?"))}
    assert "rerun-triggers" in wanted
    assert {key: slurm.get(key) for key in wanted} == wanted


def test_minutes_grow_with_the_work(run_config) -> None:
    compiled, other = run_config("CartPole-v1"), run_config("HopperBulletEnv-v0")
    assert slurm.minutes(compiled, 0.0) == 2
    assert slurm.minutes(compiled, 30_000 * 60 * 5) == 7
    assert slurm.minutes(other, 3_000 * 60 * 5) == 7
    assert slurm.minutes(run_config("CartPole-v1", engine="torch"), 300 * 60 * 5) == 7


@pytest.mark.parametrize(
    ("minutes", "expected"), [(1, "b"), (12, "b"), (13, "a"), (60, "a"), (61, None), (9999, None)]
)
def test_an_entry_holds_as_many_runs_as_two_hours_do(minutes: int, expected: str | None) -> None:
    assert slurm.entry(minutes, {"a": 2, "b": 10}) == expected
    assert slurm.entry(minutes, {}) is None


@pytest.mark.slow
def test_hundreds_of_short_runs_are_a_dozen_entries() -> None:
    command = [sys.executable, "-m", "snakemake", "-n", "all", "--workflow-profile", str(PROFILE)]
    command += ["--config", "environments=[CartPole-v1]", "seeds=0-83"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    runs = re.findall(r"^ +rule train:$", done.stdout + done.stderr, re.MULTILINE)
    entries = re.findall(r"Group job runs_(\d+) ", done.stdout + done.stderr)
    # 84 runs of PPO, 40 to an entry, and 168 with a bonus, 20 to an entry.
    assert len(runs) == 252
    assert sorted(entries) == ["20"] * 9 + ["40"] * 3
