"""A finished run's parts: what is damaged is refused in one line by every command that reads it."""

import json
import re
import shutil

import pytest
from shared import GOOD, call

from mace_rl import files
from mace_rl.records import RecordError
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.provenance import file_digest

READ = {  # by the command
    "evaluate": [files.AGENT],
    "watch": [files.AGENT],
    "verify": [files.EPISODES],
    "export": [files.EPISODES],
    "tensorboard": [files.EPISODES, files.DIAGNOSTICS],
    "train": [*files.RESULTS],
}
RECORDS = {  # damaged ones, and what is said of them
    "{": "not readable",
    "[" * 10**5: "not readable",
    "[]": "",
    "{}": "the key 'config' is missing",
    '{"config": {"environment": 1}}': "config.environment is 1, but should be a valid string",
}


@pytest.fixture
def refused(trained, monkeypatch, tmp_path):
    """`refused(command, file, content)`: what it says of a run with that in a file; None: gone."""
    run = shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / "run")
    options = {"export": ["--out", str(tmp_path / "a.csv")], "train": [*sum(GOOD.items(), ())]}

    def refusal(command: str, name: str, content: bytes | None) -> str:
        path = run / name
        whole = path.read_bytes()
        path.unlink() if content is None else path.write_bytes(content)
        place = ["--out", str(run)] if command == "train" else [str(run)]
        code, said = call(monkeypatch, command, *place, *options.get(command, []))
        path.write_bytes(whole)
        assert code == 1 and str(run) in said and "\n" not in said
        assert {one.name for one in run.iterdir()} == {*files.RESULTS, files.RECORD, files.LOCK}
        return said

    return refusal


@pytest.mark.parametrize(("command", "name"), [(one, name) for one in READ for name in READ[one]])
def test_a_file_that_is_not_the_one_of_run_json(refused, command, name):
    for content in (None, b"episode\n1\n"):
        if content or name != files.DIAGNOSTICS or command == "train":  # kept runs are without it
            said = refused(command, name, content)
            assert re.search(rf"/{name}: (missing, cut off or altered|line 1: the column)", said)


@pytest.mark.parametrize("command", READ)
def test_a_run_json_that_is_none(refused, command):
    for content, expected in RECORDS.items():
        assert f"/run.json: {expected}" in refused(command, files.RECORD, content.encode())
    if command not in ("train", "tensorboard"):  # which are for unfinished runs, too
        assert "no finished run in" in refused(command, files.RECORD, None)


@pytest.mark.parametrize("text", ["episode\nx\n", "", "\x00", '"'])
def test_what_no_training_wrote_though_its_digest_is_right(trained, tmp_path, text):
    run = shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / "run")
    record = json.loads((run / files.RECORD).read_text(encoding="utf-8"))
    for name in (files.EPISODES, files.DIAGNOSTICS):
        (run / name).write_text(text, encoding="utf-8")
        record["outputs"][name] = file_digest(run / name)
    (run / files.RECORD).write_text(json.dumps(record), encoding="utf-8")
    for part, file in (("rows", "episodes"), ("episodes", "episodes"), ("diagnostics",) * 2):
        with pytest.raises(RecordError, match=rf"/{file}\.csv: [^\n]*$"):
            getattr(FinishedRun(run), part)
