"""What runs recorded, read back from TensorBoard's event files."""

import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shared import call
from tensorboardX.proto.event_pb2 import Event

from mace_rl import files
from mace_rl.runs import checkpoint
from mace_rl.trainer import Trainer

RUN = "CartPole-v1/mace_full/seed0"


def events(path: Path) -> list[Event]:
    """The events in a file: each after its length and a checksum, and before another."""
    data, found = path.read_bytes(), []
    while data:
        (length,) = struct.unpack("<Q", data[:8])
        found.append(Event.FromString(data[12 : 12 + length]))
        data = data[16 + length :]
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


@pytest.fixture
def run(trained, tmp_path: Path) -> Path:
    """The folder of a finished run."""
    return shutil.copytree(trained(variant="mace_full", episodes=3), tmp_path / "runs" / RUN)


def test_events_hold_what_the_run_recorded(run, monkeypatch, tmp_path):
    out = tmp_path / "events"
    command = ("tensorboard", str(tmp_path / "runs"), "--out", str(out))
    assert call(monkeypatch, *command) == (0, "")
    path = out / RUN / files.EVENTS
    found = scalars(path)
    for name, prefix in {files.EPISODES: "episodes", files.DIAGNOSTICS: "updates"}.items():
        frame = pd.read_csv(run / name)
        for column in frame.columns.drop(["episode", "update"], errors="ignore"):
            cells = frame[["episode", column]].dropna()
            values = map(float, np.float32(cells[column]))  # as the format holds them
            expected = list(zip(cells["episode"], values, strict=True))
            assert found.pop(f"{prefix}/{column}", []) == expected, column
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
    for count, _ in zip((1, 2, 3), trainer.run(), strict=False):  # one episode in each round
        state = {"trainer": trainer.state_dict()}
        checkpoint.save(tmp_path / files.CHECKPOINT, {}, state)
        assert call(monkeypatch, "tensorboard", str(tmp_path)) == (0, "")
        found = scalars(tmp_path / files.EVENTS)
        returns = [float(np.float32(record.extrinsic_return)) for record in trainer.records]
        assert found["episodes/extrinsic_return"] == list(enumerate(returns, start=1))
        assert len(returns) == len(found["updates/entropy"]) == count


def test_without_the_package_one_line_says_so(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    code, message = call(monkeypatch, "tensorboard", str(run))
    assert (code, message.count("\n")) == (1, 0) and "pip install tensorboardX" in message
