"""The paper's Table 1 and Table 2, and the supplement, as LaTeX.

Fragments for \\input; they need the package booktabs and nothing else.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from mace_rl.config.agent import CompiledNetwork, PPOConfig, TorchModule
from mace_rl.config.results import MetricsConfig
from mace_rl.results.metrics import Metric
from mace_rl.results.paper import PAPER_METRICS
from mace_rl.results.statistics import BOOTSTRAP_SEEDS, interval_kind
from mace_rl.results.tables import companions, digits_by_metric, from_to

PAPER_SETTINGS = {  # Paper, Table 2, in its order, as LaTeX; the optimiser, Adam, is the last
    "actor_learning_rate": "Actor Learning Rate",
    "critic_learning_rate": "Critic Learning Rate",
    "discount": r"Discount Factor ($\gamma$)",
    "epochs": "PPO Epochs ($K$)",
    "clip": r"PPO Clip Parameter ($\epsilon$)",
}
OWN_SETTINGS = {  # what the paper leaves open; a setting that is not here is named after its key
    "gae_lambda": r"GAE Parameter ($\lambda$)",
    "rollout_steps": "Steps per Update, at least (whole episodes)",
    "minibatch_size": "Minibatch Size (steps)",
    "network": "Network of Actor and of Critic",
    "hidden_units": "Hidden Units of Actor and of Critic",
    "initial_log_std": "Initial Log Standard Deviation (continuous actions)",
    "max_gradient_norm": "Maximal Gradient Norm",
    "normalise_observations": "Normalised Observations",
    "entropy_coefficient": "Entropy Coefficient",
    "critic": "Critic",
    "scale_rewards": "Rewards over the Deviation of their Discounted Sums",
    "scale_advantages": "Advantages over their Root Mean Square, by Kind of Reward",
    "smallest_advantage": "Smallest Scale of Extrinsic Advantages",
    "centre_advantages": "Centred Advantages",
}

INTERVALS = {"t": "$t$", "bootstrap": "bootstrap"}  # by `interval_kind`
COLUMNS_PER_BLOCK = 3  # environments, or variants, side by side; more continue below

_LATEX = str.maketrans(  # escapes stand for letters that look like Latin ones
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": "$<$", ">": "$>$", "|": "$|$", "±": r"$\pm$", "\u00d7": r"$\times$"}
    | {"\u2013": "--", "\u2014": "---", "₀": "$_0$", "≤": r"$\leq$", "≥": r"$\geq$"}
    | {"\u03b1": r"$\alpha$", "β": r"$\beta$", "\u03b3": r"$\gamma$", "δ": r"$\delta$"}
    | {"ε": r"$\epsilon$", "ϵ": r"$\epsilon$", "η": r"$\eta$", "θ": r"$\theta$"}
    | {"λ": r"$\lambda$", "μ": r"$\mu$", "\u03c3": r"$\sigma$", "τ": r"$\tau$"}
)


def escaped(text: str) -> str:
    """`text` with LaTeX's special characters escaped and symbols such as β in math mode."""
    return text.translate(_LATEX)


def table1_latex(table: pd.DataFrame, labels: Mapping[str, str], settings: MetricsConfig) -> str:
    """Table 1 in the paper's layout from `table1`: sample efficiency / convergence steps.

    Rows are variants (by their `labels`), columns are environments. Below each pair of means stand
    their intervals. The lowest mean of each environment and metric is bold, as displayed; ties are
    all bold, and a mean of seeds that all never got there is not.
    """
    environments, variants = list(table["env"].unique()), list(table["variant"].unique())
    cells = _cells(table)
    best = {
        key: _number(group["mean"].min())
        for key, group in table[table["censored"] < table["seeds"]].groupby(["env", "metric"])
    }

    def cell(environment: str, variant: str) -> str:
        rows = [cells[environment, variant, metric] for metric in PAPER_METRICS]
        bars = [best.get((environment, metric)) for metric in PAPER_METRICS]
        means = [
            _mean(row, best=row.censored < row.seeds and _number(row.mean) == bar)
            for row, bar in zip(rows, bars, strict=True)
        ]
        intervals = "/".join(map(_interval, rows))
        return _stack(" / ".join(means), rf"{{\scriptsize {intervals}}}")

    blocks = [
        _tabular(
            ["Algorithm", *map(escaped, block)],
            [
                [
                    r"\newline ".join(_label(variant, labels)),
                    *(cell(name, variant) for name in block),
                ]
                for variant in variants
            ],
        )
        for block in _blocks(environments)
    ]
    caption = (
        "Sample efficiency / convergence steps, in training episodes."
        " Lower is better for both; the lowest mean is \\textbf{bold}. "
    )
    return _float(caption + _how(table, settings.confidence), "tab:table1", blocks)


