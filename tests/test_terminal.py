"""What the terminal shows of a study, from Snakemake's messages."""

import io
import json
import logging
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from invented import FULL, A, B, C, reading, some_run
from rich.console import Console
from snakemake.settings.enums import Quietness
from snakemake_interface_logger_plugins.common import LogEvent

from snakemake_logger_plugin_mace_rl import LogHandler, Study


def handler_with(
    monkeypatch: pytest.MonkeyPatch, terminal: bool = False, **given: object
) -> LogHandler:
    """What Snakemake hands its messages to; it writes into a string."""
    monkeypatch.setattr(sys, "stderr", stream := io.StringIO())
    stream.isatty = lambda: terminal
    options = dict.fromkeys(("stdout", "dryrun", "debug_dag", "verbose", "printshellcmds"), False)
    options |= {"quiet": None, "nocolor": False, "show_failed_logs": False}
    return LogHandler(SimpleNamespace(**options | given), None)


@pytest.fixture
def handler(monkeypatch: pytest.MonkeyPatch) -> LogHandler:
    return handler_with(monkeypatch)


def tell(handler: LogHandler, message: str = "", level: int = logging.INFO, **extra) -> None:
    record = logging.LogRecord("snakemake", level, "", 0, message, None, None)
    vars(record).update(extra)
    handler.handle(record)


def begin(handler: LogHandler, job: int, *wildcards: str, rule: str = "train", log="none") -> None:
    names = dict(zip(("env", "variant", "seed"), wildcards, strict=False))
    said = {"jobid": job, "rule_name": rule, "wildcards": names, "log": [str(log)]}
    tell(handler, event=LogEvent.JOB_INFO, **said)


def fail(handler: LogHandler, *jobs: int, entry: Path | None = None) -> None:
    """A job ends badly, or several that were an entry of a queue; `entry` is the entry's log."""
    logs = [str(entry)] if entry else []
    if len(jobs) > 1:
        said = {"aux_logs": logs, "job_error_info": [{"jobid": job} for job in jobs]}
        tell(handler, "Error in group", logging.ERROR, event=LogEvent.GROUP_ERROR, **said)
    for job in jobs:
        said = {"jobid": job, "log": handler.jobs[job].log + (logs if len(jobs) == 1 else [])}
        said["indent"] = len(jobs) > 1
        tell(handler, "Twenty lines", logging.ERROR, event=LogEvent.JOB_ERROR, **said)


def shown(study: Study) -> list[str]:
    console = Console(file=io.StringIO(), width=100)
    console.print(study.table(0.0))
    return [" ".join(line.split()[1:]) for line in console.file.getvalue().splitlines()]


