"""What Snakemake's terminal shows of a study, by Snakemake's interface for logger plugins.

    [12:03:10] 12 of 45 runs done, 2 running, 31 waiting; about 3 h 20 min left
    environment         variant    seed    episode  return     β  steps/s       left
    HopperBulletEnv-v0  mace_full     3  1204/6000   612.3  0.31     1830
    CartPole-v1         ppo           0   804/2000   480.1  0.00    11230  1 min 50 s

Snakemake finds this package by its name, and profiles/default/config.yaml chooses it. It follows
the events of the jobs and reads what the runs tell in their folders, on whichever machine they are.
"""

import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from logging import LogRecord
from pathlib import Path
from statistics import fmean
from typing import Any

from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent

from mace_rl import files
from mace_rl.runs.progress import Countdown, Display, Pace, Run, duration, seconds_left

# What Snakemake says of each job, which stays in its log; of errors, the log of the job says why.
ROUTINE = [LogEvent(name) for name in ("job_info", "job_started", "job_finished", "job_error")]
ROUTINE += [LogEvent.PROGRESS, LogEvent.RESOURCES_INFO, LogEvent.GROUP_INFO, LogEvent.GROUP_ERROR]
ROUTINE_TEXT = re.compile(
    r"Select jobs to execute\.\.\.$|exit status (1|130)\.$|"
    # of Slurm's plugin, for every entry of the queue:
    r"^Job \S+ has been submitted with SLURM jobid|^Trying to restart job |"
    r"^No SLURM account given|^No account was given|^Unable to guess SLURM account|"
    r"^Cleaning up SLURM log files"
)
SILENT = "it ended without a word"
# What workflow/scripts/job.py writes into a job's log first and last.
STARTED = re.compile(r": started as process \d+$", re.MULTILINE)
DONE = re.compile(r": done in [\d.]+ s$", re.MULTILINE)


class Study:
    """The runs of a study, of which some are `due` (their wildcards), and what becomes of them.

    `cores` is how many runs this machine carries out at once; None: others do, whatever they can.
    Snakemake tries `retries` times again what failed.
    """

    def __init__(
        self,
        runs: Iterable[Run],
        due: Iterable[tuple[str, str, str]],
        cores: int | None,
        retries: int = 0,
    ) -> None:
        self.runs = {run[:3]: run for run in runs}
        self.waiting = {key: self.runs[key] for key in due}
        self.begun: dict[Run, Pace] = {}  # or handed to a queue
        self.ended: dict[Run, str] = {}  # done, failed or interrupted
        self.cores, self.retries = cores, retries
        self.finished = {r: seconds for r in self.runs.values() if (seconds := r.seconds())}
        self.starts = [5.0]  # seconds of jobs beside the training; the first is a guess
        self.countdown = Countdown()
        self.without: list[str] | None = None

    def begins(self, run: Run) -> None:
        """Its job was started or handed to a queue."""
        self.waiting.pop(run[:3], None)
        self.ended.pop(run, None)
        self.begun[run] = Pace(stale=run.read(files.PROGRESS))

    def ends(self, run: Run, how: str) -> None:
        """Its job is done, failed or interrupted."""
        self.ended[run] = how
        pace = self.begun.pop(run)
        if how == "done" and (seconds := run.seconds()):
            self.finished[run] = seconds
            if self.cores:  # elsewhere, it may have waited in a queue
                self.starts.append(time.monotonic() - pace.begun - seconds)

    def table(self, now: float) -> Any:
        """How many runs are done, the time left, and a row for each run that trains."""
        from rich.console import Group
        from rich.table import Table

        told = {run: run.read(files.PROGRESS) for run in self.begun}
        for run, pace in self.begun.items():
            pace.add(told[run])
        known = {run: pace for run, pace in self.begun.items() if pace.readings}
        running = {run: pace for run, pace in known.items() if told[run]}
        waiting = [*(self.begun.keys() - known.keys()), *self.waiting.values()]
        heading = self.summary(len(running), len(known) - len(running))
        if not (running or waiting):
            return f"{heading}; tables and figures follow"
        cores = self.cores or len(running)
        left, without = seconds_left(self.finished, running, waiting, cores, fmean(self.starts))
        if without != self.without:  # it is the time left of other runs now
            self.countdown, self.without = Countdown(), without
        words = duration(self.countdown.show(left, now))
        heading += f"; about {words} left" if words else "; time left not known yet"
        if words and without:
            heading += f", without {' and '.join(without)}"
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for run, pace in running.items():
            row = {"environment": run.env, "variant": run.variant, "seed": run.seed} | pace.cells()
            for column in () if table.columns else row:
                text = column in ("environment", "variant")
                table.add_column(column, justify="left" if text else "right", no_wrap=True)
            table.add_row(*row.values())
        return Group(heading, table) if running else heading

    def summary(self, running: int = 0, trained: int = 0) -> str:
        """How many runs are done and how many are not; `trained` wait for the end of their job."""
        begun = "starting" if self.cores else "submitted"
        counts = {"running": running, "trained": trained}
        counts |= {begun: len(self.begun) - running - trained}
        counts |= {"waiting": len(self.waiting)} | Counter(self.ended.values())
        done = f"{counts.get('done', 0)} of {sum(counts.values())} runs done"
        rest = [f"{n} {what}" for what, n in counts.items() if n and what != "done"]
        return f"[{time.strftime('%H:%M:%S')}] {', '.join([done, *rest])}"


