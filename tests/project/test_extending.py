"""Pages: the examples of docs/extending.md and docs/wrappers.md as they stand, examples/; links."""

import re
import runpy
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from invented import table_for_tables
from shared import ROOT, call, refusal

from mace_rl.runs.agent import load_agent
from mace_rl.runs.finished import FinishedRun
from mace_study.compare.claims_config import read_claims
from mace_study.compare.summary import split, summary
from mace_study.compare.verdicts import ledger
from mace_study.config.study import read_study
from mace_study.measure.metrics import LearningCurve, all_metrics
from mace_study.show import tables
from mace_study.show.latex import table1_latex
from mace_study.show.markdown import markdown
from mace_study.show.pictures import PICTURES, Source

TEXT = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(?:python|yaml)\n(.*?)```", TEXT, re.DOTALL)
FILES = {body.splitlines()[0].removeprefix("# "): body for body in BLOCKS}
TRAININGS = {  # by the folder that is the last word
    command.split()[-1]: command
    for command in re.findall(r"^mace-rl (train .*)$", TEXT, re.MULTILINE)
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch, register) -> Iterator[Path]:
    """The folder we are in: an empty one but for the examples' files."""
    for name, body in FILES.items():
        (tmp_path / name).write_text(body, encoding="utf-8")
        monkeypatch.delitem(sys.modules, Path(name).stem, raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])  # the folder is looked in, too
    yield tmp_path
    for name in FILES:
        sys.modules.pop(Path(name).stem, None)


@pytest.fixture
def train(folder, monkeypatch):
    return lambda name: call(monkeypatch, *shlex.split(TRAININGS[name]))


def replace(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


def test_every_example_is_one_file_and_one_entry():
    assert {Path(name).suffix for name in FILES} == {".py", ".yaml"}
    assert all(f"{Path(name).stem}.yaml" in FILES for name in FILES)
    assert len(FILES["other_claims.yaml"].splitlines()) <= 24
    assert set(TRAININGS) == {"layer_norm", "grid_counts", "linear_decay", "chain"}


@pytest.mark.parametrize("name", TRAININGS)
def test_example_trains(folder, train, name):
    assert train(name) == (0, "")
    episodes = FinishedRun(folder / name).episodes
    assert len(episodes) >= 5
    match name:
        case "layer_norm":  # policy and two critics
            assert str(load_agent(folder / name, trust=True)).count("LayerNorm((64,)") == 3 * 2
        case "grid_counts":
            # By hand: a first episode in which every visit is judged as if it were the first.
            assert episodes["intrinsic_return"][0] == episodes["length"][0]
            assert (episodes["intrinsic_return"][1:] < episodes["length"][1:]).all()
        case "linear_decay":
            expected = [0.4 * max(0, 1 - n / 10) for n in range(len(episodes))]
            np.testing.assert_allclose(episodes["beta"], expected)
        case "chain":
            assert (episodes["length"] <= 50).all() and episodes["extrinsic_return"].max() == 1


def test_example_metric(folder):
    metrics = read_study([ROOT / "config.yaml", folder / "to_100.yaml"]).metrics
    *_, metric = all_metrics(metrics)
    assert (metric.name, metric.label) == ("to_100", "Episodes to 100")
    for returns, expected in (
        ([0.0] * 20 + [150.0] * 20, (27, False)),  # 7 of the last 10 are 150: 105
        ([99.0] * 40, (40, True)),
    ):
        curve = LearningCurve(np.array(returns), 0.0, 0.0, metrics)
        assert metric.function(curve) == expected


def test_another_paper_has_its_tables_verdicts_and_pictures(folder):
    """Two invented claims on invented metrics: A1 holds, A2 does not."""
    study = read_study([ROOT / "config.yaml", folder / "other.yaml"])
    paper, settings = read_claims(study, study.claims), study.metrics
    values = {"ppo": np.arange(12.0), "mace_fixed": 100 + np.arange(12.0)}
    equal = dict.fromkeys(values, np.arange(12.0))
    shape = all_metrics(settings), study.environments, study.variants, 12
    runs = table_for_tables(*shape, final_return=values, early_return=equal)
    answers = ledger(runs, settings, paper)
    assert [one.ways["by return"].verdict for one in answers] == ["holds", "fails"]
    assert answers[0].paper == "final_return: A 180.5, B 320; the best is B"
    assert answers[0].ways["by return"].parts[0].in_paper == 139.5
    table1, rest = split(summary(runs, settings, paper.table1), paper.table1)
    assert len(table1) == 2 and "final_return" not in set(rest["metric"])
    latex = table1_latex(table1, study.labels, settings, paper.table1)
    assert r"\caption{Final return. The best mean is \textbf{bold}." in latex
    assert r"\textbf{105.5}" in latex and "paper" not in latex
    page = markdown(tables.table1(table1, settings, paper.table1))
    assert "| **105.5** (" in page and "; paper: 320.0 |" in page and "| 5.5 (" in page
    forest = PICTURES["forest"].data(Source({}, answers, settings, paper))
    assert list(forest["part"]) == ["over A"] * 2 and list(forest["paper"].notna()) == [True, False]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("layer_norm.yaml", ":network", ":net", "has no 'net'"),
        ("linear_decay.yaml", "{initial: 0.4, episodes: 10}", "{start: 1}", "'start'"),
        ("linear_decay.yaml", ": 0.4", ": 10.5", "episode 1: β is 10.5, which is"),
        ("grid_counts.yaml", "kind: custom", "kind: counts", "estimator and kind: custom"),
        ("grid_counts.py", "1 / (1", "2 / (1", "the curiosity bonus is 2.0, which is"),
        ("grid_counts.py", "(states)])", "(states)][:1])", "the novelty is float64 of shape (1,)"),
        ("linear_decay.py", "return self", "return [1] or self", "β is int64 of shape"),
        ("layer_norm.py", "    return ", "    return None and ", "which returned None"),
        ("layer_norm.py", "inputs = size", "", "in a trial of 'layer_norm:network': Runt"),
        ("grid_counts.py", "cell, {}", "{}[cell], {}", "in making 'grid_counts:GridCounts': KeyE"),
    ],
)
def test_mistakes_get_one_line(folder, monkeypatch, file, old, new, message):
    replace(folder / file, old, new)
    name = Path(file).stem
    monkeypatch.setenv("TMPDIR", str(folder))  # where a traceback is kept
    monkeypatch.setattr(tempfile, "tempdir", None)
    assert message in refusal(monkeypatch, *shlex.split(TRAININGS[name]))
    assert not (folder / name / "episodes.csv").exists()


# --- examples/ and docs/wrappers.md ---------------------------------------------------------------

EXAMPLE = ROOT / "examples" / "sb3_ppo.py"


def sb3_ppo(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLE), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_prints_a_row_for_each_seed_and_what_came_out():
    done = sb3_ppo("--seeds", "2", "--first-seed", "1000", "--steps", "256")
    assert done.returncode == 0, done.stderr
    rows = re.findall(r"(?m)^\| (\w+) \|(?:[^|]+\|){4}$", done.stdout)
    assert rows == ["seed", "1000", "1001", "mean"]
    assert "with curiosity minus without, last tenth: " in done.stdout
    assert re.search(r"(?m)^β, in tenths of training:( 0.40){10}$", done.stdout)


@pytest.mark.slow
def test_help_and_mistakes(monkeypatch, capsys):
    main = runpy.run_path(str(EXAMPLE))["main"]

    def refused(*words: str) -> str:
        """What it exits with, in place of its work, or the last line that it printed."""
        monkeypatch.setattr(sys, "argv", [str(EXAMPLE), *words])
        with pytest.raises(SystemExit) as ended:
            main()
        said = "".join(capsys.readouterr())
        return ended.value.code if isinstance(ended.value.code, str) else said.splitlines()[-1]

    assert refused("--help").startswith("example: python examples/sb3_ppo.py")
    for option, value, least in (("--seeds", 0, 1), ("--steps", -5, 1), ("--first-seed", -1, 0)):
        expected = f"{option} is {value}, but should be at least {least}"
        assert refused(option, str(value)).endswith(expected)
    assert refused("--beta", "x").endswith("--beta is 'x', but should be a number or learned")
    assert "beta.value is 20.0, but should be less" in refused("--beta", "20")
    for name in ("Foo", "CartPole-v9", "nope:Foo-v0"):
        line = refused("--environment", name)
        assert line.startswith(f"sb3_ppo: --environment {name!r} cannot be made: ")
        assert "\n" not in line
    few = refused("--environment", "Acrobot-v1", "--steps", "1", "--seeds", "1")
    assert few == "sb3_ppo: no episode ended in --steps 1: give more"


@pytest.mark.slow
def test_curiosity_changes_the_policy_and_not_what_is_counted():
    train = runpy.run_path(str(EXAMPLE))["train"]
    found = [train("DeepSea10-v0", beta, 1000, 1536) for beta in (None, 0.4, "learned")]
    (without, with_curiosity, learned), betas = zip(*found, strict=True)
    own = {*np.round(-0.001 * np.arange(11), 6), 0.99}  # Deep Sea's own returns, without a bonus
    for returns in (without, with_curiosity, learned):
        assert len(returns) >= 153 and set(np.round(returns, 6)) <= own
    assert (without[:25] == with_curiosity[:25]).all()  # until the first update, after 256 steps
    assert (without != with_curiosity).any() and (learned != with_curiosity).any()
    assert betas[0] == pytest.approx(np.zeros(10)) and betas[1] == pytest.approx(np.full(10, 0.4))
    assert np.ptp(betas[2]) > 0.05


@pytest.mark.slow
def test_what_the_page_shows_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "wrappers.md").read_text(encoding="utf-8")
    assert text.count("learn(10_000)") == 1
    text = text.replace("learn(10_000)", "learn(1)")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    names = {}
    for block in blocks:
        exec(block, names)
        env = names["env"]
        assert len(env.tracker.curiosity.memory) > 0  # the restored one's, too
    names["shared"].reset()
    assert names["shared"].step(np.arange(4))[1].shape == (4,)
    names["agent"].learn(1)


# --- Links ----------------------------------------------------------------------------------------

TOP = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
OTHERS = ("config/README.md", "reference/README.md", "reference/worlds/errata.md")
PAGES = [*(ROOT / name for name in (*TOP, *OTHERS)), *sorted((ROOT / "docs").glob("*.md"))]


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere_and_targets_of_make_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for path, _, anchor in re.findall(r"\]\(([^)#:]*)(#([^)]+))?\)", text):
        if path.startswith("../../actions/"):  # the badge: of the page's place at GitHub
            continue
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), anchor
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.search(r"^\.PHONY:(.*)$", makefile, re.MULTILINE)[1].split()
    assert set(re.findall(r"`make ([a-z-]+)[^`]*`", text)) <= set(targets)
