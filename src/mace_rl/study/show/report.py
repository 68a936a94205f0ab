"""The page itself: what the template `page.html` shows, from a study's outputs.

One file that needs nothing else: pictures and styles stand in it, there is no script, and its
content security policy has the browser refuse whatever would be loaded.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from matplotlib.colors import to_hex

from mace_rl.config.agent import PPOConfig
from mace_rl.study.compare.readings import draw_readings
from mace_rl.study.compare.summary import from_to
from mace_rl.study.compare.verdicts import FEWEST_SEEDS, POWER
from mace_rl.study.measure.metrics import all_metrics
from mace_rl.study.metrics_config import FigureConfig, MetricsConfig
from mace_rl.study.show import markdown as pages
from mace_rl.study.show import tables
from mace_rl.study.show.animations import Animation
from mace_rl.study.show.cells import as_html, number
from mace_rl.study.show.curves import PlotStyle, quantity, style
from mace_rl.study.show.markdown import Data, Ledger
from mace_rl.study.show.pictures import PICTURES
from mace_rl.study.show.svg import PAGE_COLOURS, panels, svg

TEMPLATE = Path(__file__).with_name("report.html")
FIGURES = ("1", "2")
MINUTE, HOUR = 60, 3600


@dataclass(frozen=True)
class Provenance:
    """How it was made."""

    command: str
    configuration: Mapping[str, str]  # text by file, in the order in which they are read
    ppo: Mapping[str, PPOConfig]  # by environment
    records: Sequence[Mapping[str, Any]]  # the `run.json` of every run


def page(
    data: Data,
    claims: Ledger,
    making: Provenance,
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
    environment.filters |= {"short": short, "duration": duration, "table": as_html}
    metrics, records = data["metrics"], making.records
    return environment.get_template(TEMPLATE.name).render(
        families=pages.families(claims),
        counted=pages.counted,
        ways=pages.ways,
        fewest=FEWEST_SEEDS,
        power=POWER,
        seeds=from_to(metrics.groupby(["env", "variant"]).size()),
        runs=len(records),
        seconds=sum(record["seconds"] for record in records),
        interruptions=sum(len(record["interruptions"]) for record in records),
        confidence=f"{100 * settings.confidence:g} %",
        window=settings.moving_average,
        environments=list(metrics["env"].unique()),
        labels=look.labels,
        colours={variant: style()(to_hex)(colour) for variant, colour in look.colours.items()},
        page_colours=PAGE_COLOURS,
        figures={figure: _panels(data, figure, settings, look) for figure in FIGURES},
        curved={figure: set(data[f"figure{figure}"]["variant"]) for figure in FIGURES},
        shown=animations[0],
        missing=animations[1],
        pictures=_pictures(data, claims, settings, look),
        tables=_tables(data, making, settings, look.labels),
        parts=lambda claim, how: _parts(claim, how, settings, look.labels),
        making=making,
        origins=_origins(records),
    )


def short(value: float) -> str:
    """A return with three significant digits, or all that stand before the point."""
    digits = 2 - math.floor(math.log10(abs(value))) if value else 0
    return number(value, max(digits, 0))


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    for unit, length in (("h", HOUR), ("min", MINUTE)):
        if seconds >= length:
            return f"{number(seconds / length, 1)} {unit}"
    return f"{number(seconds, 1)} s"


def _panels(data: Data, figure: str, settings: MetricsConfig, look: PlotStyle) -> dict[str, str]:
    """Figure 1 or 2, panel by panel."""
    curves, seeds = data[f"figure{figure}"], data[f"figure{figure}_seeds"]
    return panels(curves, seeds, quantity(figure, settings), look)


def _pictures(
    data: Data,
    claims: Ledger,
    settings: MetricsConfig,
    look: PlotStyle,
) -> dict[str, str]:
    """Those that are wider than a phone, as SVG by name; those that this study has data for."""
    look = look._replace(layout=FigureConfig(columns=3))
    made_of = {
        "every_seed": data["metrics"],
        "constants": data["metrics"] if settings.constants else None,
        "solved": data["metrics"] if settings.solved_return else None,
        "forest": claims or None,
    }
    drawn = {"readings": draw_readings(data["readings"], settings, look)}
    for name, found in made_of.items():
        if found is not None:
            drawn[name] = PICTURES[name].draw(PICTURES[name].data(found, settings), look)
    return {name: svg(figure, name, name.replace("_", " ")) for name, figure in drawn.items()}


def _tables(
    data: Data, making: Provenance, settings: MetricsConfig, labels: Mapping[str, str]
) -> dict[str, Any]:
    """Every table, by its name in the template."""
    costs = _costs(making.records, data["metrics"], labels)
    data = {name: tables.named(frame, labels) for name, frame in data.items()}
    means = pd.concat([data["table1"], data["supplement"]])
    return {
        "table1": tables.table1(data["table1"]),
        "readings": tables.readings(data["readings"], settings),
        "aggregate": tables.aggregate(data["aggregate"]),
        "comparisons": tables.comparisons(data["comparisons"], means, settings),
        "companions": tables.companions(data["supplement"], settings),
        "costs": costs,
        "ppo": tables.table2(making.ppo),
    }


def _parts(
    claim: Mapping[str, Any], how: str, settings: MetricsConfig, labels: Mapping[str, str]
) -> pd.DataFrame:
    """The parts of one claim."""
    names = dict(labels) | {metric.name: metric.label for metric in all_metrics(settings)}
    return tables.parts([claim], how, names).iloc[:, 1:]


def _costs(
    records: Sequence[Mapping[str, Any]], metrics: pd.DataFrame, labels: Mapping[str, str]
) -> pd.DataFrame:
    """What the runs of each environment and variant took, by their `run.json`."""
    frame = pd.DataFrame(
        [
            {key: record["config"][key] for key in ("environment", "variant", "seed")}
            | {key: record[key] for key in ("seconds", "peak_memory_mb")}
            for record in records
        ]
    ).rename(columns={"environment": "env"})
    frame = frame.merge(metrics[["env", "variant", "seed", "env_steps"]], validate="1:1")
    rows = [
        [
            env,
            labels[str(variant)],
            number(len(own)),
            number(own["env_steps"].sum() / 1000),
            duration(own["seconds"].median()),
            duration(own["seconds"].max()),
            duration(own["seconds"].sum()),
            number(own["peak_memory_mb"].max()),
        ]
        for (env, variant), own in frame.groupby(["env", "variant"], sort=False)
    ]
    heads = ["environment", "variant", "runs", "steps, thousands", "a run, median", "longest"]
    return pd.DataFrame(rows, columns=[*heads, "together", "memory, MB"])


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