class LogHandler(LogHandlerBase):
    """Shows errors and what Snakemake says of the whole, and below it the runs that train."""

    # The filter is for what is shown: what becomes of a job has to be known in any case.
    writes_to_stream = has_filter = True
    writes_to_file = has_formatter = needs_rulegraph = False

    def __post_init__(self) -> None:
        from snakemake.logging import DefaultFilter

        settings = self.common_settings
        self.display = Display(sys.stdout if settings.stdout else sys.stderr, settings.nocolor)
        names = ("quiet", "debug_dag", "verbose", "dryrun", "printshellcmds")
        self.asked_for = DefaultFilter(**{name: getattr(settings, name) for name in names}).filter
        self.quiet = {choice.name for choice in settings.quiet or ()}
        self.study = Study([], [], None)
        self.jobs: dict[int, Any] = {}
        self.attempts: Counter[int] = Counter()  # of each job
        self.blamed: dict[int, str | None] = {}  # of jobs that shared an entry of a queue
        self.closed = threading.Event()
        self.refreshing = threading.Thread(target=self.refresh, daemon=True)

    def emit(self, record: LogRecord) -> None:
        """Take in what Snakemake says, and from workflow/rules/terminal.smk which study it is."""
        try:
            self.follow(record)
        except Exception:  # noqa: BLE001  (like every handler: what is shown stops no work)
            self.handleError(record)

    def follow(self, record: Any) -> None:
        """Keep account of the jobs and show what is of interest.

        record: a `LogRecord` with what Snakemake adds to it, of a job its `info`.
        """
        event = getattr(record, "event", None)
        if event == LogEvent.JOB_INFO:
            self.jobs[record.jobid] = record
            self.attempts[record.jobid] += 1
            if run := self.run_of(record):
                self.study.begins(run)
        elif event == LogEvent.GROUP_ERROR:
            members = [self.jobs[member["jobid"]] for member in record.job_error_info]
            self.blame(members, [Path(log) for log in record.aux_logs])
        elif event in (LogEvent.JOB_FINISHED, LogEvent.JOB_ERROR):
            job = self.jobs[record.jobid if event == LogEvent.JOB_ERROR else record.job_id]
            why = None
            if event == LogEvent.JOB_ERROR:
                entry = [Path(log) for log in record.log[len(job.log) :]]
                why = self.blamed.pop(job.jobid) if record.indent else reason(job, entry)
            if run := self.run_of(job):
                well = "done" if event == LogEvent.JOB_FINISHED else "interrupted"
                self.study.ends(run, "failed" if why else well)
            if why:
                self.complain(why + self.again([job]), [Path(log) for log in job.log])
        elif hasattr(record, "study"):
            self.study = record.study
            if self.study.waiting and not self.quiet & {"ALL", "PROGRESS", "RULES"}:
                self.refreshing.start()
        routine = event in ROUTINE or ROUTINE_TEXT.search(str(record.msg))
        if self.asked_for(record) and (self.common_settings.dryrun or not routine):
            colour = {"WARNING": "yellow", "ERROR": "red"}.get(record.levelname)
            gap = "\n" if event == LogEvent.JOB_INFO else ""
            self.display.print(gap + self.format(record), colour)

    def complain(self, text: str, logs: Iterable[Path]) -> None:
        """Say why something failed; with --show-failed-logs also what is in its `logs`."""
        if "ALL" in self.quiet:
            return
        self.display.print(text, "red")
        if self.common_settings.show_failed_logs:
            for log in filter(Path.exists, logs):
                self.display.print(f"{log}:\n{log.read_text(errors='replace').rstrip()}")

    def blame(self, jobs: list[Any], entry: list[Path]) -> None:
        """Find out which of `jobs` are why their entry of a queue failed, by its log and theirs."""
        word = slurms_word(entry)
        self.blamed = {job.jobid: None if word else own_reason(job) for job in jobs}
        if not any(self.blamed.values()):
            runs = f"{len(jobs)} runs in one entry of the queue" if jobs[1:] else name(jobs[0])
            self.complain(f"{runs} failed: {word or SILENT}{more(entry)}{self.again(jobs)}", entry)

    def again(self, jobs: list[Any]) -> str:
        """Whether Snakemake tries them again, in words."""
        attempts = max(self.attempts[job.jobid] for job in jobs)
        return "; tried again" if attempts <= self.study.retries else ""

    def run_of(self, job: Any) -> Run | None:
        """The run of the study that a job trains; None if it does something else."""
        return self.study.runs.get(tuple(job.wildcards.values()))

    def refresh(self) -> None:
        """Keep the table up to date.

        That takes a look into the folder of each run that was begun. Where there are thousands, in
        a cluster's queue and on a shared disk, it is done less often: a tenth of the time at most.
        """
        assert self.lock is not None  # every handler has one
        pause = 1.0
        while not self.closed.wait(pause):
            with self.lock:
                began = time.monotonic()
                self.display.show(self.study.table(began))
                pause = max(1.0, 9 * (time.monotonic() - began))

    def close(self) -> None:
        """Leave a line that says what was done."""
        self.closed.set()
        if self.refreshing.is_alive():
            self.refreshing.join()
            self.display.close()
            self.display.print(self.study.summary())
        super().close()


