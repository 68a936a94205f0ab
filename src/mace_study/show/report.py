"""The report: what the template `report.html` shows, from a study's outputs.

One file that needs nothing else: pictures and styles stand in it, and there is no script.
"""

import html
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup
from matplotlib.colors import to_hex

from mace_rl.config.agent import PPOConfig
from mace_rl.runs.progress import duration
from mace_study.compare.claims_config import FEWEST_SEEDS, ClaimsConfig
from mace_study.compare.ledger import Answer
from mace_study.compare.summary import from_to
from mace_study.config.metrics import FigureConfig, MetricsConfig
from mace_study.measure.metrics import metric_labels
from mace_study.show import sections, tables
from mace_study.show.animations import Animation
from mace_study.show.curves import PlotStyle, quantity, style
from mace_study.show.pictures import PICTURES, Source
from mace_study.show.svg import PAGE_COLOURS, panels, svg

TEMPLATE = Path(__file__).with_name("report.html")
FIGURES = ("1", "2")


@dataclass(frozen=True)
class Provenance:
    """How the study's results were made."""

    command: str
    configuration: Mapping[str, str]  # text by file, in the order in which they are read
    ppo: Mapping[str, PPOConfig]  # by environment
    records: Sequence[Mapping[str, Any]]  # the `run.json` of every run


def page(
    data: sections.Data,
    answers: Sequence[Answer],
    claims: ClaimsConfig,
    provenance: Provenance,
    animations: tuple[Mapping[str, Sequence[Animation]], Sequence[str]],
    settings: MetricsConfig,
    look: PlotStyle,
) -> str:
    """The page as HTML; equal arguments give an equal page."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATE.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"three_digits": three_digits, "table": as_html, "note": _note}
    metrics, records = data["metrics"], provenance.records

    figures = {name: (data[f"figure{name}"], data[f"figure{name}_seeds"]) for name in FIGURES}
    names = dict(look.labels) | metric_labels(settings)
    return environment.get_template(TEMPLATE.name).render(
        claims=claims,
        families=sections.by_family(answers),
        counted=sections.counted,
        parts=lambda answer, how: tables.parts([answer], how, names).iloc[:, 1:],
        parts_note=sections.PARTS,
        fewest=FEWEST_SEEDS,
        seeds=from_to(metrics.groupby(["env", "variant"]).size()),
        runs=len(records),
        time=duration(sum(record["seconds"] for record in records)),
        confidence=f"{100 * settings.confidence:g} %",
        window=settings.moving_average,
        environments=list(metrics["env"].unique()),
        labels=look.labels,
        colours={variant: style()(to_hex)(colour) for variant, colour in look.colours.items()},
        page_colours=PAGE_COLOURS,
        figures={k: panels(*own, quantity(k, settings), look) for k, own in figures.items()},
        curved={name: set(curves["variant"]) for name, (curves, _) in figures.items()},
        shown=animations[0],
        missing=animations[1],
        pictures=_pictures(Source(data, answers, settings, claims), look),
        sections=_sections(data, claims, provenance, settings, look.labels),
        provenance=provenance,
        origins=_origins(records),
    )


def three_digits(value: float) -> str:
    """A return with three significant digits, or all that stand before the point."""
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return tables.number(value, max(digits, 0))


def as_html(frame: pd.DataFrame) -> Markup:
    """A table as HTML, for the style sheet of the report: words left, numbers right."""
    rows = [[_html(cell) for cell in row] for row in frame.to_numpy()]
    words = [all(isinstance(cell, str) for cell in frame.iloc[:, i]) for i in range(len(frame.T))]

    def line(tag: str, cells: Sequence[str]) -> str:
        left = [' class="left"' if word else "" for word in words]
        whole = "".join(f"<{tag}{x}>{cell}</{tag}>" for x, cell in zip(left, cells, strict=True))
        return f"<tr>{whole}</tr>"

    head = line("th", [html.escape(name) for name in frame.columns])
    body = [line("td", row) for row in rows]
    lines = ["<thead>", head, "</thead>", "<tbody>", *body, "</tbody>"]
    return Markup('<div class="scroll"><table class="data">' + "\n".join(lines) + "</table></div>")


def _html(cell: str | tables.Cell) -> str:
    if isinstance(cell, str):
        return html.escape(cell)
    texts = [
        f'<span class="nowrap{" best" if one.best else ""}">{html.escape(one.text)}'
        f"<sup>{one.mark}</sup></span>"
        for one in cell.values
    ]
    intervals = [f"{one.low} to {one.high}" for one in cell.values if one.low]
    below = [cell.joint.join(intervals), html.escape(cell.note)]
    return cell.joint.join(texts) + "".join(f"<small>{line}</small>" for line in below if line)


def _note(text: str) -> Markup:
    """The note of a section, of which words between asterisks are italic."""
    return Markup(re.sub(r"\*([^*]+)\*", r"<i>\1</i>", html.escape(text)))


def _pictures(source: Source, look: PlotStyle) -> dict[str, str]:
    """Those that are wider than a phone, as SVG by name; those that this study has data for."""
    look = look._replace(layout=FigureConfig(columns=3))
    return {
        name: svg(picture.draw(picture.data(source), look), name, name.replace("_", " "))
        for name, picture in PICTURES.items()
        if picture.fits(source)
    }


def _sections(
    data: sections.Data,
    claims: ClaimsConfig,
    provenance: Provenance,
    settings: MetricsConfig,
    names: Mapping[str, str],
) -> dict[str, sections.Section]:
    """Every table but the ledger's, by its title, and three that the pages of Markdown lack."""
    compared = tables.named(data["comparisons"], names)
    means = pd.concat([data["table1"], data["supplement"]])
    note = (
        "Differences are paired by seed, with Holm's correction over the whole table. *P* is the"
        " probability that a run of the first is better than one of the second."
    )
    costs = tables.costs(provenance.records, data["metrics"], names)
    interruptions = sum(len(record["interruptions"]) for record in provenance.records)
    machine = "As each run's run.json has it; one core a run, no GPU."
    compared = tables.comparisons(compared, means, settings)
    ppo = tables.table2(provenance.ppo, claims.table2)
    found = sections.of_runs(data, claims, settings, names)
    found += [
        sections.Section("Variants against each other, on every metric", note, compared),
        sections.Section("Costs", f"{machine} Interruptions: {interruptions}.", costs),
        sections.Section("PPO's settings, as resolved", "Table 2; for LaTeX table2.tex.", ppo),
    ]
    return {section.title: section for section in found}


def _origins(records: Sequence[Mapping[str, Any]]) -> dict[str, list[tuple[str, int]]]:
    """What the runs were made with and how many runs each, most first."""
    found: dict[str, Counter[str]] = {name: Counter() for name in ("code", "machine", "software")}
    for record in records:
        commit, dirty = record["code"]["commit"], record["code"]["dirty"]
        changed = " with uncommitted changes" if dirty else ""
        found["code"][f"commit {commit[:12]}{changed}" if commit else "not from git"] += 1
        machine = record["machine"]
        found["machine"][f"{machine['cpu']}, {machine['cores']} cores, {machine['system']}"] += 1
        versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
        found["software"][versions] += 1
    return {name: counter.most_common() for name, counter in found.items()}
