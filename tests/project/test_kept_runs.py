"""Runs that are kept come out as they went in."""

import io
import json
import lzma
import re
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
from invented import episode_columns
from shared import message

from mace_rl.base import files
from mace_rl.runs.provenance import file_digest
from mace_rl.training.records import rounded, write_episodes
from tools import kept_runs


def make_run(folder: Path, number: int, agent: bytes = b"agent", episodes: int = 30) -> None:
    folder.mkdir(parents=True)
    columns = episode_columns(episodes, number)
    for name in ("intrinsic_return", "beta"):
        columns[name] = np.array([rounded(value) for value in columns[name]])
    if number % 2 == 0:
        columns["extrinsic_return"] = -columns["length"].astype(float)
    write_episodes(folder / files.EPISODES, columns)
    (folder / files.AGENT).write_bytes(agent)
    digests = {name: file_digest(folder / name) for name in (files.EPISODES, files.AGENT)}
    config = {"environment": "A-v1", "variant": "ppo", "seed": number, "episodes": episodes}
    record = {"config": config, "versions": {}, "sources": "", "machine": {}, "outputs": digests}
    record["seconds"] = 10 * number
    (folder / files.RECORD).write_text(json.dumps(record))


def content(folder: Path) -> dict[str, bytes]:
    """The files in a folder but for agents, which are not kept."""
    found = {path for path in folder.rglob("*") if path.is_file()}
    found -= {*folder.rglob(files.AGENT)}
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(found)}


def test_what_was_packed_comes_out(tmp_path: Path) -> None:
    results, kept = tmp_path / "results", tmp_path / "kept"
    runs = "A-v1/ppo/seed100", "A-v1/ppo/seed1000", "A-v1/ppo/seed99", "B-v0/mace_full/seed3"
    for number, run in enumerate(runs):
        make_run(results / "runs" / run, number, episodes=20 + 7 * number)
    (results / "runs/A-v1/ppo/seed11").mkdir()  # not finished
    make_run(results / "runs/B-v0/mace_full/seed100", 4)
    assert kept_runs.pack(results, kept) == 5
    assert sorted(content(kept)) == ["A-v1/ppo.tar.xz", "B-v0/mace_full.tar.xz"]
    assert kept_runs.unpack(kept, tmp_path / "again") == 5
    assert content(tmp_path / "again") == content(results)
    assert not [*(tmp_path / "again").rglob(files.AGENT)]


def test_a_column_is_kept_in_the_form_that_takes_least_room(tmp_path: Path) -> None:
    draws, run = np.random.default_rng(0), tmp_path / "results/runs/A-v1/ppo/seed1"
    make_run(run, 1, episodes=3000)  # the 2nd in all digits, the 3rd and the 4th in six
    columns = {
        "episode": np.arange(1, 3001),
        "env_steps": np.arange(200, 600001, 200),
        "length": np.full(3000, 200),
        "extrinsic_return": draws.normal(size=3000) * 1e3,
        "intrinsic_return": np.array([rounded(10.0**each) for each in draws.uniform(-9, 9, 3000)]),
        "beta": np.array([rounded(value) for value in draws.uniform(0, 0.5, 3000)]),
        "terminated": np.zeros(3000, int),
    }
    columns["intrinsic_return"][:2], columns["extrinsic_return"][:2] = (0.0, 1e-300), (0.0, -0.0)
    write_episodes(run / files.EPISODES, columns)
    record = json.loads((run / files.RECORD).read_text())
    record["outputs"][files.EPISODES] = file_digest(run / files.EPISODES)
    (run / files.RECORD).write_text(json.dumps(record))
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    archive = tmp_path / "kept/A-v1/ppo.tar.xz"
    with tarfile.open(archive) as tar:
        sizes = {member.name: member.size for member in tar}
    forms = ["beta.digits", "extrinsic_return.doubles", "intrinsic_return.digits", "length"]
    assert sorted(sizes) == [*forms, "seed1/run.json", "terminated"]
    text = (run / files.EPISODES).read_bytes()
    assert archive.stat().st_size < 0.8 * len(lzma.compress(text))
    assert kept_runs.read(archive)[f"seed1/{files.EPISODES}"] == text


