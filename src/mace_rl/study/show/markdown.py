"""Pages of Markdown: claims.md, the ledger, and tables.md, every table of a study."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mace_rl.runs.records import read_table
from mace_rl.study.claims_config import FAMILIES, WAYS
from mace_rl.study.compare.comparisons import ALL
from mace_rl.study.compare.summary import from_to
from mace_rl.study.compare.verdicts import POWER
from mace_rl.study.measure.run_metrics import BETAS, read_metrics
from mace_rl.study.metrics_config import MetricsConfig
from mace_rl.study.show import tables
from mace_rl.study.show.cells import markdown

TEXTS = ("env", "variant", "baseline", "metric", "kind", "reading", "source", "test")  # columns
RETURNS = {"area_under_curve": "Mean return of training", "final_return": "Final return"}

Data = Mapping[str, pd.DataFrame]  # by the name of the CSV file
Ledger = Sequence[Mapping[str, Any]]  # the records of `claims.ledger`


def read_data(
    found: Mapping[str, Any], runs: Sequence[Sequence[str | int]], settings: MetricsConfig
) -> tuple[dict[str, pd.DataFrame], Ledger]:
    """The data of these runs, and the ledger, empty without one, from files by their names."""
    # Names are as they were given, NA and 0.1 too; an empty cell is NaN.
    how: Any = {"dtype": dict.fromkeys(TEXTS, str), "keep_default_na": False, "na_values": [""]}
    files = {name: path for name, path in found.items() if str(path).endswith(".csv")}
    data = {name: pd.read_csv(path, **how) for name, path in files.items()}
    data["metrics"] = read_metrics(found["metrics"], runs, settings)
    if "betas" in found:
        data["betas"] = read_table(found["betas"], BETAS)
    path = found.get("claims")
    return data, json.loads(Path(path).read_text(encoding="utf-8"))["claims"] if path else ()


def claims_page(claims: Ledger, origin: str) -> str:
    """claims.md, from the records of `claims.ledger`; `origin` says how it was made."""
    return f"# Does it hold?\n\n{origin}\n" + "".join(_ledger(claims))


def _parts(claims: Ledger) -> Iterator[str]:
    for how in ways(claims):
        yield (
            f"\n### Part by part: {how}\n\n"
            "Differences count in the claim's favour, and so does *paper*, the same in its Table 1."
            " *p*: of no difference; *p within*: of one beyond the margin; both corrected for all"
            " parts. *P*: that a run of the first is better. *Margin*: what is worth mentioning."
            f" *Detectable*: the smallest that these seeds show with a power of"
            f" {POWER:.0%}, before correction.\n\n"
        )
        yield markdown(tables.parts(claims, how, {}))


def families(claims: Ledger) -> dict[str, Ledger]:
    """The records of each family that the ledger has, by its title."""
    return {
        family.title: own
        for family in FAMILIES
        if (own := [claim for claim in claims if claim["family"] == family.title])
    }


def ways(claims: Ledger) -> list[str]:
    """In which ways the claims of one family are measured."""
    return [how for how in WAYS if how in claims[0]]


def counted(claims: Ledger, how: str) -> str:
    """How many claims of one family have which verdict, in words."""
    words = next(family.words for family in FAMILIES if family.title == claims[0]["family"])
    counts = Counter(claim[how]["verdict"] for claim in claims)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in words.values())


def tables_page(
    data: Data,
    claims: Ledger,
    pictures: Sequence[str],
    settings: MetricsConfig,
    origin: str,
) -> str:
    """tables.md: a study's pictures (PNG files beside it) and tables.

    data: frames by the name of their CSV file: metrics, betas, table1, supplement, comparisons,
    aggregate and, where the study has them, readings. claims: the records of its ledger.
    """
    return "".join(
        [
            f"# The tables of this study\n\n{origin}\n",
            *(f"\n![{name}]({name}.png)\n" for name in pictures),
            *(_ledger(claims) if claims else ()),
            *_means(data, settings),
            *_compared(data, settings),
            *_others(data, settings),
            *_companions(data, settings),
        ]
    )


def _section(title: str, note: str, frame: pd.DataFrame) -> str:
    lines = f"\n{note}\n" if note else ""
    return f"\n## {title}\n{lines}\n{markdown(frame)}"


def _ledger(claims: Ledger) -> Iterator[str]:
    for title, own in families(claims).items():
        verdicts = "; ".join(f"{how}: {counted(own, how)}" for how in ways(own))
        note = f"Of {len(own)}, {verdicts}. The rule: docs/protocol.md."
        yield _section(title.capitalize(), note, tables.verdicts(own))
        yield from _parts(own)


def _means(data: Data, settings: MetricsConfig) -> Iterator[str]:
    """What each variant reached in each environment."""
    runs, table1, supplement = data["metrics"], data["table1"], data["supplement"]
    interval = f"{100 * settings.confidence:g} % interval"
    seeds = from_to(runs.groupby(["env", "variant"]).size())
    for metric, title in RETURNS.items():
        frame = tables.means(supplement, metric, settings)
        yield _section(title, f"Mean over {seeds} seeds ({interval}).", frame)
    frame = tables.worst(runs, settings)
    yield _section("Final return of the worst seed", "", frame)
    if "solved" in runs:
        note = f"Seeds whose last episodes are solved in {tables.SOLVED:.0%} of the cases or more."
        yield _section("Seeds that solve", note, tables.solved(runs))
    note = (
        "Sample efficiency / convergence steps in episodes, lower is better: mean over seeds"
        f" ({interval}), the lowest bold. †k: k of the seeds never got there and count with the"
        " whole budget, so the mean is a lower bound."
    )
    yield _section("Table 1", note, tables.table1(table1))


def _compared(data: Data, settings: MetricsConfig) -> Iterator[str]:
    """One variant against another."""
    table = data["comparisons"]
    for metric, title in RETURNS.items() if len(table) else ():
        note = "P: that a run of the first is better than one of the second; 0.5 is a coin's toss."
        yield _section(f"{title}: who is better", note, tables.improvement(table, metric))
        note = (
            "Difference: mean over the seeds that both have (interval). p: of the sign-flip test,"
            " by itself and corrected for all metrics, pairs and environments (comparisons.csv);"
            " verdicts have a correction of their own."
        )
        own = table[(table["metric"] == metric) & (table["env"] != ALL)]
        frame = tables.comparisons(own, data["supplement"], settings)
        yield _section(f"{title}: differences", note, frame.drop(columns=["metric", "P"]))


def _others(data: Data, settings: MetricsConfig) -> Iterator[str]:
    """All environments together, readings and β."""
    if data["metrics"]["env"].nunique() > 1:
        note = "Scores: 0 is the random policy, 1 the study's best run."
        frame = tables.aggregate(data["aggregate"])
        yield _section("All environments together", note, frame)
    if "readings" in data:
        note = (
            "Means in episodes, the lowest first; bold if a log-rank test against each of the"
            " others has p < 0.05, not corrected. †: some runs never got there."
        )
        frame = tables.readings(data["readings"], settings)
        yield _section("What decides the ranking", note, frame)
    frame = tables.betas(data["betas"], settings)
    if len(frame):
        note = (
            "Where β is not the same in every seed: of all seeds the least, the median and the"
            " most. With stagnation: mean over seeds of its rank correlation with the stagnation"
            " before (C9)."
        )
        yield _section("β", note, frame)


def _companions(data: Data, settings: MetricsConfig) -> Iterator[str]:
    """Every metric but Table 1's, environment by environment."""
    note = f"Mean over seeds ({100 * settings.confidence:g} % interval)."
    for environment, frame in tables.companions(data["supplement"], settings).items():
        yield _section(f"The other metrics: {environment}", note, frame)
