"""What `tools/cross_cpu.py` notices and says; not the emulation, which takes minutes."""

import json
import sys
from pathlib import Path

import pytest

from mace_rl import files
from tools import cross_cpu

EPISODES = "episode,env_steps,length\n1,10,10\n2,30,20\n3,35,5\n"


def results(folder: Path, interruptions: int = 0, **changes: str) -> Path:
    """Results as a run leaves them, with other contents for `changes` (dots in names as _)."""
    contents = dict.fromkeys(files.RESULTS, "the same") | {files.EPISODES: EPISODES}
    contents |= {name.replace("_", "."): content for name, content in changes.items()}
    record = {"interruptions": [{}] * interruptions, "arithmetic": {"numba": "haswell"}}
    folder.mkdir()
    for name, content in ({files.RECORD: json.dumps(record)} | contents).items():
        (folder / name).write_text(content)
    return folder


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"agent_pt": "the sane"}, "agent.pt"),
        ({"diagnostics_csv": "the same\n"}, "diagnostics.csv"),
        (
            {"episodes_csv": EPISODES.replace("20\n", "21\n")},
            "episodes.csv from row 2 (length is 21, not 20)",
        ),
        (
            {"episodes_csv": EPISODES[:-1], "agent_pt": ""},
            "episodes.csv from row 4 (episode is nothing, not ), agent.pt",
        ),
    ],
)
def test_every_byte_counts_and_what_differs_is_named(
    tmp_path: Path, changes: dict[str, str], said: str
) -> None:
    pair = results(tmp_path / "wanted"), results(tmp_path / "found", **changes)
    assert cross_cpu.difference(*pair) == said


def test_other_instructions_are_named_beside_what_differs(tmp_path: Path) -> None:
    wanted, found = results(tmp_path / "wanted"), results(tmp_path / "found", agent_pt="another")
    record = {"interruptions": [], "arithmetic": {"numba": "znver1"}}
    (found / files.RECORD).write_text(json.dumps(record))
    assert cross_cpu.difference(wanted, found) == "agent.pt, numba computes with znver1"


def test_a_training_that_was_not_continued_is_not_equal(tmp_path: Path) -> None:
    wanted = results(tmp_path / "wanted")
    afresh, continued = results(tmp_path / "afresh"), results(tmp_path / "continued", 1)
    assert "started afresh" in cross_cpu.difference(wanted, afresh, resumed=True)
    assert cross_cpu.difference(wanted, continued, resumed=True) == ""


@pytest.mark.slow
def test_a_training_is_begun_and_can_be_continued(run_config, tmp_path: Path) -> None:
    from mace_rl.runs import run

    config = run_config(episodes=6)
    cross_cpu.begin(run, config, tmp_path)
    assert not (tmp_path / files.RECORD).exists()
    run.run(config, tmp_path)
    (interruption,) = json.loads((tmp_path / files.RECORD).read_text())["interruptions"]
    assert interruption["after_episode"] == 3


def test_short_covers_every_environment_variant_and_processor() -> None:
    trainings = cross_cpu.planned(short=True)
    for field, wanted in (
        ("processor", cross_cpu.PROCESSORS),
        ("environment", cross_cpu.ENVIRONMENTS),
        ("variant", cross_cpu.VARIANTS),
        ("half", ("", "begun", "ended")),
    ):
        assert {getattr(training, field) for training in trainings} == set(wanted)


def test_a_processor_that_fails_is_named_with_the_reason(tmp_path: Path, capsys) -> None:
    trainings = [cross_cpu.Training("EPYC", "Acrobot-v1", variant) for variant in ("ppo", "other")]
    emulator = tmp_path / "emulator"  # does the first training and crashes
    emulator.write_text("#!/bin/sh\necho loaded; echo finished 0; echo oh no >&2; exit 139\n")
    emulator.chmod(0o755)
    for name in ("here Acrobot-v1 ppo", "EPYC Acrobot-v1 ppo"):
        results(tmp_path / name)
    assert cross_cpu.emulate(str(emulator), "compiled", trainings, tmp_path, "EPYC") == []
    assert capsys.readouterr().out.splitlines() == [
        "EPYC Acrobot-v1 ppo: equal",
        "EPYC: FAILED, 1 of 2 steps left: oh no",
    ]


def test_a_missing_or_old_qemu_gets_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["cross_cpu"])
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit, match=r"^cross-cpu: there is no qemu-x86_64; .*qemu-user.*9\.1"):
        cross_cpu.main()
    emulator = tmp_path / cross_cpu.QEMU
    emulator.write_text("#!/bin/sh\necho qemu-x86_64 version 7.2.22\necho Copyright\n")
    emulator.chmod(0o755)
    with pytest.raises(SystemExit, match=r"^cross-cpu: qemu-x86_64 version 7\.2\.22 computes wro"):
        cross_cpu.main()


def test_tables_and_figures_of_the_kept_runs_are_compared_to_the_byte(tmp_path: Path) -> None:
    training = cross_cpu.planned(short=False)[-1]
    assert str(training) == "Dhyana Table 1 and Figure 1"
    for one in (training, training._replace(processor=cross_cpu.HERE)):
        cross_cpu.tabulate(tmp_path / str(one))
    assert cross_cpu.judge(training, tmp_path)
    (tmp_path / str(training) / "table1.tex").write_text("another")
    assert not cross_cpu.judge(training, tmp_path)
