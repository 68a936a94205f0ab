"""What a run's files may not do to whoever reads them; what is damaged or differs is named."""

import io
import json
import re
import shutil
import sys
import zipfile
from typing import get_type_hints

import numpy as np
import pytest
import torch
from shared import GOOD, LAYER_NORM, call, refusal, refused

from mace_rl.base import files
from mace_rl.base.tables import RecordError
from mace_rl.beta.controller import BetaController
from mace_rl.config.plugins import code_outside, make
from mace_rl.config.section import ConfigError
from mace_rl.runs import verify
from mace_rl.runs.agent import load_agent
from mace_rl.runs.checkpoint import CheckpointError, archive
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.provenance import file_digest
from mace_rl.training.records import EpisodeRecord

PAGER = {"kind": "custom", "rule": "pydoc:pipepager", "arguments": {"cmd": "touch ran"}}
NETWORK = {"kind": "torch", "module": "pydoc:pipepager"}
OWN = {"kind": "custom", "estimator": "evil:Own"}
HOSTILE = {  # by the key that is named
    "beta.rule": {"beta": PAGER},
    "bonus.estimator": {"bonus": OWN},
    "novelty.estimator": {"novelty": OWN},
    "ppo.network.module": {
        "engine": "torch",
        "ppo": {"network": {"kind": "torch", "module": "evil:Own"}},
    },
    "environment": {"environment": "evil:CartPole-v1"},
    "environment_arguments.a.b": {"environment_arguments": {"a": [1, {"b": ["evil:Own"]}]}},
    "environment_arguments.c": {"environment_arguments": {"c": {"evil:Own": 1}}},
}


@pytest.fixture
def kept(trained, tmp_path, monkeypatch):
    """`kept(change)`: a run with other settings, in a folder with a module of the sender's."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text("open('ran', 'w')")
    run = tmp_path / "runs/CartPole-v1/mace_fixed/seed0"
    shutil.copytree(trained("CartPole-v1", "mace_fixed", episodes=2), run)

    def change(**changes):
        record = json.loads((run / files.RECORD).read_text())
        for key, value in changes.items():
            old = record["config"][key] if key in ("novelty", "ppo") else {}
            record["config"][key] = old | value if old else value
        record["outputs"][files.AGENT] = file_digest(run / files.AGENT)
        (run / files.RECORD).write_text(json.dumps(record))
        return run

    return change


@pytest.mark.parametrize("key", HOSTILE)
def test_a_run_runs_only_this_package_s_code(kept, monkeypatch, tmp_path, key):
    run = kept(**HOSTILE[key])
    for words in (f"evaluate {run}", f"watch {run}", f"watch {run} --untrained", "verify ."):
        code, said = call(monkeypatch, *words.split())
        assert code == 1 and re.search(rf"run\.json: {key} has .*--trust", said), said
    with pytest.raises(ConfigError, match="trust=True"):
        load_agent(run)
    for words in (["export", ".", "--out", "a.csv"], ["tensorboard", "."]):
        assert call(monkeypatch, *words) == (0, "")
    assert not (tmp_path / "ran").exists() and "evil" not in sys.modules


def test_with_leave_a_run_s_code_runs_if_it_is_of_its_kind(kept, trained, monkeypatch, tmp_path):
    play = ["evaluate", "watch"]
    for key, settings, commands in (
        ("ppo.network.module", {"engine": "torch", "ppo": {"network": NETWORK}}, [*play, "verify"]),
        ("beta.rule", {"beta": PAGER}, ["verify"]),  # which playing does not need
    ):
        run = kept(**settings)
        for command in commands:
            code, said = call(monkeypatch, command, str(run), "--trust")
            assert code == 1 and f"{key} has 'pydoc:pipepager', but it should name" in said
    assert not (tmp_path / "ran").exists()
    folder = str(
        trained("CartPole-v1", "ppo", episodes=2, engine="torch", ppo={"network": LAYER_NORM})
    )
    for command in play:
        assert call(monkeypatch, command, folder, "--trust") == (0, "")


@pytest.mark.parametrize(
    "reference",
    ["pydoc:pipepager", "collections:OrderedDict", "mace_rl.runs.provenance:subprocess"],
)
@pytest.mark.parametrize(("kind", "functions"), [(BetaController, False), (torch.nn.Module, True)])
def test_what_is_of_another_kind_is_not_called(reference, kind, functions):
    with pytest.raises(ConfigError, match=f"key has '{reference}', but it should name a subclass"):
        make(reference, "key", kind, functions, "touch ran")


def test_names_of_this_package_and_other_texts_are_no_code_from_outside():
    assert not code_outside({"a": ["mace_rl.x:Y", "mace_rl:Z", "CartPole-v1", 1, None, {2: "b"}]})
    assert [*code_outside({"a": "mace_rl_x:Y", "b": [" os:X"], "c": ":"})] == ["c", "b", "a"]


def compressed():
    """A zip file that unpacks to more than it is."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("archive/data/0", bytes(10**6))
    return data.getvalue()