def test_packing_again_adds_and_equal_runs_give_equal_files(tmp_path: Path) -> None:
    for half in (0, 1):
        make_run(tmp_path / f"half{half}/runs/A-v1/ppo/seed{half}", half)
        make_run(tmp_path / f"whole/runs/A-v1/ppo/seed{half}", half)
    kept_runs.pack(tmp_path / "half1", tmp_path / "kept")
    assert kept_runs.pack(tmp_path / "half0", tmp_path / "kept") == 2
    kept_runs.pack(tmp_path / "whole", tmp_path / "kept whole")
    assert content(tmp_path / "kept") == content(tmp_path / "kept whole")


def test_records_that_are_not_the_runs_and_other_runs_of_a_seed_are_refused(tmp_path: Path) -> None:
    run, kept = tmp_path / "results/runs/A-v1/ppo/seed100", tmp_path / "kept"
    make_run(run, 1)
    kept_runs.pack(tmp_path / "results", kept)
    before = content(kept)
    records = (run / files.EPISODES).read_bytes()
    (run / files.EPISODES).write_bytes(records.replace(b"0", b"1"))
    with pytest.raises(ValueError, match=r"episodes\.csv: missing, cut off or altered"):
        kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    (run / files.EPISODES).write_bytes(records)
    shutil.rmtree(run)
    make_run(run, 2)
    with pytest.raises(ValueError, match=r"ppo\.tar\.xz has another run of this seed"):
        kept_runs.pack(tmp_path / "results", kept)
    assert content(kept) == before
    others = content(tmp_path / "results")
    with pytest.raises(ValueError, match=r"seed100/.* there already, and not the kept one"):
        kept_runs.unpack(kept, tmp_path / "results")
    assert content(tmp_path / "results") == others


@pytest.mark.parametrize("command", ["pack", "unpack"])
@pytest.mark.parametrize("folder", ["nope", "without a finished run"])
def test_where_there_are_no_runs_nothing_is_done(tmp_path, monkeypatch, command, folder) -> None:
    origin, goal = tmp_path / folder, tmp_path / "goal"
    (tmp_path / "without a finished run/runs/A-v1/ppo/seed0").mkdir(parents=True)
    make_run(tmp_path / "results/runs/A-v1/ppo/seed1", 1)
    kept_runs.pack(tmp_path / "results", goal)  # what is there already does not count
    before = content(tmp_path)
    wanted = {"pack": "runs/ENV/VARIANT/seedN/run.json", "unpack": "ENV/VARIANT.tar.xz"}[command]
    said = message(monkeypatch, kept_runs, command, str(origin), str(goal))
    assert said == f"kept_runs: {origin}: no {wanted} in it"
    assert content(tmp_path) == before


def test_records_that_columns_cannot_give_back_are_refused(tmp_path: Path) -> None:
    """Whatever training never wrote: here a number of steps that is not the sum of the lengths."""
    run = tmp_path / "results/runs/A-v1/ppo/seed1"
    make_run(run, 1)
    lines = (run / files.EPISODES).read_text().splitlines(keepends=True)
    lines[3] = lines[3].replace(",", ",1", 1)
    (run / files.EPISODES).write_text("".join(lines))
    record = json.loads((run / files.RECORD).read_text())
    record["outputs"][files.EPISODES] = file_digest(run / files.EPISODES)
    (run / files.RECORD).write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"seed1/episodes\.csv is not as a training writes it"):
        kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


def test_a_sample_is_of_short_runs_of_different_archives(tmp_path: Path) -> None:
    for number in range(9):  # which take 0 to 80 seconds
        make_run(tmp_path / f"results/runs/{'AB'[number % 2]}-v0/v{number // 2}/seed100", number)
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    assert kept_runs.unpack_sample(tmp_path / "kept", tmp_path / "sample", 4) == 4
    found = content(tmp_path / "sample")
    whole = content(tmp_path / "results")
    assert found.items() <= whole.items() and len(found) == 2 * 4
    with pytest.raises(ValueError, match="6 runs in it that take less than 60 s"):
        kept_runs.unpack_sample(tmp_path / "kept", tmp_path / "more", 7)


