"""Progress and time left: by hand, against recorded trainings, and from Snakemake's messages."""

import io
import json
import logging
import math
import os
import subprocess
import sys
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from snakemake_interface_logger_plugins.common import LogEvent

from mace_rl.runs import progress
from mace_rl.runs.progress import Countdown, Pace, Run, duration, seconds_left
from snakemake_logger_plugin_mace_rl import LogHandler, Study

nan = math.nan


def reading(episode: int, seconds: float, start: float = 0.0, episodes: int = 100) -> dict:
    """What a run tells."""
    told = {"env_steps": 20 * episode, "recent_return": 21.5, "beta": 0.25, "pid": 1}
    told |= {"seconds": seconds, "start_seconds": start}
    return {"episode": episode, "episodes": episodes} | told


def paced(*readings: tuple[int, float]) -> Pace:
    pace = Pace()
    for episode, seconds in readings:
        pace.add(reading(episode, seconds))
    return pace


def test_a_pace_is_that_of_the_last_quarter_so_far() -> None:
    pace = paced((1, 30.0))  # with the compilation
    assert math.isnan(pace.speed("episode")) and math.isnan(pace.left())
    pace.add(reading(21, 40.0))
    assert pace.speed("episode") == 2.0 and pace.speed("env_steps") == 40.0
    assert math.isnan(pace.left())  # too early
    pace.add(reading(41, 50.0))
    assert pace.left() == (100 - 41) / 2.0
    pace.add(reading(61, 60.0))
    pace.add(reading(85, 66.0, start=36.0))
    assert pace.speed("episode") == 24 / 6 and pace.seconds == 30.0
    assert list(pace.cells().values()) == ["85/100", "21.5", "0.25", "80", "10 s"]
    pace.add(reading(61, 70.0))  # it began again from a checkpoint
    assert math.isnan(pace.left())
    pace.add(reading(71, 80.0))
    assert pace.left() == 29.0


def run(seed: int, variant: str = "ppo", env: str = "CartPole-v1", work: float = 1.0) -> Run:
    return Run(env, variant, str(seed), 100, work, "")


A, B, C = (run(seed) for seed in range(3))
FULL = run(1, "mace_full", work=3.0)


@pytest.mark.parametrize(
    ("finished", "running", "waiting", "cores", "expected"),
    [
        ({A: 30}, {}, [B, C], 2, 35),  # 30 s each and 5 s to start
        ({A: 30}, {}, [B, C], 1, 70),
        ({A: 20, B: 40}, {}, [C], 1, 35),
        ({A: 30}, {}, [FULL], 1, 95),  # of another variant: by work
        ({A: 30, FULL: 60}, {}, [run(2, "mace_full", work=3.0)], 1, 65),  # of its own
        # The longest first: [100 + 5] beside [60 + 5, 50 + 5].
        ({A: 1}, {}, [run(n, work=n) for n in (50, 100, 60)], 2, 120),
        # By itself: 20 episodes took 10 s. As others: 80 s. A fifth of that is over.
        ({}, {A: paced((20, 10.0), (40, 20.0))}, [], 2, 30),
        ({B: 100}, {A: paced((20, 10.0), (40, 20.0))}, [], 2, 0.2 * 30 + 0.8 * 80),
        ({B: 100}, {A: paced((10, 10.0))}, [], 2, 90),
        ({B: 100}, {A: paced((10, 120.0))}, [], 2, 0),
        ({B: 100}, {A: paced((10, 40.0))}, [C], 1, 60 + 105),
        ({B: 100}, {A: paced((10, 40.0))}, [C], 2, 105),
        ({}, {}, [], 2, nan),
        ({}, {A: paced((10, 10.0))}, [], 2, nan),
        ({}, {A: paced((20, 10.0), (40, 20.0))}, [B], 2, nan),
        ({run(0, env="Acrobot-v1"): 9}, {}, [A], 2, nan),
    ],
)
def test_seconds_left_by_hand(finished, running, waiting, cores, expected) -> None:
    seconds, without = seconds_left(finished, running, waiting, cores, start=5.0)
    assert seconds == pytest.approx(expected, nan_ok=True)
    assert without == (["CartPole-v1"] if math.isnan(expected) and (running or waiting) else [])


def test_environments_that_nothing_is_known_of_are_left_out() -> None:
    waiting = [B, run(0, env="Hopper"), run(0, env="Acrobot-v1")]
    assert seconds_left({A: 30}, {}, waiting, 2, 5.0) == (35, ["Acrobot-v1", "Hopper"])


# The part of its steps that a recorded training had done after these parts of its episodes: at the
# paper's budgets; Hopper's at a twelfth of it, where episodes grow to the very end.
EPISODES = [0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1]
STEPS = {
    "Hopper": [0, 0.002, 0.007, 0.015, 0.031, 0.048, 0.121, 0.315, 1],
    "CartPole-v1": [0, 0.001, 0.009, 0.039, 0.141, 0.248, 0.463, 0.733, 1],
    "Acrobot-v1": [0, 0.097, 0.154, 0.225, 0.330, 0.418, 0.586, 0.791, 1],
}