def test_what_a_study_shows(tmp_path: Path, handler: LogHandler) -> None:
    runs = [some_run(seed)._replace(folder=str(tmp_path / f"{seed}")) for seed in range(5)]
    told = [tmp_path / f"{seed}" / "progress.json" for seed in range(5)]
    done = [tmp_path / f"{seed}" / "run.json" for seed in range(5)]
    for path, stale in zip(told, ["[", json.dumps(reading(99, 99.0)), "{}", "", ""], strict=True):
        path.parent.mkdir()
        path.write_text(stale)
    for path, content in zip(done, ["{", "[]", "{}", '{"config": 3}'], strict=False):
        path.write_text(content)
    record = {"seconds": 90.0, "start_seconds": 30.0, "config": {"episodes": 100}}
    done[4].write_text(json.dumps(record))  # not due
    study = Study(runs, [run[:3] for run in runs[:4]], cores=2)
    assert shown(study) == ["0 of 4 runs done, 4 waiting; about 2 min 10 s left"]
    tell(handler, "4 runs", study=study)
    begin(handler, 0, *runs[0][:3])
    begin(handler, 1, *runs[1][:3])
    assert shown(study)[0].startswith("0 of 4 runs done, 2 starting, 2 waiting; about")
    told[1].write_text(json.dumps(reading(1, 30.0)))
    shown(study)
    told[1].write_text(json.dumps(reading(50, 60.0, start=30.0)))
    heading, names, row = shown(study)
    assert heading.startswith("0 of 4 runs done, 1 running, 1 starting, 2 waiting; about")
    assert names == "variant seed episode return β steps/s left"
    assert row == "ppo 1 50/100 21.5 0.25 33 40 s"
    done[1].write_text(json.dumps(record | {"seconds": 100.0}))
    tell(handler, event=LogEvent.JOB_FINISHED, job_id=1)
    assert study.finished == {runs[4]: 60.0, runs[1]: 70.0}
    log = tmp_path / "a.log"
    log.write_text("2026-01-01 12:00:00,000 training A failed: No: reason\nTraceback\nNo: reason\n")
    begin(handler, 2, *runs[2][:3], log=log)
    fail(handler, 2)
    fail(handler, 0)  # there is no log
    log.write_text("training A: interrupted\n")
    begin(handler, 3, *runs[3][:3], log=log)
    fail(handler, 3)
    begin(handler, 9, rule="metrics")
    tell(handler, event=LogEvent.JOB_FINISHED, job_id=9)
    ending = "1 of 4 runs done, 2 failed, 1 interrupted"
    assert shown(study) == [f"{ending}; tables and figures follow"]
    tell(handler, "RuleException: ... returned non-zero exit status 1.", logging.ERROR)
    tell(handler, "The disk is full", logging.ERROR)
    handler.close()
    *lines, last = handler.display.console.file.getvalue().splitlines()
    assert lines == [
        "4 runs",
        f"training A failed: No: reason (more in {log})",
        "train CartPole-v1 ppo 0 failed: it ended without a word (more in none)",
        "The disk is full",
    ]
    assert last.endswith(f"] {ending}")


def test_runs_on_other_machines(tmp_path: Path, handler: LogHandler) -> None:
    far = A._replace(folder=str(tmp_path))
    study = Study([far], [far[:3]], cores=None)
    tell(handler, study=study)
    begin(handler, 7, *far[:3])
    assert shown(study) == ["0 of 1 runs done, 1 submitted; time left not known yet"]
    (tmp_path / "progress.json").write_text(json.dumps(reading(40, 60.0)))
    assert shown(study)[0] == "0 of 1 runs done, 1 running; time left not known yet"
    (tmp_path / "progress.json").unlink()  # while others of its entry in the queue go on
    assert shown(study)[0].startswith("0 of 1 runs done, 1 trained")
    handler.close()