def supplement_latex(
    table: pd.DataFrame, labels: Mapping[str, str], settings: MetricsConfig
) -> str:
    """The companion metrics from `supplement`: a table per environment, its columns variants."""
    cells, shown = _cells(table), digits_by_metric(table, settings)

    def cell(environment: str, variant: str, metric: Metric) -> str:
        row, digits = cells[environment, variant, metric.name], shown[environment, metric.name]
        return _stack(_mean(row, digits), rf"{{\scriptsize {_interval(row, digits)}}}")

    floats = []
    for name, own in table.groupby("env", sort=False):
        environment = str(name)
        blocks = [
            _tabular(
                ["", *(_stack(*_label(variant, labels)) for variant in block)],
                [
                    [escaped(metric.label), *(cell(environment, name, metric) for name in block)]
                    for metric in companions(settings)
                ],
            )
            for block in _blocks(list(table["variant"].unique()))
        ]
        caption = f"{escaped(environment)}, the companion metrics. {_how(own, settings.confidence)}"
        floats.append(_float(caption, f"tab:supplement:{environment}", blocks))
    return "\n".join(floats)


def table2_latex(ppo: Mapping[str, PPOConfig]) -> str:
    """Table 2, the PPO hyperparameters, from the resolved settings of each environment.

    The paper's six rows, then this project's further settings. A value that is not the same in all
    environments is shown for each.
    """
    own = [name for name in PPOConfig.model_fields if name not in PAPER_SETTINGS]
    rows = [[label, _setting(ppo, name)] for name, label in PAPER_SETTINGS.items()]
    rows.append(["Optimizer", "Adam"])
    further = [
        [OWN_SETTINGS.get(name, name.replace("_", " ").title()), _setting(ppo, name)]
        for name in own
    ]
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
        *(f"\\raggedright {name} & {value} \\\\" for name, value in rows),
        r"\midrule",
        *(f"\\raggedright {name} & {value} \\\\" for name, value in further),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _float(caption: str, label: str, blocks: Sequence[str]) -> str:
    """A table as wide as the page, its tabulars below one another."""
    lines = [
        r"\begin{table*}[tbp]",
        r"\centering",
        rf"\caption{{{caption}}}",
        rf"\label{{{label}}}",
        r"\par\medskip",
        r"\footnotesize",
        r"\setlength{\tabcolsep}{2pt}",
        "\n\\par\\medskip\n".join(blocks),
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def _blocks(names: Sequence[str]) -> list[Sequence[str]]:
    """`names` in parts that fit side by side."""
    starts = range(0, len(names), COLUMNS_PER_BLOCK)
    return [names[start : start + COLUMNS_PER_BLOCK] for start in starts]


def _tabular(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A tabular of \\textwidth: a head and rows of cells."""
    columns = r"p{0.23\textwidth}" + "c" * (len(head) - 1)
    lines = [
        rf"\begin{{tabular*}}{{\textwidth}}{{@{{\extracolsep{{\fill}}}}{columns}@{{}}}}",
        r"\toprule",
        " & ".join(head) + r" \\",
        r"\midrule",
        "\n\\addlinespace\n".join(rf"\raggedright {' & '.join(row)} \\" for row in rows),
        r"\bottomrule",
        r"\end{tabular*}",
    ]
    return "\n".join(lines)


def _stack(*lines: str) -> str:
    """Lines below one another in one cell."""
    return r"\begin{tabular}[t]{@{}c@{}}" + r"\\".join(lines) + r"\end{tabular}"


def _label(variant: str, labels: Mapping[str, str]) -> list[str]:
    """A variant's name, what is in parentheses on a line of its own."""
    return escaped(labels.get(variant, variant)).replace(" (", "\n(", 1).split("\n")


def _cells(table: pd.DataFrame) -> dict[tuple[str, str, str], Any]:
    """The rows of a `summary` by environment, variant and metric."""
    rows: Iterable[Any] = table.itertuples()
    return {(row.env, row.variant, row.metric): row for row in rows}


def _number(value: float, digits: int = 0) -> str:
    return f"{value:z.{digits}f}".replace("-", "$-$")


def _mean(row: Any, digits: int = 0, best: bool = False) -> str:
    """A mean over seeds, bold if it is the best, with the number of censored seeds."""
    text = _number(row.mean, digits)
    text = rf"\textbf{{{text}}}" if best else text
    return text + (rf"$^{{\dagger{row.censored}}}$" if row.censored else "")


def _interval(row: Any, digits: int = 0) -> str:
    if np.isnan(row.low):
        return "--"
    return rf"[{_number(row.low, digits)},\,{_number(row.high, digits)}]"


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


def _setting(ppo: Mapping[str, PPOConfig], name: str) -> str:
    """The value of one setting, for each group of environments that share it."""
    environments: dict[str, list[str]] = {}
    for environment, config in ppo.items():
        environments.setdefault(_value(getattr(config, name)), []).append(environment)
    if len(environments) == 1:
        return next(iter(environments))
    lines = (f"{value} ({escaped(', '.join(names))})" for value, names in environments.items())
    return r"\begin{tabular}[t]{@{}l@{}}" + r"\\".join(lines) + r"\end{tabular}"


def _value(value: Any) -> str:
    """A setting's value in LaTeX."""
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
            return escaped(value.module)
        case float() if "e" in repr(value):
            mantissa, exponent = repr(value).split("e")
            return rf"${mantissa} \times 10^{{{int(exponent)}}}$"
        case _:
            return escaped(str(value))
