"""What others read of this project by convention: citation, catalog, changelog, links."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_citation_is_of_this_version_and_of_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()  # what 1.2.0 requires
    assert citation["cff-version"] == "1.2.0" and citation["type"] == "software"
    assert citation["version"] == PROJECT["version"]
    assert README.startswith(f"# {citation['title']}\n")
    assert (ROOT / "LICENSE").read_text().startswith(f"{citation['license']} License\n")
    (paper,) = citation["references"]
    assert {"type", "title", "authors"} <= paper.keys()
    readme = " ".join(README.split())
    assert f"[*{paper['title']}*]({paper['url']})" in readme
    for author in citation["authors"] + paper["authors"]:
        assert author.keys() == {"name"}, "an entity: persons are not named"


def test_the_changelog_has_the_form_it_says():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    versions = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert versions[0] == "[Unreleased]"
    assert all(re.fullmatch(r"\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d", line) for line in versions[1:])
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert set(re.findall(r"^### (.*)$", text, re.MULTILINE)) <= kinds
    assert PROJECT["version"] in text


def test_the_catalog_is_told_what_is_so():
    entry = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text(encoding="utf-8"))
    usage = entry.pop("usage")
    assert not entry and usage.keys() == {
        "mandatory-flags",
        "software-stack-deployment",
        "report",
    }
    assert usage["mandatory-flags"].keys() == {"desc", "flags"}
    deployment = usage["software-stack-deployment"]
    assert deployment.keys() == {"conda", "apptainer", "apptainer+conda"}
    rules = [path.read_text(encoding="utf-8") for path in ROOT.glob("workflow/rules/*.smk")]
    assert any(deployment.values()) == any("conda:" in text for text in rules)
    assert usage["report"] == any("report(" in text for text in rules)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere_and_targets_of_make_exist(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / link).exists(), link
    targets = set(re.search(r"^\.PHONY:(.*)$", MAKEFILE, re.MULTILINE)[1].split())
    named = re.findall(r"`make ([a-z-]+)[^`]*`", text)
    assert not set(named) - targets
    headings = {
        target: {
            re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
            for heading in re.findall(
                r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE
            )
        }
        for target in PAGES
    }
    for path, anchor in re.findall(r"\]\(([^)#:]*)#([^)]+)\)", text):
        assert anchor in headings[(page.parent / path).resolve() if path else page], anchor


@pytest.mark.slow
@pytest.mark.parametrize(
    "tool",
    ["benchmarks", *(f"tools.{path.stem}" for path in sorted((ROOT / "tools").glob("[!_]*.py")))],
)
def test_help_of_a_tool_has_an_example(tool):
    command = [sys.executable, "-m", tool, "--help"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert f"example: python -m {tool}" in " ".join(said.split())
