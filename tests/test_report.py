"""The report and the page of tables of a tiny study, as a browser without network has it."""

import base64
import io
import json
import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from itertools import product
from pathlib import Path

import pandas as pd
import pytest
import yaml
from invented import CLAIMS, ENVIRONMENTS, ROOT, VARIANTS
from PIL import Image

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.runs.provenance import read_record
from mace_rl.runs.run import run
from mace_study.config.metrics import ConstantsConfig
from mace_study.config.study import read_study
from mace_study.show.animations import animations
from mace_study.show.curves import plot_style
from mace_study.show.report import Provenance, three_digits
from mace_study.show.report import page as build
from mace_study.show.sections import read_data
from mace_study.show.tables import costs, number

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
SECTIONS = ["verdicts", "learning", "table1", "agents", "beta"]
SECTIONS += ["ranking", "statistics", "ledger", "costs", "workflow", "configuration"]
MOST_BYTES = 25_000_000


class Page(HTMLParser):
    """The elements of a page by the section in which they are, and the text of each section."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, str, dict[str, str | None]]] = []  # section, tag, attributes
        self.text: dict[str, str] = {}
        self.section, self.style, self.in_style = "", "", False
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag == "section":
            self.section = dict(attributes)["aria-labelledby"] or ""
        self.in_style = tag == "style"
        self.elements.append((self.section, tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        self.in_style = False
        if tag in ("td", "th", "p", "h2", "h3", "text", "summary", "span"):
            self.handle_data(" ")

    def handle_data(self, data: str) -> None:
        if self.in_style:
            self.style += data
        else:
            self.text[self.section] = self.text.get(self.section, "") + data

    def words(self, section: str) -> str:
        return " ".join(self.text[section].split())

    def all(self, section: str, tag: str) -> list[dict[str, str | None]]:
        return [found for where, name, found in self.elements if (where, name) == (section, tag)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study of everything that the paper has, in miniature, and its report."""
    folder = tmp_path_factory.mktemp("report")
    shutil.copy2(ROOT / "config.yaml", folder)
    hopper = {"HopperBulletEnv-v0": {"episodes": 4}}
    tiny = {"seeds": [0, 1], "training": {"episodes": 4}, "environment_settings": hopper}
    (folder / "tiny.yaml").write_text(yaml.safe_dump(tiny), encoding="utf-8")
    study = read_study([folder / "config.yaml", folder / "tiny.yaml"])
    for env, variant, seed in study.runs():
        place = folder / "results/runs" / env / variant / f"seed{seed}"
        run(study.run_config(env, variant, seed), place)
    command = [sys.executable, "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "--cores", "2"]
    command += ["--allowed-rules", "metrics", "tables", "pictures", "page"]
    command += ["--configfile", "tiny.yaml", "--", "page", "results/tables.md"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return folder


pytestmark = pytest.mark.slow


NO_BROWSER = BROWSER is None and "CI" not in os.environ


@pytest.mark.skipif(NO_BROWSER, reason="needs chromium (Debian: apt install)")
def test_a_browser_without_network_shows_all_of_it(made: Path, tmp_path: Path) -> None:
    results = made / "results"
    command = [BROWSER or "chromium", "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--proxy-server=127.0.0.1:9", f"--user-data-dir={tmp_path}/profile"]
    command += ["--dump-dom", (results / "report.html").as_uri()]
    dumped = subprocess.run(command, capture_output=True, timeout=120, check=True)
    page = Page(dumped.stdout.decode())

    # Every section is there and says what to see; references lead somewhere.
    assert [found for found in page.text if found] == SECTIONS
    for section in SECTIONS[:-1]:
        assert "What to see:" in page.words(section), section
    ids = [found["id"] for _, _, found in page.elements if "id" in found]
    used = {found[name] for _, _, found in page.elements for name in found if "href" in name}
    clips = re.findall(r"url\((#[^)]*)\)", " ".join(str(found) for _, _, found in page.elements))
    assert len(ids) == len(set(ids)) and {*used, *clips} <= {f"#{name}" for name in ids}

    # Nothing is loaded from elsewhere.
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
    assert (results / "report.html").stat().st_size < MOST_BYTES

    # Each claim has its verdicts and its parts.
    ledger = json.loads((results / "claims.json").read_text(encoding="utf-8"))["claims"]
    judged = [record[how] for record in ledger for how in CLAIMS.ways if how in record]
    assert [found["class"] for found in page.all("verdicts", "td")] == ["open"] * len(judged)
    counted = "0 reproduced, 0 not reproduced, 10 cannot tell (too few seeds)"
    assert counted in page.words("verdicts")
    claims = [found["id"] for found in page.all("ledger", "details")]
    assert claims == [*(f"C{n}" for n in range(1, 11)), *(f"W{n}" for n in range(1, 5))]
    assert all(record["statement"] in page.words("ledger") for record in ledger)
    rows = sum(len(one["parts"]) for one in judged)
    assert len(page.all("ledger", "tr")) == rows + len(judged)

    # Figures have a panel for each environment.
    for section, figure in (("learning", "1"), ("beta", "2")):
        found = page.all(section, "figure")
        shown = [(one["data-figure"], one["data-environment"]) for one in found]
        assert shown == [(figure, environment) for environment in ENVIRONMENTS]
        assert len(page.all(section, "svg")) == len(ENVIRONMENTS)
    assert "PPO (Baseline)" not in page.words("beta")
    assert [one["aria-label"] for one in page.all("ranking", "svg")] == ["readings"]
    assert [one["aria-label"] for one in page.all("statistics", "svg")] == ["every seed"]
    assert [one["aria-label"] for one in page.all("ledger", "svg")] == ["forest"]

    # Tables have the numbers of their files, in the report and on the page of tables.
    text = (results / "tables.md").read_text(encoding="utf-8")
    for row in pd.read_csv(results / "table1.csv").itertuples():
        for said in (page.words("table1"), text):
            assert f"{row.mean:.0f}" in said and f"{row.low:.0f} to {row.high:.0f}" in said
    for row in pd.read_csv(results / "comparisons.csv").query("env != 'all'").itertuples():
        assert number(row.probability, 2) in page.words("statistics")
    assert len(page.all("costs", "tr")) == 1 + len(ENVIRONMENTS) * len(VARIANTS)
    assert "18 trainings" in page.words("") and "torch 2." in page.words("workflow")
    assert "GAE Parameter" in page.words("configuration")
    for file in ("config.yaml", "tiny.yaml"):
        content = (made / file).read_text(encoding="utf-8")
        assert " ".join(content.split()) in page.words("configuration")

    # Each agent is shown beside an untrained one.
    agents = {
        (one["data-environment"], variant, one["data-trained"])
        for one in page.all("agents", "figure")
        for variant in (one["data-variants"] or "").split()
    }
    assert agents == {(e, v, yes) for e in ENVIRONMENTS for v in VARIANTS for yes in ("yes", "no")}
    for image in page.all("agents", "img"):
        kind, _, data = (image["src"] or "").partition(",")
        assert kind == "data:image/gif;base64" and len(data) < 4 / 3 * 400_000
        with Image.open(io.BytesIO(base64.b64decode(data))) as film:
            film.load()
            assert film.n_frames > 2 and film.width == 200


def test_a_study_without_claims_agents_or_bonus_says_so(made: Path, monkeypatch) -> None:
    """From the same files, some left out; made twice, it is the same."""
    study = read_study([made / "config.yaml", made / "tiny.yaml"])
    chosen = ConstantsConfig(learned="mace_full", fixed=["ppo", "mace_fixed"])
    settings = study.metrics.within(study.environments, study.variants)
    settings = settings.model_copy(update={"constants": chosen})
    runs = [(*key, study.run_config(*key).episodes) for key in study.runs()]
    tables = {path.stem: path for path in (made / "results").glob("*.csv")}
    data, claims = read_data(tables, runs, settings)
    assert not claims
    data["figure2"] = data["figure2"].head(0)
    records = [read_record(path) for path in (made / "results").glob("runs/*/*/*/run.json")]
    ppo = {"CartPole-v1": study.run_config("CartPole-v1", "ppo", 0).ppo}
    making = Provenance("a command", {}, ppo, records)
    monkeypatch.chdir(made)  # folders as Snakemake has them
    films = animations({("CartPole-v1", v): Path(v) for v in VARIANTS}, study.labels, made)
    look = plot_style(settings, study.figure.model_dump(), study.labels, study.colours)
    how = CLAIMS, making, films, settings, look
    html = build(data, claims, *how)
    assert html == build(data, claims, *how)
    page = Page(html)
    assert page.words("verdicts").startswith("Verdicts There are no verdicts")
    assert "This study has no ledger" in page.words("ledger")
    assert f"agent.pt is not there, are the agents of {', '.join(VARIANTS)}" in page.words("agents")
    assert not page.all("agents", "img")
    assert "constants" in [one.get("aria-label") for one in page.all("statistics", "svg")]
    assert "β is 0 throughout" in page.words("beta")


def test_agents_that_do_the_same_untrained_share_a_film(made, run_config, tmp_path) -> None:
    hopper, seed1 = made / "results/runs/HopperBulletEnv-v0", tmp_path / "seed1"
    runs = {("HopperBulletEnv-v0", variant): hopper / variant / "seed0" for variant in VARIANTS}
    labels = {variant: variant.upper() for variant in VARIANTS}
    before, *after = animations(runs, labels, made / "results")[0]["HopperBulletEnv-v0"]
    assert (before.title, before.trained) == ("Before training", False)
    assert before.variants == tuple(VARIANTS)
    told = [(one.title, one.variants, one.trained) for one in after]
    assert told == [(labels[variant], (variant,), True) for variant in VARIANTS]
    shutil.copytree(hopper / "ppo/seed1", seed1)
    runs["HopperBulletEnv-v0", "ppo"] = seed1
    first, second, *_ = animations(runs, labels, tmp_path)[0]["HopperBulletEnv-v0"]
    assert first.title == "Before training: PPO"
    assert second.title == "Before training: MACE_FIXED, MACE_FULL"
    (seed1 / files.AGENT).write_bytes(b"another")
    with pytest.raises(Refusal, match=r"agent\.pt: missing, cut off or altered"):
        animations({("HopperBulletEnv-v0", "ppo"): seed1}, labels, tmp_path)
    # An environment that cannot be drawn is said.
    run(run_config("PlantedHelp-v0", episodes=1), tmp_path / "planted")
    shown, missing = animations({("PlantedHelp-v0", "ppo"): tmp_path / "planted"}, labels, tmp_path)
    assert not shown
    assert missing[0].startswith("environment 'PlantedHelp-v0' cannot be drawn")


def test_costs_and_times() -> None:
    runs = [
        {"environment": "A-v0", "variant": variant, "seed": seed}
        for variant, seed in product(("ppo", "full"), range(3))
    ]
    records = [{"config": one, "peak_memory_mb": 300 + one["seed"]} for one in runs]
    for record, one in zip(records, runs, strict=True):
        record["seconds"] = 10.0 ** one["seed"] * (1 + (one["variant"] == "full"))
    metrics = pd.DataFrame(runs).rename(columns={"environment": "env"}).assign(env_steps=7000)
    plain, full = costs(records, metrics[::-1], {"ppo": "PPO", "full": "Full"}).to_numpy().tolist()
    assert plain == ["A-v0", "PPO", "3", "21", "10 s", "100 s", "2 min", "302"]
    assert full[-2] == "4 min"
    assert list(map(three_digits, (0.9921, -83.0, 1841.9, 0.0))) == ["0.992", "−83.0", "1842", "0"]