@pytest.mark.parametrize(("cores", "expected"), [(2, [5.0, 40.0]), (None, [5.0])])
def test_the_time_beside_the_training_is_known_where_jobs_do_not_wait_in_a_queue(
    tmp_path: Path, cores: int | None, expected: list[float]
) -> None:
    one = A._replace(folder=str(tmp_path))
    study = Study([one], [one[:3]], cores)
    study.begins(one)
    study.begun[one].begun -= 100  # seconds ago
    record = {"seconds": 70.0, "start_seconds": 10.0, "config": {"episodes": 100}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    study.ends(one, "done")
    assert study.finished == {one: 60.0}
    assert study.starts == pytest.approx(expected, abs=1)


def test_environments_without_a_finished_run_are_left_out_of_the_time_left(tmp_path: Path) -> None:
    done, same = (some_run(seed)._replace(folder=str(tmp_path / f"{seed}")) for seed in (0, 1))
    other = some_run(0, env="Hopper")
    (tmp_path / "0").mkdir()
    record = {"seconds": 90.0, "start_seconds": 30.0, "config": {"episodes": 100}}
    (tmp_path / "0/run.json").write_text(json.dumps(record))
    study = Study([done, same, other], [same[:3], other[:3]], cores=1)
    assert shown(study) == ["0 of 2 runs done, 2 waiting; about 1 min 10 s left, without Hopper"]
    del study.waiting[other[:3]]
    assert shown(study) == ["0 of 1 runs done, 1 waiting; about 1 min 10 s left"]


TIME_LIMIT = "slurmstepd: error: *** JOB 8 ON n1 CANCELLED AT 2026-01-01T12:00:00 DUE TO TIME LIMIT"


@pytest.mark.parametrize(
    ("entry", "word"),
    [
        (
            f"{TIME_LIMIT} ***\nsrun: forcing job termination\n",
            "Slurm cancelled it due to time limit",
        ),
        ("error: *** JOB 8 ON n1 CANCELLED AT 2026-01-01T12:00:00 ***\n", "Slurm cancelled it"),
        ("error: Detected 1 oom_kill event in StepId=8.0.\n", "Slurm killed it, out of memory"),
        ("At least one job did not complete successfully.\n", "it ended without a word"),
    ],
)
def test_why_slurm_ended_an_entry_and_that_it_is_tried_again(
    tmp_path: Path, handler: LogHandler, entry: str, word: str
) -> None:
    study = Study([A, B], [A[:3], B[:3]], cores=None, retries=1)
    tell(handler, "2 runs", study=study)
    file = tmp_path / "8.log"
    file.write_text(entry)
    one, two = "train CartPole-v1 ppo 0 failed: ", "2 runs in one entry of the queue failed: "
    for attempt in range(2):
        for number, run in enumerate((A, B)):
            begin(handler, number, *run[:3], log=tmp_path / "none")
        tell(handler, f"Job {attempt} has been submitted with SLURM jobid 8 (log: {file}).")
        assert shown(study) == ["0 of 2 runs done, 2 submitted; time left not known yet"]
        fail(handler, 0, 1, entry=file)
        tell(handler, "Trying to restart job 5-7-9.")
    begin(handler, 0, *A[:3], log=tmp_path / "none")
    fail(handler, 0, entry=file)
    handler.close()
    lines = handler.display.console.file.getvalue().splitlines()
    where = tmp_path / "none" if word == "it ended without a word" else file
    assert lines[1:-1] == [
        f"{two}{word} (more in {file}); tried again",
        f"{two}{word} (more in {file})",
        f"{one}{word} (more in {where})",
    ]
    assert lines[-1].endswith("0 of 2 runs done, 1 interrupted, 1 failed")


def test_which_run_of_an_entry_is_why_it_failed(tmp_path: Path, handler: LogHandler) -> None:
    """Not those that were done, whose turn did not come, or that failed in an earlier attempt."""
    runs = [A, B, C, FULL]
    logs = [tmp_path / name for name in ("earlier", "done", "none", "now")]
    logs[0].write_text("2026-01-01 12:00:00,000 training A failed: long ago\n")
    os.utime(logs[0], (1, 1))
    tell(handler, "4 runs", study=Study(runs, [run[:3] for run in runs], cores=None))
    for number, run in enumerate(runs):
        begin(handler, number, *run[:3], log=logs[number])
    logs[1].write_text("2026-01-01 12:00:00,000 training B: done in 7.0 s\n")
    logs[3].write_text("2026-01-01 12:00:00,000 training full failed: a NaN\n")
    fail(handler, *range(4), entry=tmp_path / "no entry.log")
    handler.close()
    lines = handler.display.console.file.getvalue().splitlines()
    assert lines[1] == f"training full failed: a NaN (more in {logs[3]})"
    assert lines[2].endswith("0 of 4 runs done, 3 interrupted, 1 failed")


STARTED = "2026-01-01 12:00:00,000 training A: started as process 7\n"
FAILED = "2026-01-01 12:00:01,000 training A failed: No: reason\n"
KILLED = "train CartPole-v1 ppo 0 failed: it ended without a word (more in {log})"


@pytest.mark.parametrize(
    ("text", "expected", "ending"),
    [
        (STARTED + "training A: interrupted\n" + STARTED, KILLED, "1 failed"),
        (STARTED + FAILED + STARTED, KILLED, "1 failed"),
        (STARTED + "2026-01-01 training A: done in 5.0 s\n" + STARTED, KILLED, "1 failed"),
        (STARTED + "training A: interrupted\n", "", "1 interrupted"),
        (STARTED + FAILED, "training A failed: No: reason (more in {log})", "1 failed"),
    ],
)
def test_only_the_last_attempt_says_why_a_job_failed(
    tmp_path: Path, handler: LogHandler, text: str, expected: str, ending: str
) -> None:
    log = tmp_path / "a.log"
    tell(handler, study=Study([A], [A[:3]], cores=1))
    begin(handler, 0, *A[:3], log=log)
    log.write_text(text)
    fail(handler, 0)
    said = handler.display.console.file.getvalue().strip()
    assert said == expected.format(log=log)
    assert handler.study.summary().endswith(f"0 of 1 runs done, {ending}")
    handler.close()


def test_a_run_that_failed_again_after_it_was_once_done_is_to_blame(
    tmp_path: Path, handler: LogHandler
) -> None:
    """As where the study is trained anew, in logs that go on."""
    logs = [tmp_path / "A", tmp_path / "B"]
    tell(handler, study=Study([A, B], [A[:3], B[:3]], cores=None))
    for number, run in enumerate((A, B)):
        begin(handler, number, *run[:3], log=logs[number])
    done = "2026-01-01 12:00:00,000 training: done in 7.0 s\n"
    logs[0].write_text(STARTED + done + STARTED + FAILED)
    logs[1].write_text(STARTED + FAILED + STARTED + done)
    fail(handler, 0, 1, entry=tmp_path / "no entry.log")
    handler.close()
    blamed, _ = filter(None, handler.display.console.file.getvalue().splitlines())
    assert blamed == f"training A failed: No: reason (more in {logs[0]})"


@pytest.mark.parametrize("quiet", [["RULES"], ["PROGRESS", "RULES"], ["PROGRESS"], ["ALL"]])
def test_what_fails_is_said_unless_nothing_is_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quiet: list[str]
) -> None:
    handler = handler_with(monkeypatch, quiet={Quietness[name] for name in quiet})
    log = tmp_path / "metrics.log"
    log.write_text(FAILED)
    tell(handler, "3 runs", study=Study([A], [A[:3]], cores=1), quietness=Quietness.PROGRESS)
    for number, rule in enumerate(("table1", "metrics")):
        begin(handler, number, rule=rule, log=log)
    tell(handler, event=LogEvent.JOB_FINISHED, job_id=0)
    fail(handler, 1)
    tell(handler, "The disk is full", logging.ERROR)
    handler.close()
    lines = handler.display.console.file.getvalue().splitlines()
    expected = [f"training A failed: No: reason (more in {log})", "The disk is full"]
    if "PROGRESS" not in quiet:
        expected.insert(0, "3 runs")
    assert lines == ([] if "ALL" in quiet else expected)


def test_what_is_tried_again_is_any_job(tmp_path: Path, handler: LogHandler) -> None:
    tell(handler, study=Study([A], [A[:3]], cores=1, retries=1))
    for _ in range(2):
        begin(handler, 3, rule="metrics", log=tmp_path / "none")
        fail(handler, 3)
    handler.close()
    _, first, second, _ = handler.display.console.file.getvalue().splitlines()
    assert first == second + "; tried again" and first.startswith("metrics failed: it ended")


def test_logs_are_shown_where_that_is_asked_for_and_colours_are_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "metrics.log"
    log.write_text(STARTED + FAILED)
    monkeypatch.setenv("TERM", "xterm")
    for nocolor in (False, True):
        handler = handler_with(monkeypatch, True, nocolor=nocolor, show_failed_logs=True)
        begin(handler, 0, rule="metrics", log=log)
        fail(handler, 0)
        handler.close()
        said = handler.display.console.file.getvalue()
        assert f"{log}:\n{STARTED}{FAILED}" in said
        assert ("\x1b[31m" in said) != nocolor
