"""What the worlds of reference/worlds/protocol.md say together, from what Snakemake made in each.

    python -m tools.worlds FOLDER      for example results; `make tables` does it, too

FOLDER/WORLD has the metrics.csv and figure1.csv of each of `WORLDS` that is there, and its
claims.json once all its environments are. Into FOLDER/worlds come the verdicts of these, the
paper's Table 1 as a draw, and their pictures.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from mace_rl.base.errors import Refusal
from mace_rl.base.tables import RecordError
from mace_study.compare.claims_config import LEARNED, read_claims
from mace_study.compare.ledger import read_ledger
from mace_study.compare.single_seeds import draw, numbers
from mace_study.config.study import read_study
from mace_study.show import worlds
from mace_study.show.curves import PlotStyle, plot_style, quantity, save_figure
from mace_study.show.markdown import page
from mace_study.show.sections import Section
from mace_study.show.tables import records, side_by_side

# With the variant that is the learned β in each.
WORLDS = {"tuned": LEARNED, "plain": "mace_evidence", "published": LEARNED}
FOLDER = "worlds"
ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "config.yaml"  # every world has its labels, colours and measures
DECIDES = "robust"  # the way to measure that is counted and pictured
COMMAND = "`python -m tools.worlds`"
# The metrics that the protocol names; the first is not the public code's rule, as its words ask.
AS_NAMED = ("sample_efficiency", "convergence_steps_public_code")
RULE = "[rule](../../../docs/metrics.md#the-rule)"


def make(folder: Path) -> list[str]:
    """Make FOLDER/worlds; returns what it then has, nothing if there is no world."""
    study = read_study([CONFIG])
    table1 = read_claims(study, CONFIG.parent / study.claims).table1
    look = plot_style(study.metrics, study.figure.model_dump(), study.labels, study.colours)
    there = [world for world in WORLDS if (folder / world / "metrics.csv").exists()]
    if not there:
        return []
    runs = {world: _runs(folder, world, table1.variants) for world in there}
    curves = {world: _read(folder, world, "figure1.csv") for world in there}
    ledgers = {world: folder / world / "claims.json" for world in there}
    answers = {world: read_ledger(path) for world, path in ledgers.items() if path.exists()}
    tables: dict[str, pd.DataFrame] = {}
    pictures: dict[str, Figure] = {}
    if answers:
        tables["verdicts"] = worlds.verdicts(answers)
        pictures["verdicts"] = worlds.draw_verdicts(
            tables["verdicts"].query("measured == @DECIDES")
        )
    places, draws = [], []
    for metrics in dict.fromkeys((tuple(table1.public_code), AS_NAMED)):
        read = table1.model_copy(update={"public_code": list(metrics)})
        for world, rows in runs.items():
            rule = {"world": world, "rule": " / ".join(metrics)}
            places.append(numbers(rows, read).assign(**rule))
            draws.append(draw(rows, read)._asdict() | rule)
    tables |= {"numbers": pd.concat(places), "draws": pd.DataFrame(draws)}
    pictures["numbers"] = worlds.draw_numbers(runs, table1, look)
    pictures["curves"] = worlds.draw_curves(curves, quantity("1", study.metrics), look)
    goal = folder / FOLDER
    goal.mkdir(exist_ok=True)
    for name, table in tables.items():
        table.to_csv(goal / f"{name}.csv", index=False)
    for name, picture in pictures.items():
        save_figure(picture, goal / f"{name}.png")
    origin = f"From {', '.join(f'[{world}](../{world})' for world in there)}, by {COMMAND}."
    origin += "".join(
        f" The learned β of {world} is `{WORLDS[world]}`."
        for world in there
        if WORLDS[world] != LEARNED
    )
    sections = _sections(tables, look)
    if answers:
        note = f"Difference in the claim's favour, 95 % interval, and what the {RULE} says of it."
        found = side_by_side(answers, DECIDES)
        sections.append(Section(f"Part by part: {DECIDES}", note, found))
    text = page("worlds", origin, sections, list(pictures))
    (goal / "README.md").write_text(text, encoding="utf-8")
    return [*(f"{name}.csv" for name in tables), *(f"{name}.png" for name in pictures), "README.md"]


def _sections(tables: dict[str, pd.DataFrame], look: PlotStyle) -> list[Section]:
    """The tables in words, for README.md."""
    sections = []
    ways = tables["verdicts"].groupby("measured") if "verdicts" in tables else ()
    for way, of_way in sorted(ways, key=lambda pair: pair[0] != DECIDES):
        said = [
            f"{row['verdict']}: {worlds.difference(row['difference'], row['low'], row['high'])}"
            for row in records(of_way)
        ]
        long = of_way.assign(said=said)
        wide = long.pivot(index=["claim", "statement"], columns="world", values="said")
        order = long[["claim", "statement"]].drop_duplicates()
        frame = order.merge(wide[long["world"].unique()].reset_index()).fillna("")
        decides = "These decide" if way == DECIDES else "These do not decide"
        note = f"{decides}. Number: {worlds.NUMBER}."
        sections.append(Section(f"Verdicts: {way}", note, frame))
    table = tables["numbers"]
    cells = table.assign(
        number=table["env"]
        + ", "
        + table["variant"].map(look.labels)
        + ", "
        + table["metric"].map(look.metrics).str.lower(),
        seeds=[
            f"{row['median']:.0f} ({row['low']:.0f} to {row['high']:.0f})" + " *" * row["unusual"]
            for row in records(table)
        ],
    )
    cells = cells.drop_duplicates(["world", "number"])  # both rules have the same convergence
    wide = cells.pivot(index=["number", "paper"], columns="world", values="seeds")
    order = cells[["number", "paper"]].drop_duplicates().sort_values("number", kind="stable")
    wide = wide[table["world"].unique()].reset_index().fillna("")
    frame = order.merge(wide).astype({"paper": int}).map(str)
    note = (
        "Median and central 90 % of each world's seeds. *: unusual, by its place among the seeds"
        " ([the protocol](../../worlds/protocol.md#the-table-as-a-draw))."
    )
    sections.append(Section("The paper's numbers", note, frame))
    rows = [
        {
            "world": row["world"],
            "metrics": "as named"
            if row["rule"].startswith(AS_NAMED[0] + " /")
            else "as the words say",
            "unusual": f"{row['unusual']} of {row['numbers']}",
            "unlike from": f"{row['limit']}",
            "chance of as many": f"{row['chance_unusual']:.2g}",
            "columns": f"{row['first']}",
            "as favourable": f"{row['chance_first']:.3f}",
            "by chance": f"{row['chance_any']:.3f}",
        }
        for row in records(tables["draws"])
    ]
    favoured = look.labels[tables["draws"]["favoured"].iloc[0]]
    note = (
        "One seed of each variant as Table 1. *Chance of as many*: of as many unusual numbers."
        f" *Columns*: in which {favoured} is first in the paper's table, of the world's"
        " environments. *As favourable*: it is first in as many or more; *by chance*: a variant"
        " that is drawn anew in each environment is. *Metrics*: the protocol's words ask for the"
        " public code's rules, but it names another metric for sample efficiency: here are both."
    )
    sections.append(Section("The table as a draw", note, pd.DataFrame(rows)))
    return sections


def _read(folder: Path, world: str, name: str) -> pd.DataFrame:
    """A table of a world, in which the learned β has the name that the claims have for it."""
    return pd.read_csv(folder / world / name).replace({"variant": {WORLDS[world]: LEARNED}})


def _runs(folder: Path, world: str, variants: Iterable[str]) -> pd.DataFrame:
    """A metrics.csv; `RecordError` unless each environment has as many runs of all `variants`."""
    path, table = folder / world / "metrics.csv", _read(folder, world, "metrics.csv")
    for environment, rows in table.groupby("env"):
        counts = rows["variant"].value_counts().reindex([*variants], fill_value=0)
        if counts.nunique() > 1 or not counts.iloc[0]:
            found = ", ".join(f"{count} of {name}" for name, count in counts.items())
            raise RecordError(f"{path}: the runs of {environment} are not complete: {found}")
    return table


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.worlds results"
    )
    parser.add_argument("folder", type=Path, help="where the worlds' folders are")
    folder = parser.parse_args().folder
    try:
        made = make(folder)
    except (Refusal, OSError) as error:
        sys.exit(f"worlds: {error}")
    if not made:
        sys.exit(
            f"worlds: {folder} has no {next(iter(WORLDS))}/metrics.csv, nor that of another world"
        )
    print(*(folder / FOLDER / name for name in made), sep="\n")


if __name__ == "__main__":
    main()