class Training:
    """One that takes so many seconds, and 20 more if the first episode has to compile its code."""

    def __init__(self, run: Run, seconds: float, compiles: bool) -> None:
        parts = np.interp(np.arange(run.episodes + 1) / run.episodes, EPISODES, STEPS[run.env])
        self.run = run
        self.start = 20.0 * compiles
        self.ends = seconds * parts + self.start  # of its episodes
        self.total = float(self.ends[-1])

    def reading(self, seconds: float) -> dict | None:
        """What it tells, every two seconds."""
        done = int(np.searchsorted(self.ends[1:], seconds // 2 * 2, side="right"))
        now = float(self.ends[done])
        return reading(done, now, self.start, self.run.episodes) if done else None


@pytest.mark.parametrize("env", ["CartPole-v1", "Acrobot-v1"])
def test_time_left_of_one_recorded_run(env: str) -> None:
    training = Training(Run(env, "ppo", "0", 2000, 1.0, ""), 60.0, compiles=True)
    pace, countdown, factors = Pace(), Countdown(), []
    for now in np.arange(0, training.total - 5, 0.5):
        pace.add(training.reading(now))
        left = countdown.show(pace.left() if pace.readings else nan, now)
        factors.append(left / (training.total - now))
    assert np.isfinite(factors).mean() > 0.3
    assert np.nanmin(factors) > 0.7 and np.nanmax(factors) < 1.3


@pytest.mark.parametrize("seed", range(3))
def test_time_left_of_a_study_of_recorded_runs(seed: int) -> None:
    """Within a factor of 2 of the truth for nine tenths of the time that it is shown, of 4 always.

    And it moves by 10 % a second at most. Seeds differ twofold; Hopper's last episodes are longest.
    """
    random = np.random.default_rng(seed)
    budgets = {"Hopper": (500, 90.0), "CartPole-v1": (2000, 60.0), "Acrobot-v1": (2000, 30.0)}
    variants = {"mace_full": (2.0, 2.4), "mace_fixed": (2.0, 1.6), "ppo": (1.0, 1.0)}
    queue = [
        Training(
            Run(env, variant, str(seed), budgets[env][0], variants[variant][0], ""),
            budgets[env][1] * variants[variant][1] * random.uniform(0.7, 1.4),
            compiles=seed == 0,
        )
        for env, variant, seed in product(budgets, variants, range(3))
    ]
    start, starts, begun, finished, factors, moves = 6.0, [5.0], {}, {}, [], []
    without, last = None, nan
    for now in range(10_000):
        for training, (time, pace) in list(begun.items()):
            pace.add(training.reading(now - time - start))
            if now >= time + start + training.total:
                finished[training.run] = training.total - training.start
                starts.append(start + training.start)
                del begun[training]
        while queue and len(begun) < 2:
            begun[queue.pop(0)] = now, Pace()
        if not begun:
            break
        running = {training.run: pace for training, (_, pace) in begun.items() if pace.readings}
        waiting = [t.run for t in [*begun, *queue] if t.run not in running]
        before = without
        estimate, without = seconds_left(finished, running, waiting, 2, np.mean(starts))
        if without != before:
            countdown, last = Countdown(), nan
        shown = countdown.show(estimate, now)
        if last > 20:
            moves.append(shown / (last - 1))
        last = shown
        ends = [
            time + start + t.total for t, (time, _) in begun.items() if t.run.env not in without
        ]
        ends += [now] * (2 - len(ends))
        for training in queue:
            if training.run.env not in without:
                ends[ends.index(min(ends))] += start + training.total
        if max(ends) - now > 20:
            factors.append(shown / (max(ends) - now))
    factors = np.array(factors)[np.isfinite(factors)]
    assert len(factors) > 0.6 * now and min(factors) > 1 / 4 and max(factors) < 4
    assert ((factors > 1 / 2) & (factors < 2)).mean() > 0.9
    assert np.nanmin(moves) > 0.9 and np.nanmax(moves) < 1.1


def test_a_countdown_ticks_and_follows_slowly() -> None:
    countdown = Countdown()
    assert math.isnan(countdown.show(nan, 0.0))
    assert countdown.show(100.0, 7.0) == 100.0
    assert countdown.show(90.0, 17.0) == pytest.approx(90.0)
    assert 89.0 < countdown.show(400.0, 18.0) < 110.0
    assert countdown.show(400.0, 118.0) > 350.0
    assert math.isnan(countdown.show(nan, 119.0))


def test_durations_in_words() -> None:
    seconds = [nan, 0, 41, 59.9, 570, 10.4 * 60, 59.6 * 60, 3 * 3600 + 1210]
    words = ["", "10 s", "50 s", "1 min 00 s", "9 min 30 s", "10 min", "1 h 00 min", "3 h 20 min"]
    assert [duration(value) for value in seconds] == words


def test_in_place_on_a_terminal_and_seldom_in_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setenv("TERM", "xterm")
    file, terminal = io.StringIO(), io.StringIO()
    terminal.isatty = lambda: True
    for stream in (file, terminal):
        now[0] = 0.0
        with progress.line(stream) as show:
            for second in range(61):
                now[0] = float(second)
                show(reading(second + 1, second))
    first, second = file.getvalue().splitlines()
    assert first == "episode 6/100   return 21.5   β 0.25   steps/s 20"
    assert second == "episode 36/100   return 21.5   β 0.25   steps/s 20   left 1 min 10 s"
    assert all(f"episode {number}/100" in terminal.getvalue() for number in range(1, 62))


@pytest.fixture
def handler(monkeypatch: pytest.MonkeyPatch) -> LogHandler:
    """What Snakemake hands its messages to; it writes into a string."""
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    return LogHandler(SimpleNamespace(stdout=False, dryrun=False, quiet=None), None)


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
    runs = [run(seed)._replace(folder=str(tmp_path / f"{seed}")) for seed in range(5)]
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


@pytest.mark.slow
def test_jobs_do_without_what_draws() -> None:
    code = "import sys, mace_rl.runs.run, mace_rl.runs.progress; sys.exit('rich' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
