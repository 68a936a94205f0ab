"""The paper's Table 1 and Table 2 as LaTeX to \\input: captions, tabulars and cells."""

from collections.abc import Mapping

import pandas as pd

from mace_rl.config.agent import PPOConfig
from mace_study.compare.claims_config import Table1Config, Table2Config
from mace_study.compare.statistics import BOOTSTRAP_SEEDS, interval_kind
from mace_study.compare.summary import from_to
from mace_study.config.labels import escaped, packages
from mace_study.config.metrics import MetricsConfig
from mace_study.show import tables
from mace_study.show.tables import COLUMNS_PER_BLOCK, DASH, Cell

INTERVALS = {"t": "$t$", "bootstrap": "bootstrap"}  # by `interval_kind`


def table1_latex(
    table: pd.DataFrame, labels: Mapping[str, str], settings: MetricsConfig, paper: Table1Config
) -> str:
    """Table 1 in the paper's layout from the data of table1.csv."""
    what = r". The best mean is \textbf{bold}. "
    if tables.counts_episodes(settings, paper):
        both = " for both" if len(paper.metrics) == 2 else ""
        best = r"the lowest mean is \textbf{bold}. "
        what = f", in training episodes. Lower is better{both}; {best}"
    caption = escaped(paper.caption) + what + _how(table, settings.confidence)
    frame = tables.table1(tables.named(table, labels), settings, paper)
    needs = packages(" ".join([paper.caption, *frame.columns, *frame[frame.columns[0]]]))
    return latex_float(needs, caption, "tab:table1", frame)


def table2_latex(ppo: Mapping[str, PPOConfig], paper: Table2Config) -> str:
    """Table 2, the PPO hyperparameters: the paper's rows, a line, and this project's."""
    found = tables.table2(ppo, paper).to_numpy()
    rows = [rf"\raggedright {escaped(name)} & {latex_cell(value)} \\" for name, value in found]
    needs = packages(" ".join([*(name for name, _ in found), *ppo]))  # `ppo`: where values differ
    end = len(paper.rows) + 1  # and Adam
    what = "PPO hyperparameters: those of the paper, and below the line those that it leaves open."
    columns = r"tabular}{@{}p{0.42\linewidth}l@{}"
    body = [*rows[:end], r"\midrule", *rows[end:]]
    lines = _lines(columns, r"Hyperparameter & Value \\", *body)
    return _float("table", needs, what, "tab:table2", *lines)


def _how(table: pd.DataFrame, confidence: float) -> str:
    """The part of a caption that says from what the numbers come."""
    seeds = sorted(table["seeds"].unique())
    budgets: dict[str, list[str]] = {}
    for environment, group in table.groupby("env", sort=False):
        budget = " or ".join(str(episodes) for episodes in group["episodes"].unique())
        budgets.setdefault(budget, []).append(str(environment))
    budget = "; ".join(f"{n} episodes ({escaped(', '.join(own))})" for n, own in budgets.items())
    level = escaped(f"{100 * confidence:g}")
    kinds = dict.fromkeys(INTERVALS[interval_kind(count)] for count in seeds if count > 1)
    text = "One seed, which allows no interval."
    if kinds:
        kind = f" (below {BOOTSTRAP_SEEDS} seeds) or ".join(kinds)
        none = "; one seed allows none" if seeds[0] == 1 else ""
        text = f"Means over {from_to(table['seeds'])} seeds and, below, their {level}\\,\\% {kind}"
        text += f" intervals{none}."
    text += f" Training budget: {budget}."
    if table["censored"].any():
        text += rf" $^{{\dagger k}}$: $k$ {tables.CENSORED}, a lower bound."
    return text


def latex_float(needs: list[str], caption: str, label: str, frame: pd.DataFrame) -> str:
    """A table for \\input, as wide as the page; its first line says what the preamble `needs`."""
    head, *names = frame.columns
    starts = range(0, len(names), COLUMNS_PER_BLOCK)
    blocks = [names[start : start + COLUMNS_PER_BLOCK] for start in starts]
    tabulars = "\n\\par\\medskip\n".join(_tabular(frame[[head, *block]]) for block in blocks)
    return _float("table*", needs, caption, label, r"\setlength{\tabcolsep}{2pt}", tabulars)


def _float(kind: str, needs: list[str], caption: str, label: str, *body: str) -> str:
    lines = [f"% Needs {' '.join(needs)}"]
    lines += [rf"\begin{{{kind}}}[tbp]", r"\centering", rf"\caption{{{caption}}}"]
    lines += [rf"\label{{{label}}}", r"\par\medskip", r"\footnotesize", *body]
    return "\n".join([*lines, rf"\end{{{kind}}}"]) + "\n"


def _lines(columns: str, head: str, *body: str) -> list[str]:
    """A tabular, line by line; `columns` begins with its kind."""
    rules = [rf"\begin{{{columns}}}", r"\toprule", head, r"\midrule", *body, r"\bottomrule"]
    return [*rules, rf"\end{{{columns.partition('}')[0]}}}"]


def _tabular(frame: pd.DataFrame) -> str:
    """A tabular of \\textwidth."""
    columns = r"p{0.23\textwidth}" + "c" * (len(frame.columns) - 1)
    names = [lines[0] if len(lines) == 1 else stack(*lines) for lines in map(_name, frame.columns)]
    rows = [
        [r"\newline ".join(_name(name)), *map(latex_cell, cells)]
        for name, *cells in frame.to_numpy()
    ]
    columns = rf"tabular*}}{{\textwidth}}{{@{{\extracolsep{{\fill}}}}{columns}@{{}}"
    body = "\n\\addlinespace\n".join(rf"\raggedright {' & '.join(row)} \\" for row in rows)
    return "\n".join(_lines(columns, " & ".join(names) + r" \\", body))


def latex_cell(cell: str | Cell) -> str:
    """A cell: its values, and their intervals below."""
    if isinstance(cell, str):
        return escaped(cell)
    texts = []
    for value in cell.values:
        text = rf"\textbf{{{escaped(value.text)}}}" if value.best else escaped(value.text)
        dagger = value.mark.replace("†", r"\dagger")
        texts.append(text + (f"$^{{{dagger}}}$" if dagger else ""))
    if not any(value.low for value in cell.values):
        return stack(*texts, align="l")
    ends = (
        "--" if value.low == DASH else rf"[{escaped(value.low)},\,{escaped(value.high)}]"
        for value in cell.values
    )
    return stack(cell.joint.join(texts), rf"{{\scriptsize {'/'.join(ends)}}}")


def stack(*lines: str, align: str = "c") -> str:
    """Lines of LaTeX below one another in one cell."""
    return rf"\begin{{tabular}}[t]{{@{{}}{align}@{{}}}}" + r"\\".join(lines) + r"\end{tabular}"


def _name(name: str) -> list[str]:
    """A variant's name in LaTeX, what is in parentheses on a line of its own."""
    return escaped(name).replace(" (", "\n(", 1).split("\n")
