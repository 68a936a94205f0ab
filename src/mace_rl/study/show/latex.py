"""The paper's Table 1 and Table 2 as LaTeX to \\input."""

from collections.abc import Mapping

import pandas as pd

from mace_rl.config.agent import PPOConfig
from mace_rl.study.compare.statistics import BOOTSTRAP_SEEDS, interval_kind
from mace_rl.study.compare.summary import from_to
from mace_rl.study.metrics_config import MetricsConfig
from mace_rl.study.show import tables
from mace_rl.study.show.cells import escaped, latex_cell, latex_float

INTERVALS = {"t": "$t$", "bootstrap": "bootstrap"}  # by `interval_kind`


def table1_latex(table: pd.DataFrame, labels: Mapping[str, str], settings: MetricsConfig) -> str:
    """Table 1 in the paper's layout from `summary.table1`."""
    caption = (
        "Sample efficiency / convergence steps, in training episodes."
        " Lower is better for both; the lowest mean is \\textbf{bold}. "
    ) + _how(table, settings.confidence)
    return latex_float(caption, "tab:table1", tables.table1(tables.named(table, labels)))


def table2_latex(ppo: Mapping[str, PPOConfig]) -> str:
    """Table 2, the PPO hyperparameters: the paper's rows, a line, and this project's."""
    rows = [
        f"\\raggedright {escaped(name)} & {latex_cell(value)} \\\\"
        for name, value in tables.table2(ppo).to_numpy()
    ]
    papers = len(tables.PAPER_SETTINGS) + 1  # and Adam
    lines = [
        r"\begin{table}[tbp]",
        r"\centering",
        r"\caption{PPO hyperparameters: those of the paper, and below the line those that it leaves"
        " open.}",
        r"\label{tab:table2}",
        r"\par\medskip",
        r"\footnotesize",
        r"\begin{tabular}{@{}p{0.42\linewidth}l@{}}",
        r"\toprule",
        r"Hyperparameter & Value \\",
        r"\midrule",
        *rows[:papers],
        r"\midrule",
        *rows[papers:],
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _how(table: pd.DataFrame, confidence: float) -> str:
    """The part of a caption that says from what the numbers come."""
    seeds = sorted(table["seeds"].unique())
    budgets: dict[str, list[str]] = {}
    for environment, group in table.groupby("env", sort=False):
        budget = " or ".join(str(episodes) for episodes in group["episodes"].unique())
        budgets.setdefault(budget, []).append(str(environment))
    budget = "; ".join(
        f"{episodes} episodes ({escaped(', '.join(environments))})"
        for episodes, environments in budgets.items()
    )
    level = escaped(f"{100 * confidence:g}")
    kinds = dict.fromkeys(INTERVALS[interval_kind(count)] for count in seeds if count > 1)
    if kinds:
        kind = f" (below {BOOTSTRAP_SEEDS} seeds) or ".join(kinds)
        none = "; one seed allows none" if seeds[0] == 1 else ""
        text = (
            f"Means over {from_to(table['seeds'])} seeds and, below,"
            f" their {level}\\,\\% {kind} intervals{none}."
        )
    else:
        text = "One seed, which allows no interval."
    text += f" Training budget: {budget}."
    if table["censored"].any():
        text += (
            r" $^{\dagger k}$: $k$ of the seeds never got there and count with the whole budget,"
            " a lower bound."
        )
    return text