def tar_of(members: list[tuple[str, bytes, bytes]]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, data, kind in members:
            member = tarfile.TarInfo(name)
            member.size, member.type, member.linkname = len(data), kind, "/etc/passwd"
            tar.addfile(member, io.BytesIO(data))
    return lzma.compress(buffer.getvalue())


OTHER = '{"episodes.csv": "of other episodes"}'


def with_record(episodes: str, seconds: str = "1", text: str = "") -> dict[str, bytes]:
    whole = f'{{"seconds": {seconds}, "config": {{"episodes": {episodes}}}, "outputs": {OTHER}}}'
    return {"seed1/run.json": (text or whole).encode()}


HOSTILE = {  # members that are added or replaced, by what is said of them
    "should not have '../../x'": {"../../x": b""},
    "should not have '/tmp/x'": {"/tmp/x": b""},
    "should not have 'seed1/../x/run.json'": {"seed1/../x/run.json": b"{}"},
    "should not have 'seed1/agent.pt'": {"seed1/agent.pt": b""},
    "should not have 'seed1/episodes.csv'": {"seed1/episodes.csv": b""},
    "has -5 episodes": with_record("-5"),
    "has 0 episodes": with_record("0"),
    "has True episodes": with_record("true"),
    "has 1000000000000 episodes, of which there are 30": with_record("1000000000000"),
    "run.json has other episodes": with_record("30"),
    "list indices": with_record("", text="[]"),
    "'config'": with_record("", text="{}"),
    "has None seconds": with_record("30", "null"),
    "recursion": with_record("", text="[" * 10**5),
    "invalid literal": {"length": b"\n".join([b"1e9"] * 30)},
    "should not have 'beta.halves'": {"beta.halves": b""},
    "should not have 'length.doubles' beside another form": {"length.doubles": bytes(240)},
    "cannot reshape": {"length": None, "length.doubles": bytes(241)},
    "zip()": {"length": None, "length.digits": bytes(182)},
    "larger than": {"length": bytes(kept_runs.EXPANDED)},
}


DAMAGED = [  # links and the like, and what is no archive
    *(tar_of([("seed1/run.json", b"", kind)]) for kind in (b"1", b"2", b"5", b"6", b"S")),
    *(tar_of([("length", b"", b"0")] * 2), tar_of([("length", b"", b"0")])[:-9]),
    *(lzma.compress(b"tar" * 999), b"no xz", b""),
]


@pytest.mark.parametrize(("said", "damage"), [*HOSTILE.items(), *(("", one) for one in DAMAGED)])
def test_what_was_never_packed_is_refused_in_one_line(tmp_path, monkeypatch, said, damage) -> None:
    make_run(tmp_path / "results/runs/A-v1/ppo/seed1", 1)
    kept_runs.pack(tmp_path / "results", tmp_path / "kept")
    path = tmp_path / "kept/A-v1/ppo.tar.xz"
    with tarfile.open(path) as tar:
        members = {name: tar.extractfile(name).read() for name in tar.getnames()}
    if isinstance(damage, dict):
        members |= damage
        damage = tar_of([(*one, b"0") for one in members.items() if one[1] is not None])
    path.write_bytes(damage)
    for name in ("..", ".", ""):  # which would be other folders
        odd = tmp_path / "odd" / "A-v1" / f"{name}.tar.xz"
        odd.parent.mkdir(parents=True, exist_ok=True)
        odd.write_bytes(path.read_bytes())
        with pytest.raises(ValueError, match="its name is not"):
            kept_runs.read(odd)
    before = content(tmp_path)
    for sample in ([], ["--sample", "1"]):
        words = "unpack", str(path.parents[1]), str(tmp_path / "goal"), *sample
        found = message(monkeypatch, kept_runs, *words)
        assert re.search(rf"ppo\.tar\.xz .*{re.escape(said)}", found)
    assert content(tmp_path) == before
