"""Every table of a study, as a frame of words (`str`) and `Cell`s of numbers with intervals."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from mace_rl.config.agent import CompiledNetwork, PPOConfig, TorchModule
from mace_study.compare.claims_config import Table1Config, Table2Config
from mace_study.compare.ledger import Answer
from mace_study.compare.readings import in_order, ranked, title
from mace_study.compare.statistics import interval
from mace_study.compare.summary import digits_by_metric
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.betas import LABELS
from mace_study.measure.metrics import CORRELATIONS, metric_labels, metric_units

COLUMNS_PER_BLOCK = 3  # of LaTeX and the terminal, side by side; more continue below
DASH = "\u2013"  # in the place of a number that there is not
SIZES = ("room", "margin", "detectable")  # beside a difference
# The mark †: what never attains a metric in episodes, or has not learned (docs/metrics.md).
CENSORED = (
    "of the seeds never got there, or ended no better than random actions, and count with the whole"
    " budget"
)
POWERS = "⁻⁰\u00b9\u00b2\u00b3⁴⁵⁶⁷⁸⁹"
SOLVED = 0.9  # of the last episodes, for a seed to count

Row = Mapping[str, Any]  # of a frame, by its columns


class Value(NamedTuple):
    """One number, or words, as printed."""

    text: str
    low: str = ""  # of its interval; empty where none is asked for
    high: str = ""
    mark: str = ""  # †, and of how many seeds
    best: bool = False


class Cell(NamedTuple):
    """Several values in one cell, and a note beside them. (Words alone are a `str`.)"""

    values: Sequence[Value]
    joint: str = " / "
    note: str = ""


def number(value: float | None, digits: int = 0) -> str:
    """A number with a true minus, and without one before a zero; a dash where there is none."""
    if value is None or np.isnan(value):
        return DASH
    return f"{value:z.{digits}f}".replace("-", "−")


def estimate(value: Iterable[Any], digits: int, mark: str = "", best: bool = False) -> Value:
    """A number, low and high of its interval, as printed; dashes where there is none."""
    text, low, high = (number(bound, digits) for bound in value)
    return Value(text, low, high, mark, best)


def records(table: pd.DataFrame) -> list[Row]:
    """The rows of a frame."""
    found: list[Any] = table.to_dict("records")
    return found


def named(table: pd.DataFrame, names: Mapping[str, str]) -> pd.DataFrame:
    """A study's data with other names of its variants."""
    columns = table.columns.intersection(["variant", "baseline"])
    return table.assign(**{column: table[column].replace(dict(names)) for column in columns})


def table1(table: pd.DataFrame, settings: MetricsConfig, paper: Table1Config) -> pd.DataFrame:
    """Table 1 in the paper's layout, of the data of table1.csv: its metrics side by side.

    Rows are variants, columns environments. The best mean of each environment and metric is bold,
    as displayed: ties all are; a mean of seeds that all never got there is not.
    """
    digits, units = digits_by_metric(table, settings), metric_units(settings)
    best: dict[Any, str] = {}
    attained = table[table["censored"] < table["seeds"]]
    for (env, metric), means in attained.groupby(["env", "metric"])["mean"]:
        first = means.min() if units[str(metric)] == "episodes" else means.max()
        best[env, metric] = number(first, digits[str(env), str(metric)])

    def cell(rows: Sequence[Row]) -> Cell:
        values, published = [], list[str]()
        by_metric = {row["metric"]: row for row in rows}
        for row in map(by_metric.__getitem__, paper.metrics):
            key = row["env"], row["metric"]
            shown = number(row["mean"], digits[key])
            is_best = row["censored"] < row["seeds"] and shown == best[key]
            values.append(_mean(row, digits[key], is_best))
            published += [] if pd.isna(row["paper"]) else [number(row["paper"], digits[key])]
        return Cell(values, note=f"paper: {' / '.join(published)}" if published else "")

    return _grid(table, cell, "Algorithm")


def counts_episodes(settings: MetricsConfig, paper: Table1Config) -> bool:
    """Whether all metrics of Table 1 do, of which fewer are better."""
    return all(metric_units(settings)[metric] == "episodes" for metric in paper.metrics)


def companions(table: pd.DataFrame, settings: MetricsConfig) -> dict[str, pd.DataFrame]:
    """By environment, a row for each metric of a `summary` and a column for each variant."""
    digits = digits_by_metric(table, settings)
    labelled = table.assign(label=table["metric"].map(metric_labels(settings)))

    def cell(rows: Sequence[Row]) -> Cell:
        return Cell([_mean(row, digits[row["env"], row["metric"]]) for row in rows])

    groups = labelled.groupby("env", sort=False)
    return {str(env): _grid(rows, cell, rows="label", columns="variant") for env, rows in groups}


def means(table: pd.DataFrame, metric: str, settings: MetricsConfig) -> pd.DataFrame:
    """One metric of a `summary`, a row for each variant and a column for each environment."""
    digits, shown = digits_by_metric(table, settings), table[table["metric"] == metric]
    return _grid(shown, lambda rows: Cell([_mean(rows[0], digits[rows[0]["env"], metric])]))


