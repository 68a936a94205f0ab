"""The report of a tiny study, as a browser without network has it."""

import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pytest
import yaml
from PIL import Image

from mace_rl import files
from mace_rl.config.results import RegretConfig
from mace_rl.config.study import read_study
from mace_rl.report.animations import animations
from mace_rl.report.page import Making, number, read_tables
from mace_rl.report.page import page as build
from mace_rl.report.workflow_graph import graph
from mace_rl.results.claims import LITERAL, ROBUST
from mace_rl.results.comparisons import regret
from mace_rl.results.metrics import all_metrics
from mace_rl.results.paper import ENVIRONMENTS, VARIANTS
from mace_rl.runs.checkpoint import CheckpointError
from mace_rl.runs.provenance import read_record
from mace_rl.runs.run import run
from tools.tables import RULES

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config.yaml"

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
needs_browser = pytest.mark.skipif(
    BROWSER is None and "CI" not in os.environ, reason="needs chromium (Debian: apt install)"
)
SECTIONS = ["verdicts", "learning", "table1", "agents", "beta"]
SECTIONS += ["ranking", "statistics", "ledger", "costs", "workflow", "configuration"]
MOST_BYTES = 25_000_000


class Page(HTMLParser):
    """The elements of a page by the section in which they are, and the text of each section."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, str, dict[str, str | None]]] = []  # section, tag, attributes
        self.text: dict[str, str] = {}
        self.section = ""
        self.in_style = False
        self.style = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag == "section":
            self.section = dict(attributes)["aria-labelledby"] or ""
        self.in_style = tag == "style"
        self.elements.append((self.section, tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        self.in_style = False
        if tag in ("td", "th", "p", "h2", "h3", "text", "summary"):
            self.handle_data(" ")

    def handle_data(self, data: str) -> None:
        if self.in_style:
            self.style += data
        else:
            self.text[self.section] = self.text.get(self.section, "") + data

    def words(self, section: str) -> str:
        """The section's text with single spaces."""
        return " ".join(self.text[section].split())

    def all(self, section: str, tag: str) -> list[dict[str, str | None]]:
        """The attributes of each such element."""
        return [found for where, name, found in self.elements if (where, name) == (section, tag)]


