"""The page itself: what the template `page.html` shows, from a study's outputs.

One file that needs nothing else: pictures and styles stand in it, there is no script, and its
content security policy has the browser refuse whatever would be loaded.
"""

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas as pd
from matplotlib.colors import to_hex

from mace_rl.config.results import FigureConfig, MetricsConfig
from mace_rl.report.animations import Animations
from mace_rl.report.panels import PAGE_COLOURS, panels, svg
from mace_rl.report.workflow_graph import BOX_HEIGHT, BOX_WIDTH, Graph
from mace_rl.results.claims import FEWEST_SEEDS, LITERAL, POWER, ROBUST
from mace_rl.results.claims_text import digits_of
from mace_rl.results.figures import Look, quantity
from mace_rl.results.metrics import all_metrics
from mace_rl.results.metrics_table import read_metrics
from mace_rl.results.paper import PAPER_METRICS, has_all
from mace_rl.results.pictures import PICTURES
from mace_rl.results.readings import draw_readings, in_order, ranked, title
from mace_rl.results.records import RunKey
from mace_rl.results.tables import digits_by_metric, from_to

TEMPLATE = Path(__file__).with_name("page.html")
FIGURES = ("1", "2")
VERDICTS = ("reproduced", "contradicted", "inconclusive")
MINUTE, HOUR = 60, 3600


@dataclass(frozen=True)
class Tables:
    """The study's data as its files have them."""

    metrics: pd.DataFrame
    table1: pd.DataFrame
    supplement: pd.DataFrame
    comparisons: pd.DataFrame
    aggregate: pd.DataFrame
    readings: pd.DataFrame
    curves: Mapping[str, pd.DataFrame]  # by the figure's number
    single_seeds: Mapping[str, pd.DataFrame]
    regret: pd.DataFrame | None  # where the configuration asks for it
    claims: Mapping[str, Any] | None  # where the study has what the paper makes claims of


def read_tables(
    found: Mapping[str, Any], runs: Sequence[RunKey], settings: MetricsConfig
) -> Tables:
    """The data of these runs, from the files `found` by the names that the rule `page` has."""
    names = ("table1", "supplement", "comparisons", "aggregate", "readings")
    claims = found.get("claims")
    return Tables(
        metrics=read_metrics(found["metrics"], runs, settings),
        **{name: pd.read_csv(found[name]) for name in names},
        curves={figure: pd.read_csv(found[f"curves{figure}"]) for figure in FIGURES},
        single_seeds={figure: pd.read_csv(found[f"seeds{figure}"]) for figure in FIGURES},
        regret=pd.read_csv(found["regret"]) if found.get("regret") else None,
        claims=json.loads(Path(claims).read_text(encoding="utf-8")) if claims else None,
    )


@dataclass(frozen=True)
class Making:
    """How it was made."""

    command: str
    configuration: Mapping[str, str]  # text by file, in the order in which they are read
    given: Mapping[str, Any]  # on the command line, over them
    hyperparameters: Mapping[str, Mapping[str, Any]]  # of PPO, by environment
    workflow: Graph
    records: Sequence[Mapping[str, Any]]  # the `run.json` of every run


