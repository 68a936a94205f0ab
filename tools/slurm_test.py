"""Carry out the reduced study on a one-node Slurm cluster, with mishaps, and compare to the bit.

    python -m tools.slurm_test        (make slurm-test)

Starts a cluster on this machine, which Debian's slurm-wlm and munge have to be installed for, and
carries out `config/reduced.yaml` by profiles/slurm. Meanwhile one entry of the queue is cancelled,
one put back into the queue (what a preemption does), and one training killed. All that comes out
has to equal a local run byte for byte. Then the cluster is taken down, however the test ended.

The configuration has to be where Slurm looks for it, because Snakemake's Slurm plugin hands no
SLURM_* variables on. That place is outside the project and needs root; all else is in a folder of
its own. A machine that has a configuration there is refused.
"""

import argparse
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mace_rl import files

ROOT = Path(__file__).resolve().parent.parent
CONFIGURATION = Path("/etc/slurm/slurm.conf")
DAEMONS = ("munged", "slurmctld", "slurmd")
PROGRAMS = (*DAEMONS, "sbatch", "srun", "squeue", "scancel", "scontrol", "sinfo")
SIGN = f"# Written by {Path(__file__).name}, which takes it away again."
PATIENCE = 60.0  # seconds for daemons to start, and for jobs to end

STUDY = ["all", "--configfile", "config/reduced.yaml", "--config"]
# Long enough to be hit: a fast machine is done before a first checkpoint would be due.
STUDY += ["environment_settings={HopperBulletEnv-v0: {episodes: 500}}"]
CHECKPOINTS = {"MACE_RL_CHECKPOINT_SECONDS": "1"}
# In place of the profile's numbers, so that long runs, too, share entries in a study this small:
# the 14 shortest are an entry, and every two of Hopper's 4 with a bonus.
SMALL_ENTRIES = ["--group-components", "runs_18=18", "runs_2=2"]
HASTE = ["--slurm-init-seconds-before-status-checks", "5", "--seconds-between-status-checks", "5"]
LONG = "HopperBulletEnv-v0"  # its trainings last long enough for a checkpoint
FIRST, SECOND = ("killed", "preempted"), "cancelled"  # in the first or second run of an entry
MISHAPS = (*FIRST, SECOND)


class Unfit(SystemExit):
    """This machine cannot carry out the test; the message says why, in one line."""


def require() -> None:
    """Raise `Unfit` unless a cluster can be started here and would be in nobody's way."""
    missing = [name for name in PROGRAMS if not shutil.which(name)]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        raise Unfit(
            f"slurm test: {', '.join(missing)} {verb} missing; Debian and Ubuntu: "
            "apt-get install slurm-wlm munge"
        )
    if CONFIGURATION.exists() or "SLURM_CONF" in os.environ:
        found = os.environ.get("SLURM_CONF", CONFIGURATION)
        left = CONFIGURATION.exists() and SIGN in CONFIGURATION.read_text(errors="replace")
        advice = "not touched"
        if left:
            advice = (
                "a test that was killed left it: end its slurmctld, slurmd and munged, and remove"
                " the file"
            )
        raise Unfit(f"slurm test: there is a Slurm configuration already, {found}; {advice}")
    if os.geteuid() != 0:
        raise Unfit(f"slurm test: has to write {CONFIGURATION}, so it needs root")


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def ask(*command: str) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def configuration(scratch: Path) -> str:
    """Of a cluster that is this machine alone and leaves nothing outside `scratch`."""
    # NodeName=… CPUs=… Boards=… … RealMemory=…, and a line with the time since the machine started.
    node = ask("slurmd", "-C").splitlines()[0]
    name = node.split()[0].partition("=")[2]
    return f"""{SIGN}
ClusterName=slurm-test
SlurmctldHost={name}(127.0.0.1)
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmUser=root
AuthType=auth/munge
# A job that is put back into the queue may start again when its credential is void: in 5 seconds.
AuthInfo=socket={scratch}/munge.socket,cred_expire=5
StateSaveLocation={scratch}/state
SlurmdSpoolDir={scratch}/spool
SlurmctldPidFile={scratch}/slurmctld.pid
SlurmdPidFile={scratch}/slurmd.pid
# Without control groups, which a container may not have.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/affinity
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
KillWait=5
MailProg=/bin/true
{node} NodeAddr=127.0.0.1
PartitionName=test Nodes={name} Default=YES
"""