def worst(runs: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """The final return of each variant's worst seed, from the frame of metrics.csv."""
    table = runs.assign(metric="final_return", mean=runs["final_return"])
    digits = {env: count for (env, _), count in digits_by_metric(table, settings).items()}
    return _grid(
        table, lambda rows: number(min(row["mean"] for row in rows), digits[rows[0]["env"]])
    )


def solved(runs: pd.DataFrame) -> pd.DataFrame:
    """How many seeds solve each task, from the frame of metrics.csv."""
    return _grid(
        runs, lambda rows: f"{sum(row['solved'] >= SOLVED for row in rows)} of {len(rows)}"
    )


def comparisons(table: pd.DataFrame, means: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """comparisons.csv in single environments, with as many digits as `means`, a `summary`, has."""
    digits, rows = digits_by_metric(means, settings), []
    for row in records(table):
        shown = digits[row["env"], row["metric"]]
        cells = [row["env"], f"{row['variant']} over {row['baseline']}", number(row["seeds"])]
        cells += [_estimate(row, "difference", shown, ends="")]
        rows.append([*cells, number(row["p_value"], 4), number(row["p_holm"], 4)])
    heads = ["environment", "", "n", "difference", "p", "p (Holm)"]
    return pd.DataFrame(rows, columns=heads)


def improvement(table: pd.DataFrame, metric: str) -> pd.DataFrame:
    """The probabilities of comparisons.csv: a row for each pair, a column for each environment."""
    pairs = table.assign(pair=table["variant"] + " over " + table["baseline"])
    pairs = pairs[pairs["metric"] == metric]
    return _grid(pairs, lambda rows: _estimate(rows[0], "probability", 2), rows="pair")


def aggregate(table: pd.DataFrame) -> pd.DataFrame:
    """aggregate.csv."""
    rows = []
    for row in records(table):
        cells = [row["variant"], row["metric"].replace("_", " "), number(row["runs"])]
        rows.append([*cells, _estimate(row, "mean", 3), _estimate(row, "iqm", 3)])
    return pd.DataFrame(rows, columns=["", "score of", "runs", "mean", "interquartile mean"])


def readings(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """Of each reading (`readings.csv`) and environment the variants, the first one first.

    The best is a first place that is more than chance (`ranked`).
    """

    def cell(rows: Sequence[Row]) -> Cell:
        ordered, is_first = ranked(rows)
        values = [
            Value(f"{row['variant']} {number(row['mean'])}", mark="†" if row["censored"] else "")
            for row in ordered
        ]
        return Cell([values[0]._replace(best=is_first), *values[1:]], joint=", ")

    parts = [
        rows.assign(title=title(*key, metric_labels(settings))) for key, rows in in_order(table)
    ]
    frame = _grid(pd.concat(parts), cell, "episodes", rows="title")
    return frame[["episodes", *table["env"].unique()]]


def betas(table: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """betas.csv: the variants whose β is not the same in every seed, and how it ended."""
    rows: list[dict[str, str | Cell]] = []
    for (environment, variant), runs in table.groupby(["env", "variant"], sort=False):
        if runs.nunique()[["beta_end", "beta_lowest", "beta_highest"]].max() == 1:
            continue
        rows.append({"environment": str(environment), "": str(variant), "n": number(len(runs))})
        for name in runs.columns.intersection(list(LABELS), sort=False):
            found = runs[name].to_numpy()
            if name in CORRELATIONS:
                ends = map(float, interval(found, settings))
                shown: str | Cell = Cell([estimate((found.mean(), *ends), 3)])
            else:
                shown = ", ".join(number(beta, 2) for beta in np.quantile(found, [0, 0.5, 1]))
            rows[-1][LABELS[name]] = shown
    return pd.DataFrame(rows)


def verdicts(answers: Sequence[Answer]) -> pd.DataFrame:
    """A verdict for each claim of one family, in each way to measure it."""
    ways = list(answers[0].ways)
    rows = []
    for answer in answers:
        said = [Cell([Value(answer.ways[how].verdict, best=True)]) for how in ways]
        rows.append([answer.claim, *said, answer.statement, answer.paper])
    frame = pd.DataFrame(rows, columns=["", *ways, "statement", "the paper's Table 1"])
    return frame if any(answer.paper for answer in answers) else frame.iloc[:, :-1]


def parts(answers: Sequence[Answer], how: str) -> pd.DataFrame:
    """Every part of the claims, measured in one of the ways."""
    rows: list[dict[str, str | Cell]] = []
    for answer, part in ((asked, part) for asked in answers for part in asked.ways[how].parts):
        # Of a return as many as the margin needs, which depends on the environment's scale.
        of_return = max(1, 1 - math.floor(math.log10(part.worth_mentioning)))
        digits = {"episodes": 0, "return": of_return}.get(part.unit, 3)
        row: dict[str, str | Cell] = {"": answer.claim}
        row["environment"] = "all" if len(part.environments) > 1 else part.environments[0]
        row |= {"metric": part.metric, "over": f"{part.variant} over {part.baseline or 0}"}
        row["n"] = number(part.seeds)
        row["difference"] = _estimate(vars(part), "difference", digits, ends="")
        row |= {"p": number(part.p_holm, 3), "room": number(part.room, max(1, digits))}
        row["margin"] = number(part.worth_mentioning, digits)
        row["detectable"] = number(part.detectable, digits)
        rows.append(row | {"size": part.size, "outcome": part.outcome.replace("_", " ")})
    return pd.DataFrame(rows)


def parts_in_short(answers: Sequence[Answer], how: str) -> pd.DataFrame:
    """What each part came out as, and what decided it; claims.json has the rest."""
    frame = parts(answers, how)
    sized = frame["outcome"].isin(["shown", "reversed"]) & (frame["size"] != "open")
    frame["outcome"] = frame["outcome"].where(~sized, frame["outcome"] + ", " + frame["size"])
    return frame[["", "outcome", "environment", "metric", "over", "difference", "p"]]


def side_by_side(studies: Mapping[str, Sequence[Answer]], how: str) -> pd.DataFrame:
    """`parts` of several studies in short, each study in a column."""
    columns = []
    for answers in studies.values():
        frame = parts(answers, how).set_index(["", "environment", "metric", "over"])
        columns.append(pd.Series(list(map(_in_short, records(frame))), frame.index))
    return pd.concat(columns, axis=1, keys=studies, sort=False).fillna("").reset_index()


def _in_short(part: Row) -> Cell:
    size = f", {part['size']}" if part["outcome"] in ("shown", "reversed") else ""
    numbers = (f"{name} {part[name]}" for name in ("n", *SIZES))
    return part["difference"]._replace(note=f"{', '.join(numbers)}: {part['outcome']}{size}")


def table2(ppo: Mapping[str, PPOConfig], paper: Table2Config) -> pd.DataFrame:
    """The PPO hyperparameters: the paper's rows and Adam, then this project's further settings."""
    titles = {
        name: name.replace("_", " ").title() for name in PPOConfig.model_fields
    } | paper.others
    rows = [[label, _setting(ppo, name)] for name, label in paper.rows.items()]
    rows += [["Optimizer", "Adam"]]
    others = [name for name in PPOConfig.model_fields if name not in paper.rows]
    rows += [[titles[name], _setting(ppo, name)] for name in others]
    return pd.DataFrame(rows, columns=["Hyperparameter", "Value"])


def _grid(
    table: pd.DataFrame,
    cell: Callable[[Sequence[Row]], str | Cell],
    head: str = "",
    rows: str = "variant",
    columns: str = "env",
) -> pd.DataFrame:
    """A row for each of `rows` and a column for each of `columns`; empty where there is nothing."""
    groups: dict[Any, list[Row]] = {}
    for row in records(table):
        groups.setdefault((row[rows], row[columns]), []).append(row)
    across = list(table[columns].unique())
    lines = [
        [name, *(cell(groups[name, other]) if (name, other) in groups else "" for other in across)]
        for name in table[rows].unique()
    ]
    return pd.DataFrame(lines, columns=[head, *across])


def _mean(row: Row, digits: int, best: bool = False) -> Value:
    """A row of a `summary`, with the number of seeds that never got there."""
    mark = f"†{row['censored']}" if row["censored"] else ""
    return estimate((row["mean"], row["low"], row["high"]), digits, mark, best)


def _estimate(row: Row, name: str, digits: int, ends: str | None = None) -> Cell:
    """The value `name` of a row, whose interval is `ends` low and high: as a rule NAME_low."""
    prefix = f"{name}_" if ends is None else ends
    return Cell([estimate((row[name], row[f"{prefix}low"], row[f"{prefix}high"]), digits)])


def _setting(ppo: Mapping[str, PPOConfig], name: str) -> str | Cell:
    """The value of one setting, for each group of environments that share it."""
    environments: dict[str, list[str]] = {}
    for environment, config in ppo.items():
        value = getattr(config, name)
        text = "none" if value is None and name == "max_gradient_norm" else _value(value)
        environments.setdefault(text, []).append(environment)
    if len(environments) == 1:
        return next(iter(environments))
    values = [Value(f"{value} ({', '.join(whose)})") for value, whose in environments.items()]
    return Cell(values, joint="; ")


def _value(value: Any) -> str:
    """A setting as it is printed."""
    match value:
        case None:
            return "all steps of the update"
        case bool():
            return "yes" if value else "no"
        case list():
            return ", ".join(map(_value, value))
        case CompiledNetwork():
            return "tanh network"
        case TorchModule():
            return value.module
        case float() if "e" in repr(value):
            mantissa, exponent = repr(value).split("e")
            power = str(int(exponent)).translate(str.maketrans("-0123456789", POWERS))
            return f"{mantissa} \u00d7 10{power}"
        case _:
            return str(value)
