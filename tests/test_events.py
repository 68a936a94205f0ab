"""What runs recorded, read back from TensorBoard's event files."""

import struct
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shared import GOOD, call
from tensorboardX.proto.event_pb2 import Event

from mace_rl import files
from mace_rl.runs import checkpoint
from mace_rl.train import Trainer


def crc32c(data: bytes) -> int:
    """Castagnoli's checksum, bit by bit, as the format masks it."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def events(path: Path) -> list[Event]:
    """The events in a file: each with its length and two checksums around it."""
    data, found = path.read_bytes(), []
    while data:
        length, check = struct.unpack("<QI", data[:12])
        assert check == crc32c(data[:8])
        body, data = data[12 : 12 + length], data[12 + length :]
        assert struct.unpack("<I", data[:4]) == (crc32c(body),)
        found.append(Event.FromString(body))
        data = data[4:]
    return found


def scalars(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Steps and values by tag."""
    first, *rest = events(path)
    assert first.file_version == "brain.Event:2"
    assert [event.step for event in rest] == sorted(event.step for event in rest)
    found: dict[str, list[tuple[int, float]]] = {}
    for event in rest:
        for value in event.summary.value:
            found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


def expected(frame: pd.DataFrame, column: str) -> list[tuple[int, float]]:
    """What stands in a column of a run's CSV file, as the format holds it: in single precision."""
    cells = frame[["episode", column]].dropna()
    return list(zip(cells["episode"], map(float, np.float32(cells[column])), strict=True))


@pytest.fixture
def run(monkeypatch, tmp_path: Path) -> Path:
    """The folder of a finished run."""
    folder = tmp_path / "runs/CartPole-v1/mace_full/seed0"
    options = GOOD | {"--variant": "mace_full", "--out": str(folder)}
    assert call(monkeypatch, "train", *sum(options.items(), ())) == (0, "")
    return folder


def test_events_hold_what_the_run_recorded(run, monkeypatch, tmp_path):
    out = tmp_path / "events"
    command = ("tensorboard", str(tmp_path / "runs"), "--out", str(out))
    assert call(monkeypatch, *command) == (0, "")
    path = out / "CartPole-v1/mace_full/seed0" / files.EVENTS
    found = scalars(path)
    for name, prefix in {files.EPISODES: "episodes", files.DIAGNOSTICS: "updates"}.items():
        frame = pd.read_csv(run / name)
        for column in frame.columns.drop(["episode", "update"], errors="ignore"):
            assert found.pop(f"{prefix}/{column}", []) == expected(frame, column), column
    assert not found
    before = path.read_bytes()
    assert call(monkeypatch, *command) == (0, "")
    assert path.read_bytes() == before
    # A kept run has no diagnostics; without --out the events lie beside the records.
    (run / files.DIAGNOSTICS).unlink()
    assert call(monkeypatch, "tensorboard", str(run)) == (0, "")
    assert {tag.partition("/")[0] for tag in scalars(run / files.EVENTS)} == {"episodes"}


def test_events_of_a_run_that_is_not_finished(run_config, monkeypatch, tmp_path):
    trainer = Trainer(run_config(variant="mace_full", episodes=9))
    training = trainer.run()
    for count in (3, 6):  # episodes, one in each round
        for _ in range(3):
            next(training)
        state = {"trainer": trainer.state_dict()}
        checkpoint.save(tmp_path / files.CHECKPOINT, {}, state)
        assert call(monkeypatch, "tensorboard", str(tmp_path)) == (0, "")
        found = scalars(tmp_path / files.EVENTS)
        returns = [np.float32(record.extrinsic_return) for record in trainer.records]
        assert found["episodes/extrinsic_return"] == list(enumerate(map(float, returns), start=1))
        assert len(returns) == len(found["updates/entropy"]) == count


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda run: (run / files.EPISODES).write_text("episode\n1\n"), "SHA-256"),
        (lambda run: (run / files.EPISODES).unlink(), "episodes.csv: the file is missing"),
        (lambda run: (run / files.RECORD).write_text("{"), "not readable"),
        (lambda run: (run / files.RECORD).rename(run / files.CHECKPOINT), "cut off or altered"),
        (lambda run: (run / files.RECORD).unlink(), "no run in it"),
    ],
)
def test_damaged_records_become_no_events(damage, words, run, monkeypatch):
    damage(run)
    code, message = call(monkeypatch, "tensorboard", str(run))
    assert code == 1 and words in message and str(run) in message and "\n" not in message
    assert not (run / files.EVENTS).exists()


def test_without_the_package_one_line_says_so(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    code, message = call(monkeypatch, "tensorboard", str(run))
    assert (code, message.count("\n")) == (1, 0) and "pip install tensorboardX" in message