@contextmanager
def cluster(scratch: Path) -> Iterator[None]:
    """A running cluster; afterwards nothing of it is left, in memory or on disk."""
    (scratch / "state").mkdir()
    (scratch / "spool").mkdir()
    key = scratch / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(os.urandom(128))
    munge = {
        name: f"--{name}={scratch}/munge.{name}" for name in ("socket", "pid-file", "seed-file")
    }
    commands = [
        # --force: it distrusts folders that others could write, as the one for temporary files.
        ["munged", "--foreground", "--force", f"--key-file={key}", *munge.values()],
        ["slurmctld", "-D"],
        ["slurmd", "-D"],
    ]
    made = [folder for folder in [CONFIGURATION.parent] if not folder.exists()]
    daemons = []
    try:
        CONFIGURATION.parent.mkdir(exist_ok=True)
        CONFIGURATION.write_text(configuration(scratch), encoding="utf-8")
        for command in commands:
            # In sessions of their own, so that Ctrl-C reaches them last.
            with (scratch / f"{command[0]}.log").open("wb") as log:
                daemons.append(
                    subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
                )
            if command[0] == "munged":
                wait_for((scratch / "munge.socket").exists, "munged to start")
        wait_for(lambda: "idle" in ask("sinfo", "-h", "-o", "%t"), "the cluster's node")
        yield
    finally:
        with undisturbed():
            with suppress(subprocess.CalledProcessError, TimeoutError):  # it may not have come up
                ask("scancel", "--user=root")
                wait_for(lambda: not ask("squeue", "-h"), "the jobs to end")
            for daemon in reversed(daemons):
                daemon.terminate()
            for daemon in daemons:
                try:
                    daemon.wait(PATIENCE)
                except subprocess.TimeoutExpired:
                    daemon.kill()
            CONFIGURATION.unlink(missing_ok=True)
            for folder in made:
                folder.rmdir()


@contextmanager
def undisturbed() -> Iterator[None]:
    """Keep the signals that would end this process from doing so."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, signal.SIG_IGN) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def wait_for(condition: Callable[[], object], what: str) -> None:
    """Wait until `condition` is true; `TimeoutError` after `PATIENCE` seconds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"slurm test: waited in vain for {what}")
        time.sleep(0.2)


@contextmanager
def study(results: Path, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """A Snakemake at work, which ends with the block; what it says goes to a file."""
    command = [sys.executable, "-m", "snakemake", *STUDY, f"results={results}", *options]
    with results.with_suffix(".log").open("wb") as log:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **CHECKPOINTS},
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def finish(process: subprocess.Popen[bytes], results: Path) -> None:
    """Wait for a study; exit with the end of what it said if it failed."""
    if process.wait() != 0:
        said = results.with_suffix(".log").read_text(errors="replace").splitlines()
        sys.exit("\n".join([*said[-30:], "slurm test: Snakemake failed, as shown"]))


class Entries:
    """Which entry of the queue carries out which run, as seen by who watches their folders."""

    def __init__(self, results: Path) -> None:
        self.results = results
        self.seen: dict[Path, str] = {}  # the folder of a run: Slurm's number of its entry

    def running(self) -> Iterator[tuple[Path, int]]:
        """The folders of the runs that train now, and their processes."""
        for told in self.results.glob(f"runs/*/*/*/{files.PROGRESS}"):
            with suppress(OSError, ValueError):  # the file, or the process, was there until now
                pid = json.loads(told.read_bytes())["pid"]
                environment = Path(f"/proc/{pid}/environ").read_bytes().decode().split("\0")
                [self.seen[told.parent]] = (
                    value.removeprefix("SLURM_JOB_ID=")
                    for value in environment
                    if value.startswith("SLURM_JOB_ID=")
                )
                yield told.parent, pid

    def has_finished_runs(self, entry: str) -> bool:
        """Whether some run in this entry is done."""
        return any((run / files.RECORD).exists() for run, its in self.seen.items() if its == entry)