def page(
    tables: Tables,
    making: Making,
    animations: Animations,
    settings: MetricsConfig,
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> str:
    """The page as HTML; equal arguments give an equal page."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATE.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "short": short, "duration": duration, "value": _value}
    seeds = tables.metrics.groupby(["env", "variant"]).size()
    return environment.get_template(TEMPLATE.name).render(
        claims=_claims(tables.claims),
        counts=_counts(tables.claims),
        no_common_bar=has_all(tables.metrics["env"], labels) and not settings.reference_return,
        ways=(LITERAL, ROBUST),
        verdicts=VERDICTS,
        few=_too_few(tables.claims, tables.metrics["env"].unique()),
        fewest=FEWEST_SEEDS,
        power=POWER,
        seeds=from_to(seeds),
        confidence=f"{100 * settings.confidence:g} %",
        window=settings.moving_average,
        environments=list(tables.metrics["env"].unique()),
        labels=labels,
        colours={variant: to_hex(colour) for variant, colour in colours.items()},
        page_colours=PAGE_COLOURS,
        figures={
            figure: panels(
                tables.curves[figure],
                tables.single_seeds[figure],
                quantity(figure, settings),
                settings,
                labels,
                colours,
            )
            for figure in FIGURES
        },
        curved={name: set(curves["variant"]) for name, curves in tables.curves.items()},
        table1=_table1(tables.table1),
        animations=animations,
        pictures=_pictures(tables, settings, labels, colours),
        readings=_readings(tables.readings, settings),
        aggregate=tables.aggregate.to_dict("records"),
        comparisons=_with_units(
            tables.comparisons, pd.concat([tables.table1, tables.supplement]), settings
        ),
        supplement=_with_units(tables.supplement, tables.supplement, settings),
        regret=_regret(tables, settings),
        costs=_costs(making.records, tables.metrics),
        total=_total(making.records),
        making=making,
        hyperparameters=_hyperparameters(making.hyperparameters),
        origins=_origins(making.records),
        box=(BOX_WIDTH, BOX_HEIGHT),
    )


def number(value: float | None, digits: int = 0) -> str:
    """A number as it is printed; a dash where there is none."""
    if value is None or np.isnan(value):
        return "–"
    return f"{value:z,.{digits}f}".replace(",", "\u202f").replace("-", "−")  # a narrow space


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


def _value(value: Any) -> str:
    """A setting."""
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case list() | tuple():
            return ", ".join(map(_value, value))
        case dict():
            return ", ".join(f"{key}: {_value(own)}" for key, own in value.items())
        case _:
            return str(value)


def _claims(ledger: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """The ledger with numbers as they are printed."""
    claims = []
    for record in ledger["claims"] if ledger else []:
        ways = {
            how: {
                "verdict": record[how]["verdict"],
                "parts": list(map(_part, record[how]["parts"])),
            }
            for how in (LITERAL, ROBUST)
        }
        claims.append({key: record[key] for key in ("claim", "statement", "paper")} | {"by": ways})
    return claims


def _part(part: Mapping[str, Any]) -> dict[str, Any]:
    names = ("difference", "low", "high", "in_paper", "worth_mentioning", "detectable")
    shown: dict[str, Any] = {name: number(part[name], digits_of(part)) for name in names}
    return dict(part) | shown | {"environments": ", ".join(part["environments"])}


def _counts(ledger: Mapping[str, Any] | None) -> dict[str, Counter[str]]:
    """How many claims have which verdict."""
    claims = ledger["claims"] if ledger else []
    return {how: Counter(claim[how]["verdict"] for claim in claims) for how in (LITERAL, ROBUST)}


def _too_few(ledger: Mapping[str, Any] | None, environments: Iterable[str]) -> list[str]:
    """Those of the environments in which a claim's part has fewer seeds than the rule asks for."""
    few = {
        environment
        for claim in (ledger["claims"] if ledger else [])
        for part in claim[ROBUST]["parts"]
        if part["seeds"] < FEWEST_SEEDS
        for environment in part["environments"]
    }
    return [environment for environment in environments if environment in few]


def _table1(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Per environment: its budget, and for each variant a cell per metric."""
    blocks = []
    for environment, own in table.groupby("env", sort=False):
        best = own[own["censored"] < own["seeds"]].groupby("metric")["mean"].min().round()
        rows: dict[str, list[dict[str, Any]]] = {}
        cells: Iterable[Any] = own.sort_values(
            "metric", key=lambda names: names.map(PAPER_METRICS.index), kind="stable"
        ).itertuples()
        for cell in cells:
            paper = None if pd.isna(cell.paper) else int(cell.paper)
            rows.setdefault(cell.variant, []).append(
                cell._asdict()
                | {
                    "paper": paper,
                    "best": cell.censored < cell.seeds
                    and round(cell.mean) == best.get(cell.metric),
                }
            )
        blocks.append({"environment": environment, "rows": rows})
    return blocks


def _pictures(
    tables: Tables,
    settings: MetricsConfig,
    labels: Mapping[str, str],
    colours: Mapping[str, str],
) -> dict[str, str]:
    """Those that are wider than a phone, as SVG by name; those that this study has data for."""
    look = Look(FigureConfig(columns=3), settings.confidence, labels, colours)
    made_of = {
        "every_seed": tables.metrics,
        "constants": tables.metrics if settings.regret else None,
        "solved": tables.metrics if settings.solved_return else None,
        "forest": tables.claims["claims"] if tables.claims else None,
    }
    drawn = {"readings": draw_readings(tables.readings, labels, colours, settings)}
    for name, found in made_of.items():
        if found is not None:
            drawn[name] = PICTURES[name].draw(PICTURES[name].data(found, settings), look)
    return {name: svg(figure, name, name.replace("_", " ")) for name, figure in drawn.items()}


def _readings(table: pd.DataFrame, settings: MetricsConfig) -> list[dict[str, Any]]:
    """A row per reading: for each environment the variants, the first one first."""
    rows = []
    for key, own in in_order(table):
        cells = []
        for environment in table["env"].unique():
            ordered, is_first = ranked(own[own["env"] == environment])
            cells.append({"variants": ordered.to_dict("records"), "is_first": is_first})
        rows.append({"title": title(*key, settings), "cells": cells})
    return rows


def _with_units(
    table: pd.DataFrame, means: pd.DataFrame, settings: MetricsConfig
) -> list[dict[Any, Any]]:
    """Rows on metrics, with these as they are called and how many digits their `means` have."""
    labels = {metric.name: metric.label for metric in all_metrics(settings)}
    digits = digits_by_metric(means, settings)
    return [
        # All environments together have no digits, and no values that would need them.
        {
            **row,
            "metric": labels[row["metric"]],
            "digits": digits.get((row["env"], row["metric"]), 0),
        }
        for row in table.to_dict("records")
    ]


def _regret(tables: Tables, settings: MetricsConfig) -> list[dict[Any, Any]] | None:
    """Rows with the digits that the supplement has for the same returns."""
    if tables.regret is None:
        return None
    digits = digits_by_metric(tables.supplement, settings)
    return [
        row | {"digits": digits.get((row["env"], "area_under_curve"), 0)}
        for row in tables.regret.to_dict("records")
    ]


def _costs(records: Sequence[Mapping[str, Any]], metrics: pd.DataFrame) -> list[dict[str, Any]]:
    """A row per environment and variant."""
    frame = pd.DataFrame(
        [
            {key: record["config"][key] for key in ("environment", "variant", "seed")}
            | {key: record[key] for key in ("seconds", "peak_memory_mb")}
            for record in records
        ]
    ).rename(columns={"environment": "env"})
    frame = frame.merge(metrics[["env", "variant", "seed", "env_steps"]], validate="1:1")
    return [
        {
            "env": env,
            "variant": variant,
            "runs": len(own),
            "steps": own["env_steps"].sum(),
            "median": own["seconds"].median(),
            "longest": own["seconds"].max(),
            "seconds": own["seconds"].sum(),
            "memory": own["peak_memory_mb"].max(),
        }
        for (env, variant), own in frame.groupby(["env", "variant"], sort=False)
    ]


def _total(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "runs": len(records),
        "seconds": sum(record["seconds"] for record in records),
        "interruptions": sum(len(record["interruptions"]) for record in records),
    }


def _hyperparameters(
    ppo: Mapping[str, Mapping[str, Any]],
) -> list[tuple[str, list[tuple[str, list[str]]]]]:
    """Each setting with its values, and for each value the environments that have it."""
    rows = []
    for name in next(iter(ppo.values())):
        values: dict[str, list[str]] = {}
        for environment, settings in ppo.items():
            values.setdefault(_value(settings[name]), []).append(environment)
        rows.append((name, list(values.items())))
    return rows


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
        found["software"][f"{versions}; {record['arithmetic']['arithmetic']} arithmetic"] += 1
    return {name: counter.most_common() for name, counter in found.items()}
