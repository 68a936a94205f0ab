"""The contract of episodes.csv: it comes back to the bit, and what is damaged is refused."""

import hashlib
import os
import re

import numpy as np
import pytest
from invented import episode_columns
from shared import refused

from mace_rl.base.tables import RecordError
from mace_rl.training.records import read_episodes, write_episodes

HEADER = "episode,env_steps,length,extrinsic_return,intrinsic_return,beta,terminated"
ROWS = ["1,10,10,9.5,0.25,0.4,1", "2,30,20,-19.0,3e-05,0.3996,0", "3,31,1,0.1,0.0,0.0,1"]


def columns(episodes=3):
    """Awkward doubles among them: subnormal, largest, negative zero."""
    found = episode_columns(episodes)
    found["extrinsic_return"][:3] = 5e-324, np.finfo(float).max, -0.0
    return found


def text(rows=ROWS, header=HEADER):
    return "\n".join([header, *rows]) + "\n"


def test_doubles_and_integers_come_back_to_the_bit(tmp_path):
    written = columns(1000)
    write_episodes(tmp_path / "episodes.csv", written)
    frame = read_episodes(tmp_path / "episodes.csv", 1000)
    assert list(frame.columns) == HEADER.split(",")
    for name, values in written.items():
        assert frame[name].dtype == values.dtype
        assert frame[name].to_numpy().tobytes() == values.tobytes()


DAMAGE = {  # what the file holds, and what the message must name
    "empty": ("", "line 1", "ends within"),
    "a missing column": (text(header=HEADER[: -len(",terminated")]), "line 1", "terminated"),
    "a short row": (text([ROWS[0], "2,30,20,-19.0,0.5,0.3996", ROWS[2]]), "line 3", "6 cells"),
    "a blank line": (text([*ROWS, ""]), "line 5", "1 cells"),
    "a gap": (text([ROWS[0], "3,30,20,-19.0,0.0,0.4,0"]), "line 3", "episode is 3"),
    "more episodes": (text([*ROWS, "4,32,1,0.1,0.0,0.0,1"]), "line 5", "4 episodes"),
    "an empty cell": (text([ROWS[0].replace("9.5", "")]), "line 2", "extrinsic_return is ''"),
    "NaN": (text([ROWS[0].replace("9.5", "nan")]), "line 2", "extrinsic_return is 'nan'"),
    "a digit too many": (text([ROWS[0].replace("9.5", "9.50")]), "line 2", "'9.50'"),
    "an enormous integer": (text(["1," + "9" * 30 + ",10,9.5,0.25,0.4,1"]), "line 2", "env_steps"),
    "env_steps": (text([ROWS[0], ROWS[1].replace("30", "31")]), "line 3", "env_steps is 31"),
    "length": (text(["1,0,0,9.5,0.25,0.4,1"]), "line 2", "length is 0"),
    "intrinsic": (text([ROWS[0].replace("0.25", "-0.25")]), "line 2", "intrinsic_return is -0.25"),
    "beta above": (text([ROWS[0].replace("0.4", "10.5")]), "line 2", "beta is 10.5"),
    "terminated": (text([ROWS[0][:-1] + "2"]), "line 2", "terminated is 2"),
    "windows newlines": (text().replace("\n", "\r\n"), "line 1", "terminated"),
    "a NUL": (text([ROWS[0].replace("9.5", "9\0")]), "line 2", "extrinsic_return"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused_with_its_line(damage, tmp_path):
    content, line, named = DAMAGE[damage]
    path = tmp_path / "épisodes 1.csv"
    path.write_bytes(content.encode())
    with refused(RecordError, f"^{path}: {line}.*{re.escape(named)}"):
        read_episodes(path, 3)


def test_what_run_json_does_not_describe_is_refused(tmp_path):
    """Plausible, but altered; and where the damage has a line, that is named."""
    path = tmp_path / "e.csv"
    path.write_text(text())
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert read_episodes(path, 3, digest)["extrinsic_return"].tolist() == [9.5, -19.0, 0.1]
    for altered, said in (("9.75", "missing, cut off or altered"), ("x", "line 2: .*'x'")):
        path.write_text(text().replace("9.5", altered))
        with pytest.raises(RecordError, match=rf"e\.csv: {said}"):
            read_episodes(path, 3, digest)


def test_every_cut_is_refused(tmp_path):
    """A file cut off after any number of bytes is never taken for a whole one."""
    whole = text().encode()
    for size in range(len(whole)):
        (tmp_path / "cut.csv").write_bytes(whole[:size])
        with pytest.raises(RecordError):
            read_episodes(tmp_path / "cut.csv", 3)


def test_missing_files_folders_and_other_encodings_are_refused(tmp_path):
    with pytest.raises(RecordError, match=r"none\.csv: cannot be read: No such file"):
        read_episodes(tmp_path / "none.csv", 3)
    with pytest.raises(RecordError, match="Is a directory"):
        read_episodes(tmp_path, 3)
    (tmp_path / "latin.csv").write_bytes(text([ROWS[0], "\xe9"]).encode("latin-1"))
    with pytest.raises(RecordError, match="line 3: 'utf-8' codec"):
        read_episodes(tmp_path / "latin.csv", 3)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_would_be_refused_is_not_written(value, tmp_path):
    with pytest.raises(RecordError, match=f"line 3: extrinsic_return is {value}"):
        spoilt = columns() | {"extrinsic_return": np.array([1.0, value, 1.0])}
        write_episodes(tmp_path / "e.csv", spoilt)
    assert list(tmp_path.iterdir()) == []


def test_writing_is_all_or_nothing(tmp_path, monkeypatch):
    path = tmp_path / "episodes.csv"
    path.write_text("before")

    def fail(descriptor):
        raise OSError(28, "disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match=r"disk full: '.*/episodes\.csv'"):
        write_episodes(path, columns())
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]
