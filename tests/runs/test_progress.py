"""`mace-rl status`, by hand: which run is where, and when the last one will be done."""

import fcntl
import io
import json
import math
import os
from pathlib import Path

import pytest

from mace_rl.config.section import ConfigError
from mace_rl.runs import progress
from mace_rl.runs.progress import Planned, Run, seconds_left, status

nan = math.nan


def told(episode: int, seconds: float, left: float = 60.0, start: float = 30.0) -> dict:
    said = {"episode": episode, "episodes": 100, "recent_return": 21.5, "beta": 0.25}
    said |= {"steps_per_second": 1830.4, "left": left}
    return said | {"seconds": seconds, "start_seconds": start}


class Folder:
    """A results folder whose workflow began just now."""

    def __init__(self, results: Path, cores: int | None) -> None:
        self.results, self.plan, self.locks = results, {"cores": cores, "runs": []}, []

    def add(self, env: str = "A", work: float = 1.0, due: bool = True, old: tuple = (), **said):
        """One more run: its `record`, what it has `told`, whether it is at work (`held`)."""
        seed = len(self.plan["runs"])
        planned = {"env": env, "variant": "ppo", "seed": seed, "work": work, "due": due}
        self.plan["runs"].append(planned)
        folder = self.results / "runs" / env / "ppo" / f"seed{seed}"
        folder.mkdir(parents=True)
        for name, key in {"run.json": "record", "progress.json": "told"}.items():
            if content := said.get(key):
                text = content if isinstance(content, str) else json.dumps(content)
                (folder / name).write_text(text)
                os.utime(folder / name, (1, 1) if key in old else None)
        if "held" in said:
            self.locks.append((folder / ".lock").open("w"))
            fcntl.flock(self.locks[-1], fcntl.LOCK_EX)

    def lines(self) -> list[str]:
        file = self.results / "logs" / "plan.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(self.plan))
        os.utime(file, (1000, 1000))
        return [" ".join(line.split()) for line in status(self.results)]


DONE = {"seconds": 130.0, "start_seconds": 30.0}


def test_the_table(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no run in it or below it is finished or has told"):
        status(tmp_path)
    folder = Folder(tmp_path, cores=2)
    folder.add(record=DONE, due=False, old=("record",))  # by an earlier workflow
    folder.add(record=DONE)
    folder.add(record=DONE, told=told(50, 60.0), old=("record",), held=True)  # trained anew
    folder.add(told=told(90, 60.0), old=("told",), held=True)  # it has not begun to tell
    folder.add(told=told(90, 60.0))  # killed, or failed
    folder.add(told="{", record="[")  # being written
    heading, names, *rows = folder.lines()
    assert heading == "2 of 6 runs done, 2 running, 1 waiting, 1 stopped; about 3 min left"
    assert names == "environment variant seed episode return β steps/s left"
    assert rows == [
        "A ppo 2 50/100 21.5 0.25 1830 60 s",
        "A ppo 3 starting",
        "A ppo 4 90/100 21.5 0.25 1830 stopped",
    ]


def test_runs_without_a_workflow(tmp_path: Path) -> None:
    folder, named = Folder(tmp_path, cores=None), {"environment": "E", "variant": "ppo", "seed": 3}
    folder.add("A", record=DONE | {"config": named})
    folder.add("B", told=told(50, 60.0) | named, held=True)
    folder.add("C", told=told(90, 60.0) | named)
    done = {"record": DONE | {"config": named}, "old": ("record",)}
    folder.add("D", told=told(50, 60.0) | named, held=True, **done)
    folder.add("E", told=told(50, 60.0) | named, **done)
    heading, names, *rows = [" ".join(line.split()) for line in status(tmp_path)]
    assert heading == "1 of 5 runs done, 2 running, 2 stopped; about 60 s left"
    assert names == "folder environment variant seed episode return β steps/s left"
    assert rows == [
        "runs/B/ppo/seed1 E ppo 3 50/100 21.5 0.25 1830 60 s",
        "runs/C/ppo/seed2 E ppo 3 90/100 21.5 0.25 1830 stopped",
        "runs/D/ppo/seed3 E ppo 3 50/100 21.5 0.25 1830 60 s",  # done, it goes on
        "runs/E/ppo/seed4 E ppo 3 50/100 21.5 0.25 1830 stopped",  # it went on
    ]


def test_what_is_damaged_is_named(tmp_path: Path) -> None:
    folder = Folder(tmp_path, cores=2)
    for said, path in (("record", "A/ppo/seed0/run"), ("told", "B/ppo/seed0/progress")):
        folder.plan["runs"] = []
        folder.add(path[0], **{said: '{"episode": 4}'})
        with pytest.raises(ConfigError, match=rf"{path}\.json: the key 'seconds' is missing"):
            folder.lines()
    for text in ('{"cores": 2, "runs": [', "\udcff"):
        (tmp_path / "logs" / "plan.json").write_bytes(text.encode(errors="surrogateescape"))
        with pytest.raises(ConfigError, match=r"logs/plan\.json: cut off or altered"):
            status(tmp_path)
    folder.plan["runs"] = [{"env": "A"}]
    with pytest.raises(ConfigError, match=r"logs/plan\.json: the key 'runs.0.variant' is missing"):
        folder.lines()


# Runs (environment, work, what there is of it), cores, and the seconds to the end of all.
DONE_A, DONE_B = ({"env": env, "record": DONE} for env in "AB")
CASES = [
    ([DONE_A, {}, {}], 2, 100, []),  # 100 s each
    ([DONE_A, {}, {}], 1, 200, []),
    ([DONE_A, {"work": 3.0}, {}, {}], 2, 300, []),  # no shorter than the longest
    ([DONE_A, {"told": told(50, 80.0), "held": True}], 2, 60, []),  # as it tells itself
    ([DONE_A, {"told": told(5, 40.0), "held": True}], 2, 90, []),  # too early to count
    ([{"told": told(50, 80.0), "held": True}, {}], 1, 60 + 110, []),
    ([DONE_A, {"told": told(5, 340.0), "held": True}], 2, 0, []),  # late
    ([DONE_B, {"env": "B"}, {}], 2, 100, ["A"]),
    ([], 0, 0, []),
]


@pytest.mark.parametrize(("runs", "cores", "expected", "unknown"), CASES)
def test_seconds_left_by_hand(tmp_path: Path, runs, cores, expected, unknown) -> None:
    folder = Folder(tmp_path, cores)
    for run in runs:
        folder.add(**run)
    planned = [
        Run(Planned(**run), tmp_path / "runs/{env}/{variant}/seed{seed}".format_map(run), 1000.0)
        for run in folder.plan["runs"]
    ]
    seconds, without = seconds_left(planned, cores)
    assert (seconds, without) == (pytest.approx(expected), unknown)


def test_in_place_on_a_terminal_and_seldom_in_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    file, terminal = io.StringIO(), io.StringIO()
    terminal.isatty = lambda: True
    for stream in (file, terminal):
        now[0] = 0.0
        with progress.line(stream) as show:
            for second in range(61):
                now[0] = float(second)
                show(told(second + 1, 30.0 + second, left=41.0))
    first, second = file.getvalue().splitlines()
    assert first == "episode 31/100   return 21.5   β 0.25   steps/s 1830   left 50 s"
    assert second == "episode 61/100   return 21.5   β 0.25   steps/s 1830   left 50 s"
    assert all(f"episode {number}/100" in terminal.getvalue() for number in range(1, 62))
