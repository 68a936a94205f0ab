"""`mace-rl export` and `tensorboard`: what is read of them is what each run's records are."""

import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from shared import ROOT, call, refusal
from tensorboardX.proto.event_pb2 import Event

from mace_rl import load_agent
from mace_rl.base import files
from mace_rl.runs import checkpoint
from mace_rl.training.trainer import Trainer


@pytest.fixture
def runs(trained, tmp_path):
    for variant, seed in (("ppo", 0), ("mace_full", 1)):
        folder = tmp_path / "runs" / variant / f"seed{seed}"
        shutil.copytree(trained("CartPole-v1", variant, seed, episodes=6), folder)
    return tmp_path / "runs"


def test_the_table_has_every_episode_of_every_run(runs, monkeypatch, tmp_path):
    out = tmp_path / "new folder" / "runs.csv"
    assert call(monkeypatch, "export", str(runs), "--out", str(out)) == (0, "")
    table = pd.read_csv(out)
    assert table["task"].unique() == ["CartPole-v1"] and len(table) == 12
    for (algorithm, seed), own in table.groupby(["algorithm", "seed"]):
        records = pd.read_csv(runs / algorithm / f"seed{seed}" / "episodes.csv")
        names = {"step": "env_steps", "return": "extrinsic_return"}
        for name in ("step", "return", "episode", "length", "beta"):
            assert own[name].tolist() == records[names.get(name, name)].tolist()


def test_runs_behind_links_are_there_and_once(runs, monkeypatch, tmp_path, capsys, caplog):
    """For every command that looks for runs; what was set aside is not."""
    caplog.set_level("INFO")
    elsewhere = (runs / "ppo").rename(tmp_path / "elsewhere")
    (runs / "ppo").symlink_to(elsewhere)
    (runs / "mace_full" / "loop").symlink_to(runs)
    (runs / "mace_full" / "again").symlink_to(runs / "mace_full" / "seed1")
    shutil.copytree(elsewhere / "seed0", elsewhere / "seed0" / "_aside1")
    out = tmp_path / "runs.csv"
    for _ in range(2):  # over what it wrote itself
        assert call(monkeypatch, "export", str(runs), "--out", str(out)) == (0, "")
    assert len(pd.read_csv(out)) == 12
    assert call(monkeypatch, "tensorboard", str(runs), "--out", str(tmp_path / "e")) == (0, "")
    assert "runs: 2;" in caplog.text
    assert call(monkeypatch, "verify", str(runs)) == (0, "")
    assert "2 of 2 runs equal" in capsys.readouterr().out


def test_runs_of_one_name_are_told_apart_by_their_folder(runs, monkeypatch, tmp_path):
    shutil.copytree(runs / "ppo", runs / "a, again")
    assert call(monkeypatch, "export", str(runs), "--out", str(tmp_path / "x.csv")) == (0, "")
    folders = pd.read_csv(tmp_path / "x.csv").groupby("folder")["algorithm"].agg(["first", "size"])
    assert folders.to_dict("index") == {
        "a? again/seed0": {"first": "ppo", "size": 6},
        "mace_full/seed1": {"first": "mace_full", "size": 6},
        "ppo/seed0": {"first": "ppo", "size": 6},
    }


def test_mistakes_get_one_line(runs, monkeypatch, tmp_path):
    def said_of(out: str) -> str:
        return refusal(monkeypatch, "export", str(runs), "--out", str(tmp_path / out))

    (tmp_path / "mine.csv").write_text("x,y\n1,2\n")
    assert "not written by this command" in said_of("mine.csv")
    assert (tmp_path / "mine.csv").read_text() == "x,y\n1,2\n"
    assert "--out is " in said_of("x.json") and "end in .csv or .parquet" in said_of("x.json")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "pip install pyarrow" in said_of("x.parquet")
    assert not [*tmp_path.glob("x.*")]


# --- TensorBoard's event files --------------------------------------------------------------------

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


def test_events_of_a_finished_run_that_goes_on(run, run_config, monkeypatch, tmp_path):
    trainer = Trainer(run_config(variant="mace_full", episodes=9))
    for count, _ in zip((1, 2, 3, 4, 5), trainer.run(), strict=False):
        if count in (2, 5):  # such as the one that a finished run keeps, copied after its record
            checkpoint.save(run / files.CHECKPOINT, {}, {"trainer": trainer.state_dict()})
            assert call(monkeypatch, "tensorboard", str(run)) == (0, "")
            shown = scalars(run / files.EVENTS)["episodes/extrinsic_return"]
            assert len(shown) == max(count, 3)


UNEVEN = {"episode": torch.arange(2), "beta": torch.zeros(3)}
COMPLEX = {"episode": torch.tensor([1]), "beta": torch.tensor([1j])}
NO_TRAINERS = [3, {"records": {"episode": 3}}]
NO_TRAINERS += [{"records": columns, "diagnostics": columns} for columns in (UNEVEN, COMPLEX)]


@pytest.mark.parametrize("trainer", NO_TRAINERS, ids=str)
def test_a_checkpoint_that_no_training_wrote(trainer, monkeypatch, tmp_path):
    checkpoint.save(tmp_path / files.CHECKPOINT, {}, {"trainer": trainer})
    said = refusal(monkeypatch, "tensorboard", str(tmp_path))
    assert said.endswith(f"{files.CHECKPOINT}: not as a training writes it")


def test_without_the_package_one_line_says_so(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert "pip install tensorboardX" in refusal(monkeypatch, "tensorboard", str(run))


@pytest.mark.slow
def test_a_policy_leaves_for_plain_pytorch_as_the_page_says(trained, tmp_path, monkeypatch):
    shutil.copytree(trained("CartPole-v1", "ppo", 0, episodes=10), tmp_path / "cartpole_run")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    exec(re.findall(r"```py\n(.*?)```", page, re.DOTALL)[0], {})
    rows, agent = torch.randn(5, 4), load_agent("cartpole_run")
    torch.save(rows, "rows.pt")
    alone = "import sys; sys.modules['mace_rl'] = None\nimport torch\n"
    alone += "policy = torch.export.load('policy.pt2').module()\n"
    alone += "torch.save(policy(torch.load('rows.pt')), 'logits.pt')"
    subprocess.run([sys.executable, "-c", alone], check=True)
    logits = torch.load("logits.pt")
    assert torch.equal(logits, agent.outputs(rows))
    assert torch.equal(logits - logits.logsumexp(-1, keepdim=True), agent.policy(rows).logits)