def opened(path: Path, tmp_path: Path) -> Page:
    """The page as the browser understands it, which has no network."""
    command = [BROWSER or "chromium", "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--proxy-server=127.0.0.1:9", f"--user-data-dir={tmp_path}/profile"]
    command += ["--dump-dom", path.as_uri()]
    dumped = subprocess.run(command, capture_output=True, timeout=120, check=True)
    return Page(dumped.stdout.decode())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study of everything that the paper has, in miniature, and its report."""
    folder = tmp_path_factory.mktemp("report")
    shutil.copy2(CONFIG, folder / "config.yaml")
    hopper = {"HopperBulletEnv-v0": {"episodes": 4}}
    tiny = {"seeds": [0, 1], "training": {"episodes": 4}, "environment_settings": hopper}
    (folder / "tiny.yaml").write_text(yaml.safe_dump(tiny), encoding="utf-8")
    study = read_study([folder / "config.yaml", folder / "tiny.yaml"])
    for env, variant, seed in study.runs():
        place = folder / "results/runs" / env / variant / f"seed{seed}"
        run(study.run_config(env, variant, seed), place)
    command = [sys.executable, "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "--cores", "2"]
    command += ["--allowed-rules", *RULES, "--configfile", "tiny.yaml", "--", "page"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def page(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    """The report, opened."""
    return opened((made / "results/report.html"), tmp_path_factory.mktemp("browser"))


pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("report")]


@needs_browser
def test_every_section_is_there_and_says_what_to_see(page: Page) -> None:
    assert [found for found in page.text if found] == SECTIONS
    for section in SECTIONS[:-1]:
        assert "What to see:" in page.words(section), section
    links = {found["href"] for found in page.all("", "a")}
    assert {f"#{section}" for section in SECTIONS} <= links


@needs_browser
def test_nothing_is_loaded_from_elsewhere(page: Page, made: Path) -> None:
    for _, tag, attributes in page.elements:
        assert tag not in ("script", "link", "iframe", "object", "embed", "base"), tag
        for name in ("src", "srcset", "poster", "data", "background"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, name)
        for name in ("href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith("#"), (tag, name)
        assert "url(" not in re.sub(r"url\(#[^)]*\)", "", attributes.get("style") or "")
    assert not re.search(r"@import|url\(", page.style.replace("url(#", "#"))
    (policy,) = [found for found in page.all("", "meta") if "http-equiv" in found]
    assert (policy["content"] or "").startswith("default-src 'none'")
    assert (made / "results/report.html").stat().st_size < MOST_BYTES


@needs_browser
def test_ids_are_there_once_and_references_lead_somewhere(page: Page) -> None:
    ids = [found["id"] for _, _, found in page.elements if "id" in found]
    assert len(ids) == len(set(ids))
    used = {found[name] for _, _, found in page.elements for name in found if "href" in name}
    clips = re.findall(r"url\((#[^)]*)\)", " ".join(str(found) for _, _, found in page.elements))
    assert {*used, *clips} <= {f"#{name}" for name in ids}


@needs_browser
def test_each_claim_has_its_verdicts_and_its_parts(page: Page, made: Path) -> None:
    ledger = json.loads((made / "results/claims.json").read_text(encoding="utf-8"))["claims"]
    squares = page.all("verdicts", "td")
    assert [found["class"] for found in squares] == ["inconclusive"] * 20
    assert "none is reproduced, none is contradicted and 10 are inconclusive" in page.words(
        "verdicts"
    )
    assert ", as in Acrobot-v1, CartPole-v1, HopperBulletEnv-v0, every part" in page.words(
        "verdicts"
    )
    claims = page.all("ledger", "details")
    assert [found["id"] for found in claims] == [f"C{n}" for n in range(1, 11)]
    for record in ledger:
        assert record["statement"] in page.words("ledger")
    rows = sum(len(record[how]["parts"]) for record in ledger for how in (LITERAL, ROBUST))
    heads = 2 * len(claims)
    assert len(page.all("ledger", "tr")) == rows + heads


@needs_browser
def test_figures_have_a_panel_for_each_environment(page: Page) -> None:
    for section, figure in (("learning", "1"), ("beta", "2")):
        found = page.all(section, "figure")
        assert [(one["data-figure"], one["data-environment"]) for one in found] == [
            (figure, environment) for environment in ENVIRONMENTS
        ]
        assert len(page.all(section, "svg")) == len(ENVIRONMENTS)
        assert all(environment in page.text[section] for environment in ENVIRONMENTS)
    assert "PPO (Baseline)" not in page.words("beta")
    assert [one["aria-label"] for one in page.all("ranking", "svg")] == ["readings"]
    shown = [one["aria-label"] for one in page.all("statistics", "svg")]
    assert shown == ["every seed"]
    assert "returns shuffled" in page.words("ranking")


@needs_browser
def test_table_1_has_the_numbers_of_its_file(page: Page, made: Path) -> None:
    said = page.words("table1")
    for row in pd.read_csv(made / "results/table1.csv").itertuples():
        assert f" {row.mean:.0f}" in said and f"{row.low:.0f} to {row.high:.0f}" in said
        assert " ".join(number(row.paper).split()) in said
    assert len(page.all("table1", "tr")) == 1 + 3 * (1 + 3)


@needs_browser
def test_each_agent_is_shown_beside_an_untrained_one(page: Page) -> None:
    shown = {
        (one["data-environment"], variant, one["data-trained"])
        for one in page.all("agents", "figure")
        for variant in (one["data-variants"] or "").split()
    }
    assert shown == {(e, v, yes) for e in ENVIRONMENTS for v in VARIANTS for yes in ("yes", "no")}
    for image in page.all("agents", "img"):
        kind, _, data = (image["src"] or "").partition(",")
        assert kind == "data:image/gif;base64" and len(data) < 4 / 3 * 400_000
        with Image.open(io.BytesIO(base64.b64decode(data))) as film:
            film.load()
            assert film.n_frames > 2 and film.width == 200


@needs_browser
def test_costs_workflow_and_configuration(page: Page, made: Path) -> None:
    assert len(page.all("costs", "tr")) == 1 + 3 * (1 + 3) + 1
    steps = pd.read_csv(made / "results/metrics.csv")["env_steps"]
    assert len(steps) == 18 and " 18 " in page.words("costs")
    files_of_rules = ROOT.glob("workflow/rules/*.smk")
    rules = re.findall(r"^rule (\w+):", "".join(p.read_text() for p in files_of_rules), re.M)
    rules.remove("picture")  # the page draws its own
    nodes = page.all("workflow", "rect")
    assert len(nodes) == len(rules) and all(rule in page.words("workflow") for rule in rules)
    assert "18 runs" in page.words("workflow") and "torch 2." in page.words("workflow")
    for file in ("config.yaml", "tiny.yaml"):
        text = (made / file).read_text(encoding="utf-8")
        assert " ".join(text.split()) in page.words("configuration")
    assert "gae lambda" in page.words("configuration")


@needs_browser
def test_a_study_without_claims_agents_or_bonus_says_so(made: Path, tmp_path: Path) -> None:
    """From the same files, some left out, with a regret; made twice, it is the same."""
    study = read_study([made / "config.yaml", made / "tiny.yaml"])
    regret_of = {"variant": "mace_full", "constants": ["ppo", "mace_fixed"]}
    settings = study.metrics.within(study.environments, study.variants).model_copy(
        update={"regret": RegretConfig(**regret_of)}
    )
    results = made / "results"
    found = {name: results / f"{name}.csv" for name in ("metrics", "table1", "supplement")}
    found |= {name: results / f"{name}.csv" for name in ("comparisons", "aggregate", "readings")}
    for figure in "12":
        found |= {f"curves{figure}": results / f"figure{figure}.csv"}
        found |= {f"seeds{figure}": results / f"figure{figure}_seeds.csv"}
    tables = read_tables(found, study.runs(), settings)
    tables = replace(
        tables,
        curves={**tables.curves, "2": tables.curves["2"].head(0)},
        regret=regret(tables.metrics, settings),
    )
    records = [read_record(path) for path in results.glob("runs/*/*/*/run.json")]
    ppo = {"CartPole-v1": study.run_config("CartPole-v1", "ppo", 0).ppo.model_dump()}
    making = Making(
        "a command", {}, {"seeds": [0, 1]}, ppo, graph("train", {"train": []}, {}), records
    )
    runs = {("CartPole-v1", variant): tmp_path / f"runs/{variant}" for variant in VARIANTS}
    films = animations(runs, study.labels, tmp_path)
    html = [build(tables, making, films, settings, study.labels, study.colours) for _ in range(2)]
    assert html[0] == html[1]
    (tmp_path / "report.html").write_text(html[0], encoding="utf-8")
    page = opened(tmp_path / "report.html", tmp_path)
    assert page.words("verdicts").startswith("Verdicts There are no verdicts")
    assert "This study has no ledger" in page.words("ledger")
    for variant in VARIANTS:
        assert f"runs/{variant}" in page.words("agents")
    assert "Not shown, because agent.pt is not there" in page.words("agents")
    assert not page.all("agents", "img")
    assert "constants" in [one.get("aria-label") for one in page.all("statistics", "svg")]
    assert "loses against the best constant" in page.words("statistics")
    assert "β is 0 throughout" in page.words("beta")
    assert "on the command line over them seeds=0, 1" in page.words("configuration")
    # Without the common bar of some environment it is that which is missed, and what is left holds.
    settings = settings.model_copy(update={"reference_return": {}})
    known = {metric.name for metric in all_metrics(settings)}
    tables = replace(
        tables,
        comparisons=tables.comparisons[tables.comparisons["metric"].isin(known)],
        supplement=tables.supplement[tables.supplement["metric"].isin(known)],
        readings=tables.readings[tables.readings["reading"].isin(known)],
    )
    html = build(tables, making, films, settings, study.labels, study.colours)
    words = Page(html).words("verdicts")
    assert "metrics.reference_return has none for some environment" in words


def test_agents_that_do_the_same_untrained_share_a_film(made: Path, tmp_path: Path) -> None:
    hopper, seed1 = made / "results/runs/HopperBulletEnv-v0", tmp_path / "seed1"
    runs = {("HopperBulletEnv-v0", variant): hopper / variant / "seed0" for variant in VARIANTS}
    labels = {variant: variant.upper() for variant in VARIANTS}
    before, *after = animations(runs, labels, made / "results").shown["HopperBulletEnv-v0"]
    assert (before.title, before.variants, before.trained) == ("Before training", VARIANTS, False)
    assert [(one.title, one.variants, one.trained) for one in after] == [
        (labels[variant], (variant,), True) for variant in VARIANTS
    ]
    shutil.copytree(hopper / "ppo/seed1", seed1)
    runs["HopperBulletEnv-v0", "ppo"] = seed1
    first, second, *_ = animations(runs, labels, tmp_path).shown["HopperBulletEnv-v0"]
    assert first.title == "Before training: PPO"
    assert second.title == "Before training: MACE_FIXED, MACE_FULL"
    (seed1 / files.AGENT).write_bytes(b"another")
    with pytest.raises(CheckpointError, match=r"agent\.pt: missing, cut off or altered"):
        animations({("HopperBulletEnv-v0", "ppo"): seed1}, labels, tmp_path)


def test_an_environment_that_cannot_be_drawn_is_said(run_config, tmp_path: Path) -> None:
    run(run_config("PlantedHelp-v0", episodes=1), tmp_path)
    films = animations({("PlantedHelp-v0", "ppo"): tmp_path}, {"ppo": "PPO"}, tmp_path)
    assert not films.shown
    (sentence,) = films.missing
    assert sentence.startswith("environment 'PlantedHelp-v0' cannot be drawn")


def test_a_rule_stands_right_of_what_it_needs() -> None:
    needs = {"a": [], "b": ["a"], "c": ["a", "b"], "d": [], "e": ["c", "d"]}
    drawn = graph("e", {**needs, "f": ["a"]}, {"a": "3 runs"})
    x = {node.rule: node.x for node in drawn.nodes}
    assert x["a"] < x["b"] < x["c"] == x["d"] < x["e"]
    assert len({(node.x, node.y) for node in drawn.nodes}) == len(needs)
    assert len(drawn.curves) == 4  # not from a to c, as b is between
    assert {node.rule: node.note for node in drawn.nodes}["a"] == "3 runs"
