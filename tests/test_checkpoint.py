"""Checkpoints: which are not continued, that loading executes nothing, when one is due."""

import hashlib
import pickle
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from mace_rl import sources
from mace_rl.config.reading import merge_layers
from mace_rl.config.run import RunConfig
from mace_rl.runs import checkpoint, provenance, run

# --- Checkpoints that are not continued ---------------------------------------------------------


def flip_a_byte(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGES = {
    "altered at the start": lambda content: flip_a_byte(content, 0),
    "altered in the middle": lambda content: flip_a_byte(content, len(content) // 2),
    "altered at the end": lambda content: flip_a_byte(content, len(content) - 1),
    "cut off": lambda content: content[:-1],
    "cut off early": lambda content: content[:40],
    "empty": lambda content: b"",
    "something else": lambda content: b"never a checkpoint\n",
    "too long": lambda content: content + b"\0",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_checkpoint_is_not_continued(interrupted, completes, caplog, damage):
    path = interrupted.directory / "checkpoint.pt"
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    assert completes(interrupted.config, interrupted.directory)["interruptions"] == []
    assert f"starting afresh: {path}: cut off or altered" in caplog.text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1}, "config.seed was 0 and is 1"),
        ({"variant": "mace_fixed"}, "config.variant was 'mace_full' and is 'mace_fixed'"),
        ({"environment": "Acrobot-v1"}, "config.environment was 'CartPole-v1' and is 'Acrobot-v1'"),
        ({"episodes": 5}, "config.episodes was 6 and is 5"),
        ({"ppo": {"clip": 0.3}}, "config.ppo.clip was 0.2 and is 0.3"),
        ({"beta": {"kind": "none"}}, "config.beta.kind was 'meta' and is 'none'"),
        ({"meta": {"max_sequence": None}}, "config.meta.max_sequence was 32 and is None"),
    ],
)
def test_checkpoint_of_another_configuration_is_not_continued(
    interrupted, completes, caplog, changes, message
):
    settings = merge_layers(interrupted.config.settings(), changes)
    completes(RunConfig.model_validate(settings), interrupted.directory)
    assert f"of another run: {message}" in caplog.text


def test_checkpoint_of_other_versions_or_code_is_not_continued(
    interrupted, monkeypatch, caplog, kill
):
    found = provenance.versions()
    for place, name, replaced, message in (
        (provenance, "versions", lambda: found | {"torch": "9.9"}, "versions.torch was "),
        (sources, "digest", lambda *paths: "0" * 64, "sources was "),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, replaced)
            # Before the first checkpoint, so the old one stays.
            kill(1, interrupted.config, interrupted.directory)
        assert message in caplog.text
    caplog.clear()
    run.run(interrupted.config, interrupted.directory)
    assert "afresh" not in caplog.text


class Payload:
    """Creates a file when unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.slow
@pytest.mark.parametrize("writer", ["pickle", "torch"])
def test_loading_executes_nothing(interrupted, tmp_path, caplog, writer):
    """Even with the right digest in front."""
    mark = tmp_path / "executed"
    if writer == "pickle":
        data = pickle.dumps(Payload(mark), protocol=2)
    else:
        data = checkpoint.archive({"identity": Payload(mark)})
    path = interrupted.directory / "checkpoint.pt"
    path.write_bytes(hashlib.sha256(data).hexdigest().encode() + b"\n" + data)
    with pytest.raises(checkpoint.CheckpointError, match="not a readable archive"):
        checkpoint.load(path, {})
    run.run(interrupted.config, interrupted.directory)
    assert "starting afresh" in caplog.text and not mark.exists()


# --- When a checkpoint is due -------------------------------------------------------------------


@pytest.mark.parametrize("said", ["often", "-1", "nan", "inf", ""])
def test_a_time_between_checkpoints_that_cannot_be(run_config, tmp_path, monkeypatch, said):
    monkeypatch.setenv("MACE_RL_CHECKPOINT_SECONDS", said)
    refusal = f"MACE_RL_CHECKPOINT_SECONDS is {said!r}, but should be a number of seconds"
    with pytest.raises(run.RunError, match=re.escape(refusal)):
        run.run(run_config("CartPole-v1", "ppo", 0, episodes=2), tmp_path)


@pytest.mark.parametrize(("cost", "wait"), [(0.01, 10.0), (0.1, 10.0), (0.5, 50.0), (3.0, 300.0)])
def test_checkpoints_cost_at_most_one_percent(monkeypatch, cost, wait):
    """Every 10 s, or as seldom as their cost demands; the clock is set by hand."""
    now = [1000.0]
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: now[0]))
    clock = run.Clock(900.0, 2.0, 0.7)  # 100 s before an interruption, 0.7 of them on checkpoints
    assert clock.elapsed() == 100 and not clock.checkpoint_due()
    now[0] += 10
    assert clock.checkpoint_due()
    with clock.saving():
        now[0] += cost
    assert clock.checkpoint_seconds == pytest.approx(0.7 + cost)
    now[0] = 1010 + wait - 0.001
    assert not clock.checkpoint_due()
    now[0] += 0.002
    assert clock.checkpoint_due()