def disturb(process: subprocess.Popen[bytes], results: Path) -> Iterator[tuple[str, Path]]:
    """Let each mishap happen to a training that has a checkpoint; what it was, and to which run.

    Each to another entry. One is cancelled when it has a finished run, which has to be there again
    without being trained again.
    """
    entries, due = Entries(results), list(MISHAPS)
    hit: set[Path | str] = set()
    while process.poll() is None and due:
        time.sleep(0.5)
        for run, pid in entries.running():
            entry = entries.seen[run]
            if {run, entry} & hit or LONG not in run.parts or not (run / files.CHECKPOINT).exists():
                continue
            fitting = (SECOND,) if entries.has_finished_runs(entry) else FIRST
            how = next((mishap for mishap in due if mishap in fitting), None)
            if how is None:
                continue
            try:
                if how == "cancelled":
                    ask("scancel", entry)
                elif how == "preempted":
                    ask("scontrol", "requeue", entry)
                else:
                    os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue  # it has just ended: another will do
            except subprocess.CalledProcessError as error:
                print(f"{how}, entry {entry}: {error.stderr.strip()}", flush=True)
                continue  # if it has just ended, another will do
            due.remove(how)
            hit |= {run, entry}
            yield how, run


def contents(results: Path) -> dict[str, bytes]:
    """What has to be equal: everything but what tells of the circumstances."""
    circumstances = {"logs", "benchmarks", files.RECORD, ".lock"}
    return {
        # The claim ledger says how long all trainings took.
        str(path.relative_to(results)): re.sub(rb"[^,\n]*core.hours.*", b"", path.read_bytes())
        if path.stem == "claims"
        else path.read_bytes()
        for path in sorted(results.rglob("*"))
        if path.is_file() and not circumstances.intersection(path.relative_to(results).parts)
    }


def main() -> None:
    """Run everything; exit with 1 unless all is equal and every mishap happened and was mended."""
    argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.slurm_test"
    ).parse_args()
    require()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    began = time.monotonic()

    def report(text: str) -> None:
        print(f"[{time.monotonic() - began:4.0f} s] {text}", flush=True)

    with tempfile.TemporaryDirectory(prefix="slurm-test-") as folder:
        scratch = Path(folder)
        here, there = scratch / "local", scratch / "slurm"
        report("the study without Slurm")
        with study(here, "--cores", str(len(os.sched_getaffinity(0)))) as process:
            finish(process, here)
        report("the study on a cluster of one node")
        options = ["--workflow-profile", "profiles/slurm", *SMALL_ENTRIES, *HASTE]
        options += ["--slurm-logdir", str(scratch / "slurm_logs")]
        mishaps = {}
        with cluster(scratch), study(there, *options) as process:
            for how, run in disturb(process, there):
                mishaps[how] = run
                report(f"{how}: {run.relative_to(there / 'runs')}")
            finish(process, there)
            [following] = re.findall(r"NEXT_JOB_ID *= (\d+)", ask("scontrol", "show", "config"))
        wanted, found = contents(here), contents(there)
        records = {
            path.parent: json.loads(path.read_bytes())
            for path in there.glob(f"runs/*/*/*/{files.RECORD}")
        }
        left = [str(path) for path in there.rglob(files.CHECKPOINT)]
    resumed = [how for how, run in mishaps.items() if records[run]["interruptions"]]
    # Done already when their entry ended early: not trained again.
    spared = sum(
        bool(record["interruptions"])
        and record["interruptions"][-1]["after_episode"] == record["config"]["episodes"]
        for record in records.values()
    )
    different = sorted(n for n in wanted.keys() | found.keys() if wanted.get(n) != found.get(n))
    for name in different:
        print(f"DIFFERENT: {name}")
    for how in MISHAPS:
        if how not in resumed:
            print(f"NOT RESUMED: {how}" if how in mishaps else f"NOT HIT: {how}")
    for path in left:
        print(f"NOT REMOVED: {path}")
    report(
        f"{int(following) - 1} entries of the queue for {len(records)} runs; done when their entry "
        f"ended early, and not trained again: {spared}"
    )
    print(
        f"{len(resumed)} of {len(MISHAPS)} disturbed trainings resumed from their checkpoints; "
        f"{len(wanted) - len(different)} of {len(wanted)} files are equal to the bit"
    )
    sys.exit(bool(different or left) or len(resumed) < len(MISHAPS) or not spared)


if __name__ == "__main__":
    main()
