"""The sections of a study, each a title, a note and a table: what its pages are made of."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from mace_rl.base.tables import read_made, read_table
from mace_study.compare.claims_config import ClaimsConfig, parts_of, undecided
from mace_study.compare.comparisons import ALL
from mace_study.compare.ledger import Answer
from mace_study.compare.statistics import BOOTSTRAP_SEEDS
from mace_study.compare.summary import from_to
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.betas import LABELS, betas_columns
from mace_study.measure.metrics import CORRELATIONS
from mace_study.measure.metrics_csv import read_metrics
from mace_study.show import tables

RETURNS = {"area_under_curve": "Mean return of training", "final_return": "Final return"}
PARTS = (
    "Differences count in the claim's favour, with their intervals. *p*: of no difference,"
    " corrected for all parts. claims.json has each part's margin, room, smallest detectable"
    " difference, p of equivalence, and the paper's own difference."
)

NO_INTERVAL = f" Below {BOOTSTRAP_SEEDS} seeds there is no interval."

Data = Mapping[str, pd.DataFrame]  # by the name of the CSV file


class Section(NamedTuple):
    """A table and what is to be said of it; in the note, words between asterisks are italic."""

    title: str
    note: str
    frame: pd.DataFrame
    level: int = 2


def read_data(
    folder: Path, names: Iterable[str], runs: Sequence[Sequence[str | int]], settings: MetricsConfig
) -> dict[str, pd.DataFrame]:
    """The data with these names in a study's folder; that of metrics.csv is to be of `runs`."""
    data = {}
    for name in names:
        path = folder / f"{name}.csv"
        if name == "metrics":
            data[name] = read_metrics(path, runs, settings)
        elif name == "betas":
            data[name] = read_table(path, betas_columns(settings))
        else:
            data[name] = read_made(path)
    return data


def by_family(answers: Sequence[Answer]) -> dict[str, list[Answer]]:
    """The answers of each family that has been asked."""
    titles = dict.fromkeys(answer.family for answer in answers)
    return {title: [answer for answer in answers if answer.family == title] for title in titles}


def counted(answers: Sequence[Answer], how: str, claims: ClaimsConfig) -> str:
    """How many claims of one family have which verdict, in words."""
    counts = Counter(answer.ways[how].verdict for answer in answers)
    words = claims.families[answers[0].family].words.model_dump().values()
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in dict.fromkeys(words))


def of_ledger(answers: Sequence[Answer], claims: ClaimsConfig) -> Iterator[Section]:
    """Family by family the verdicts, and then the parts in each way to measure them."""
    for title, family in by_family(answers).items():
        verdicts = "; ".join(f"{how}: {counted(family, how, claims)}" for how in family[0].ways)
        note = f"Of {len(family)}, {verdicts}. The rule: docs/metrics.md."
        ways = [way for answer in family for way in answer.ways.values()]
        if lacking := undecided([part.seeds for way in ways for part in way.parts]):
            note += f" {lacking[0].upper()}{lacking[1:]}."
        yield Section(title[:1].upper() + title[1:], note, tables.verdicts(family))
        for how in family[0].ways:
            frame = tables.parts_in_short(family, how)
            yield Section(f"Part by part: {how}", PARTS, frame, level=3)


def of_runs(data: Data, claims: ClaimsConfig, settings: MetricsConfig) -> list[Section]:
    """Everything but the ledger."""
    asked = [
        (key.partition(".")[0], part.metric)
        for family in claims.families.values()
        for key, part in parts_of(family)
    ]
    found = [*_means(data, claims, settings), *_compared(data, settings)]
    found += _others(data, settings, asked)
    note = f"Mean over seeds ({100 * settings.confidence:g} % interval)."
    for environment, frame in tables.companions(data["supplement"], settings).items():
        found.append(Section(f"The other metrics: {environment}", note, frame))
    return found


def _means(data: Data, claims: ClaimsConfig, settings: MetricsConfig) -> Iterator[Section]:
    """What each variant reached in each environment."""
    runs, supplement, paper = data["metrics"], data["supplement"], claims.table1
    interval = f"{100 * settings.confidence:g} % interval"
    seeds = from_to(runs.groupby(["env", "variant"]).size())
    for metric, title in RETURNS.items():
        if metric not in paper.metrics:
            frame = tables.means(supplement, metric, settings)
            note = "One seed." if seeds == "1" else f"Mean over {seeds} seeds ({interval})."
            yield Section(title, note, frame)
    yield Section("Final return of the worst seed", "", tables.worst(runs, settings))
    if "solved" in runs:
        note = f"Seeds whose last episodes are solved in {tables.SOLVED:.0%} of the cases or more."
        yield Section("Seeds that solve", note, tables.solved(runs))
    note = f"{paper.caption}: mean over seeds ({interval}), the best bold."
    if tables.counts_episodes(settings, paper):
        note = (
            f"{paper.caption} in episodes, lower is better: mean over seeds ({interval}), the"
            f" lowest bold. †k: k {tables.CENSORED}, so the mean is a lower bound."
        )
    yield Section("Table 1", note, tables.table1(data["table1"], settings, paper))


def _compared(data: Data, settings: MetricsConfig) -> Iterator[Section]:
    """One variant against another."""
    table, means = data["comparisons"], pd.concat([data["table1"], data["supplement"]])
    for metric, title in RETURNS.items() if len(table) else ():
        note = "P: that a run of the first is better than one of the second; 0.5 is a coin's toss."
        note += NO_INTERVAL if table["probability_low"].isna().any() else ""
        yield Section(f"{title}: who is better", note, tables.improvement(table, metric))
        note = (
            "Difference: mean over the seeds that both have (interval). p: of the sign-flip test,"
            " by itself and corrected for all metrics, pairs and environments (comparisons.csv);"
            " verdicts have a correction of their own."
        )
        compared = table[(table["metric"] == metric) & (table["env"] != ALL)]
        frame = tables.comparisons(compared, means, settings)
        yield Section(f"{title}: differences", note, frame)


def _others(
    data: Data, settings: MetricsConfig, asked: Sequence[tuple[str, str]]
) -> Iterator[Section]:
    """All environments together, readings and β; asked: claims with metrics that they compare."""
    if data["metrics"]["env"].nunique() > 1:
        note = "Scores: 0 is the random policy, 1 the study's best run."
        note += NO_INTERVAL if data["aggregate"]["mean_low"].isna().any() else ""
        yield Section("All environments together", note, tables.aggregate(data["aggregate"]))
    if "readings" in data:
        note = (
            "Means in episodes, the lowest first; bold if a log-rank test against each of the"
            " others has p < 0.05, not corrected. †: some runs never got there, or learned nothing."
        )
        frame = tables.readings(data["readings"], settings)
        yield Section("What decides the ranking", note, frame)
    frame = tables.betas(data["betas"], settings)
    if len(frame):
        note = (
            "Where β is not the same in every seed: of all seeds the least, the median and the"
            " most. With stagnation: mean over seeds of its rank correlation with the stagnation"
            " of the episodes before, in all of training, and before and after the common bar."
        )
        for name in [name for name in CORRELATIONS if name in data["betas"]]:
            if judged := dict.fromkeys(claim for claim, metric in asked if metric == name):
                note += f" Of {', '.join(judged)} it is the column *{LABELS[name]}*."
        yield Section("β", note, frame)