BIAS = "policy.network.2.bias"
STD = "policy.std"
DAMAGE = {
    f"{BIAS} is meta": lambda s: archive(s | {BIAS: s[BIAS].to("meta")}),
    f"{STD} has NaN or Inf in it, or is not": lambda s: archive(s | {STD: s[STD] * 0}),
    "not a readable archive: Weights only load failed$": lambda _: archive({"a": np.zeros(1)}),
    f"{BIAS} is .*shape .3,.*should be .*shape .64,": lambda s: archive(s | {BIAS: torch.ones(3)}),
    f"{BIAS} has NaN or Inf": lambda s: archive(s | {BIAS: s[BIAS] * torch.nan}),
    f"{BIAS} is a str": lambda s: archive(s | {BIAS: "x"}),
    f"{BIAS} is a Tensor": lambda s: archive(s | {BIAS: torch.nested.nested_tensor([s[BIAS]])}),
    f"{BIAS} is missing": lambda s: archive({k: v for k, v in s.items() if k != BIAS}),
    "other is a NoneType, but should be missing": lambda s: archive(s | {"other": None}),
    "not a readable archive: it is compressed": lambda _: compressed(),
    "not a readable archive: File": lambda _: b"no archive",
}


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
@pytest.mark.parametrize("message", DAMAGE)
def test_an_agent_that_does_not_fit_is_refused_by_the_entry(kept, message):
    run = kept()
    state = torch.load(run / files.AGENT, weights_only=True)
    (run / files.AGENT).write_bytes(DAMAGE[message](state))
    kept()  # with its digest
    with refused(CheckpointError, rf"agent\.pt: {message}"):
        load_agent(run)


# --- A finished run's parts -----------------------------------------------------------------------

READ = {  # by the command
    "evaluate": [files.AGENT],
    "watch": [files.AGENT],
    "verify": [*files.RESULTS],
    "export": [files.EPISODES],
    "tensorboard": [files.EPISODES, files.DIAGNOSTICS],
    "train": [*files.RESULTS],
}
RECORDS = [  # a text of run.json, another in its place, and what is said
    (r"\A.*\Z", "{", "not readable"),
    (r"\A.*\Z", "[" * 10**5, "not readable: maximum recursion"),
    (r"\A.*\Z", '{"a": ' + "1" * 5000 + "}", "not readable: Exceeds the limit"),
    (r"\A.*\Z", "[]", "should be a valid dictionary"),
    (r"\A.*\Z", '{"config": {"environment": 1}}', "config.environment is 1, but should be a valid"),
    (r'"outputs": \{.*?\}', '"outputs": 3', "outputs is 3, but"),
    ('"ppo"', '"a,b"', "config.variant is 'a,b', but"),
    (r'"seed": \d+', r'"seed": "\\n7\\n"', "config.seed is '.n7.n', but"),
    (r'"episodes": \d+', '"episodes": 0', "config.episodes is 0, but"),
    (r'"seconds": [0-9.]+', '"seconds": "3"', "seconds is '3', but"),
    ('"CartPole-v1"', '"CartPole-v1,0"', "config.environment is 'CartPole-v1,0', but"),
]


@pytest.fixture
def said_of(trained, monkeypatch, tmp_path):
    """`said_of(command, file, content)`: what it says of a run with that in a file; None: gone."""
    run = shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / "run")
    options = {"export": ["--out", str(tmp_path / "a.csv")], "train": [*sum(GOOD.items(), ())]}

    def damaged(command: str, name: str, content: bytes | None) -> str:
        path = run / name
        whole = path.read_bytes()
        path.unlink() if content is None else path.write_bytes(content)
        place = ["--out", str(run)] if command == "train" else [str(run)]
        said = refusal(monkeypatch, command, *place, *options.get(command, []))
        path.write_bytes(whole)
        assert str(run) in said
        assert {one.name for one in run.iterdir()} == {*files.RESULTS, files.RECORD, files.LOCK}
        return said

    return damaged


