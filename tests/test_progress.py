"""The progress report, from fabricated run folders and with expected values by hand."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mace_rl import progress
from mace_rl.progress import Progress, Run, Status, Watch, duration, seconds_left

NOW = 1_000_000.0
ALIVE, DEAD = 11, 22  # process numbers


def make_run(
    folder: Path,
    env: str = "CartPole-v1",
    variant: str = "ppo",
    seed: int = 0,
    episodes: int = 100,
    due: bool = True,
) -> Run:
    directory = folder / env / variant / f"seed{seed}"
    directory.mkdir(parents=True)
    return Run(env, variant, seed, episodes, str(directory), due)


def made(episode: int, seconds: float, episodes: int = 100, **changes: float) -> Progress:
    values = {"recent_return": 21.5, "steps_per_second": 1000.0, "time": NOW, "pid": ALIVE}
    return Progress(episode=episode, episodes=episodes, seconds=seconds, **(values | changes))


def write_progress(run: Run, found: Progress) -> None:
    # Training writes one key more than the report reads.
    content = vars(found) | {"env_steps": 12}
    Path(run.directory, "progress.json").write_text(json.dumps(content))


def write_record(run: Run, seconds: float) -> None:
    content = {"seconds": seconds, "config": {"episodes": run.episodes}, "versions": {}}
    Path(run.directory, "run.json").write_text(json.dumps(content))


def watch(*runs: Run, local: bool = True) -> Watch:
    return Watch(runs, local=local, started=NOW - 50, alive=lambda pid: pid == ALIVE)


def test_states_of_runs(tmp_path: Path) -> None:
    done, running, waiting = (make_run(tmp_path, seed=seed) for seed in range(3))
    other = make_run(tmp_path, seed=3, due=False)
    write_record(other, 5.0)
    watcher = watch(done, running, waiting, other)
    assert watcher.status(NOW) == Status([], {}, [], [done, running, waiting])
    write_progress(done, made(50, 1.0))
    write_progress(running, made(50, 1.0))
    assert set(watcher.status(NOW).running) == {done, running}
    write_record(done, 2.0)
    Path(done.directory, "progress.json").unlink()
    assert watcher.status(NOW) == Status([done], {running: made(50, 1.0)}, [], [waiting])


def test_record_of_an_earlier_training_is_not_done(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    write_record(run, 30.0)
    watcher = watch(run)
    assert watcher.status(NOW).waiting == [run]
    assert watcher.rates() == {("CartPole-v1", "ppo"): 0.3}  # but it says how long one takes
    record = Path(run.directory, "run.json")
    record.unlink()  # as Snakemake does when it starts the job
    assert watcher.status(NOW).waiting == [run]
    write_record(run, 20.0)
    os.utime(record, ns=(1, 1))  # certainly another time than before
    assert watcher.status(NOW).done == [run]
    assert watcher.rates() == {("CartPole-v1", "ppo"): 0.2}


def test_left_behind_progress_is_not_running(tmp_path: Path) -> None:
    killed, before, silent = (make_run(tmp_path, seed=seed) for seed in range(3))
    write_progress(killed, made(50, 1.0, pid=DEAD, time=NOW - 49))
    write_progress(before, made(50, 1.0, pid=DEAD, time=NOW - 51))  # before this workflow started
    write_progress(silent, made(50, 1.0, time=NOW - 121))
    assert watch(killed, before, silent).status(NOW) == Status([], {}, [killed], [before, silent])


def test_process_numbers_of_other_machines_mean_nothing(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    write_progress(run, made(50, 1.0, pid=DEAD, time=NOW - 119))
    assert list(watch(run, local=False).status(NOW).running) == [run]
    assert watch(run, local=False).status(NOW + 2).waiting == [run]


@pytest.mark.parametrize("content", [b"", b'{"episode": 5', b"[]", b"3", b"{}", b"\xff", b"null"])
def test_unreadable_files_are_not_there_yet(tmp_path: Path, content: bytes) -> None:
    run = make_run(tmp_path)
    Path(run.directory, "progress.json").write_bytes(content)
    assert watch(run).status(NOW).waiting == [run]
    Path(run.directory, "run.json").write_bytes(content)
    assert watch(run).rates() == {}


GROUP = ("CartPole-v1", "ppo")


def test_time_left_of_waiting_runs(tmp_path: Path) -> None:
    # 0.3 s an episode: 30 s each and 5 s to start, on two cores.
    runs = [make_run(tmp_path, seed=seed) for seed in range(3)]
    status = Status([], {}, [], runs)
    assert seconds_left(status, {GROUP: 0.3}, cores=2) == 70.0
    assert seconds_left(status, {GROUP: 0.3}, cores=1) == 105.0
    assert seconds_left(status, {GROUP: 0.3}, cores=3) == 35.0


def test_longest_runs_first(tmp_path: Path) -> None:
    # 100, 60, 50 s: [100 + 5] beside [60 + 5, 50 + 5]; shortest first, it would be 160 + 10.
    runs = [make_run(tmp_path, variant=str(number), episodes=number) for number in (50, 100, 60)]
    rates = {run.group: 1.0 for run in runs}
    assert seconds_left(Status([], {}, [], runs), rates, cores=2) == 120.0


def test_time_left_of_running_runs(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    # By itself: 20 of 100 episodes in 10 s, so 40 s more.
    assert seconds_left(Status([], {run: made(20, 10.0)}, [], []), {}, cores=2) == 40.0
    # Others took 100 s: a fifth of 50 s and four fifths of 100 s make 90 s, of which 10 are over.
    status = Status([], {run: made(20, 10.0)}, [], [])
    assert seconds_left(status, {GROUP: 1.0}, cores=2) == pytest.approx(80.0)
    # Slower than expected, it is over soon and not before now.
    status = Status([], {run: made(0, 200.0)}, [], [])
    assert seconds_left(status, {GROUP: 1.0}, cores=2) == 0.0


def test_waiting_runs_follow_running_ones(tmp_path: Path) -> None:
    first, second = make_run(tmp_path), make_run(tmp_path, seed=1)
    # 60 s and 90 s more on two cores; then 100 s and 5 s to start on the first of them.
    progress = {first: made(40, 40.0), second: made(10, 10.0)}
    third = make_run(tmp_path, seed=2)
    assert seconds_left(Status([], progress, [], [third]), {}, cores=2) == pytest.approx(165.0)


def test_groups_without_runs_borrow(tmp_path: Path) -> None:
    acrobot = make_run(tmp_path, env="Acrobot-v1", episodes=200)
    full = make_run(tmp_path, variant="mace_full", episodes=10)
    rates = {GROUP: 1.0, ("CartPole-v1", "mace_fixed"): 3.0, ("Hopper", "ppo"): 5.0}
    # The same environment: (1 + 3) / 2 s an episode.
    assert seconds_left(Status([], {}, [], [full]), rates, cores=1) == 25.0
    # All environments: (1 + 3 + 5) / 3 s an episode.
    assert seconds_left(Status([], {}, [], [acrobot]), rates, cores=1) == 605.0


def test_time_left_without_evidence(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    assert seconds_left(Status([], {}, [], [run]), {}, cores=2) is None
    assert seconds_left(Status([], {run: made(0, 0.1)}, [], []), {}, cores=2) is None
    assert seconds_left(Status([run], {}, [], []), {}, cores=2) == 0.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "less than a minute"),
        (59.9, "less than a minute"),
        (61, "about 1 min"),
        (59.4 * 60, "about 59 min"),
        (59.6 * 60, "about 1 h 00 min"),
        (3 * 3600 + 20 * 60 + 10, "about 3 h 20 min"),
        (26 * 3600, "about 1 d 2 h"),
    ],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_report(tmp_path: Path) -> None:
    runs = [make_run(tmp_path, seed=seed) for seed in range(4)]
    hopper = make_run(tmp_path, "HopperBulletEnv-v0", "mace_full", 12, 6000)
    running = {
        hopper: made(1204, 900.0, 6000, recent_return=-612.34, steps_per_second=1830.4),
        runs[0]: made(80, 9.0, recent_return=480.1, steps_per_second=11230.0),
    }
    lines = progress.report(Status(runs[1:2], running, runs[2:3], runs[3:]), 12000.0, NOW).split(
        "\n"
    )
    assert lines[0].endswith(
        "] 1 of 5 runs done, 2 running, 1 stopped, 1 waiting; about 3 h 20 min left"
    )
    assert [" ".join(line.split()) for line in lines[1:]] == [
        "HopperBulletEnv-v0 mace_full seed 12 episode 1204/6000 return -612.3 1830 steps/s",
        "CartPole-v1 ppo seed 0 episode 80/100 return 480.1 11230 steps/s",
    ]
    columns = [[line.index(word) for word in ("seed", "episode", "return")] for line in lines[1:]]
    assert columns[0] == columns[1]
    assert "not known yet" in progress.report(Status([], {}, [], runs), None, NOW)


def test_monitor_ends_when_all_is_done_or_its_parent_is_gone(tmp_path: Path) -> None:
    run = make_run(tmp_path, due=False)
    code = (
        "import sys; from mace_rl import progress; from mace_rl.progress import Run;"
        f"monitor = progress.start([{run!r}], 2, True); progress.stop(monitor)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.endswith("] 0 of 0 runs done\n")
    # The parent dies without a word: the pipe that the monitor listens to is closed all the same.
    due = make_run(tmp_path, seed=1)
    code = code.replace(repr(run), repr(due)).replace(
        "progress.stop(monitor)", "import os; os._exit(9)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stderr.endswith("] 0 of 1 runs done, 1 waiting\n")