def reason(job: Any, entry: Sequence[Path] = ()) -> str | None:
    """Why a job failed, by its log or its `entry`'s in a queue; None if it was interrupted."""
    log = Path(job.log[0])
    for line in reversed(last_attempt(log).splitlines()):
        if line.endswith(": interrupted"):
            return None
        if " failed: " in line:
            return line.split(" ", 2)[2] + more([log])
    word = slurms_word(entry)
    return f"{name(job)} failed: {word or SILENT}{more(entry if word else [log])}"


def last_attempt(log: Path) -> str:
    """What the last process of a job wrote into its log, to which each of them appends."""
    text = log.read_text(errors="replace") if log.exists() else ""
    beginnings = list(STARTED.finditer(text))
    return text[beginnings[-1].start() :] if beginnings else text


def name(job: Any) -> str:
    """What a job is called."""
    return " ".join([job.rule_name, *job.wildcards.values()])


def own_reason(job: Any) -> str | None:
    """Why one of several jobs in an entry failed; None if it was done, or its turn never came."""
    log = Path(job.log[0])
    if not log.exists() or log.stat().st_mtime < job.created:  # it is of an earlier attempt
        return None
    return None if DONE.search(last_attempt(log)) else reason(job)


def slurms_word(entry: Iterable[Path]) -> str | None:
    """Why Slurm ended an entry of its queue, by the entry's log; None if it did not."""
    text = "".join(log.read_text(errors="replace") for log in entry if log.exists())
    if re.search("oom.kill", text, re.IGNORECASE):
        return "Slurm killed it, out of memory"
    found = re.search(r"\*\*\* JOB \d+ ON \S+ CANCELLED AT \S+ (.*)\*\*\*", text)
    return f"Slurm cancelled it {found[1].lower()}".strip() if found else None


def more(logs: Iterable[Path]) -> str:
    """Where there is more."""
    return "".join(f" (more in {log})" for log in logs)