@pytest.mark.parametrize(("command", "name"), [(one, name) for one in READ for name in READ[one]])
def test_a_file_that_is_not_the_one_of_run_json(said_of, command, name):
    for content in (None, b"episode\n1\n"):
        of_a_kept_run = content or name == files.EPISODES  # it may be without the others
        if of_a_kept_run or command in ("train", "evaluate", "watch"):
            said = said_of(command, name, content)
            assert re.search(rf"/{name}: (missing, cut off or altered|line 1: the column)", said)


@pytest.mark.parametrize("command", READ)
def test_a_run_json_that_is_none(said_of, trained, command):
    whole = (trained("CartPole-v1", "ppo", episodes=3) / files.RECORD).read_text(encoding="utf-8")
    for old, new, expected in RECORDS:
        content = re.sub(old, new, whole, count=1, flags=re.DOTALL).encode()
        assert re.search(rf"/run\.json: {expected}", said_of(command, files.RECORD, content))
    if command not in ("train", "tensorboard"):  # which are for unfinished runs, too
        assert "no finished run in" in said_of(command, files.RECORD, None)


COLUMNS = ",".join(get_type_hints(EpisodeRecord))
IMPOSSIBLE = [
    f"{COLUMNS}\n" + "".join(rows)
    for rows in (
        ["1,9,9,nan,0.0,0.0,1\n", "2,18,9,9.0,0.0,0.0,1\n", "3,27,9,9.0,0.0,0.0,1\n"],
        ["1,9,9,9.0,0.0,0.0,1\n", "2,18,9,9.0,0.0,0.0,1\n", "7,27,9,9.0,0.0,0.0,1\n"],
        ["1,9,9,9.0,0.0,0.0,1\n", "2,18,9,9.0,0.0,0.0,1\n", f"3,{10**30},9,9.0,0.0,0.0,1\n"],
    )
]


@pytest.mark.parametrize("text", ["episode\nx\n", "episode\n1.5\n", "", "\x00", '"', *IMPOSSIBLE])
def test_what_no_training_wrote_though_its_digest_is_right(trained, tmp_path, text):
    run = shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / "run")
    record = json.loads((run / files.RECORD).read_text(encoding="utf-8"))
    for name in (files.EPISODES, files.DIAGNOSTICS):
        (run / name).write_text(text, encoding="utf-8")
        record["outputs"][name] = file_digest(run / name)
    (run / files.RECORD).write_text(json.dumps(record), encoding="utf-8")
    parts = {"rows": "episodes", "episodes": "episodes", "diagnostics": "diagnostics"}
    for part, file in [*parts.items()][: 2 if text in IMPOSSIBLE else 3]:
        with pytest.raises(RecordError, match=rf"/{file}\.csv: [^\n]*$"):
            getattr(FinishedRun(run), part)


# --- verify ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "change", "said"),
    [
        ("config", {"seed": 1}, "different from episode 1; mean return"),
        ("outputs", {"agent.pt": "0" * 64}, "different in agent.pt only;"),
        ("versions", {"numpy": "1.0"}, "versions.numpy was '1.0' and is"),
    ],
)
def test_verify_says_what_differs(trained, tmp_path, monkeypatch, capsys, section, change, said):
    run = shutil.copytree(trained("CartPole-v1", "ppo", episodes=3), tmp_path / "runs")
    path = run / "run.json"
    record = json.loads(path.read_text(encoding="utf-8"))
    record["machine"] = {}
    record["config"]["seed"] = int(section != "outputs")
    record[section].update(change)
    (run / files.AGENT).unlink()  # as in a kept run
    path.write_text(json.dumps(record), encoding="utf-8")
    expected = "mace-rl: not reproduced: 0 of 1 runs equal to the bit"
    assert call(monkeypatch, "verify", str(tmp_path)) == (1, expected)
    assert said in capsys.readouterr().out


def test_a_sample_is_as_large_as_asked_and_always_the_same(tmp_path, monkeypatch):
    folders = [tmp_path / f"runs/CartPole-v1/ppo/seed{seed}" for seed in range(10, 20)]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "run.json").touch()

    def drawn(sample: int | None) -> list[str]:
        return [*verify.verify(tmp_path, sample)][:-1]

    monkeypatch.setattr(verify, "repeat", lambda run: (True, str(run.folder)))
    assert drawn(None) == drawn(99) == [*map(str, folders)]
    assert drawn(3) == drawn(3) == sorted({*drawn(3)} & {*drawn(None)}) and len(drawn(3)) == 3
