"""What tools.show prints of the tables and verdicts of a study."""

import json
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mace_rl.results.claims import LEVEL, LITERAL, ROBUST, WORTH_MENTIONING
from mace_rl.results.claims_text import parts_table
from mace_rl.results.paper import PPO
from mace_rl.results.statistics import probability_of_improvement
from tools.shown.cells import SETTINGS, mean, number, percent, short

SOLVED = 0.9  # of the last episodes, for a seed to count
AREA = "area_under_curve"


def headline(folder: Path) -> list[str]:
    """How many claims came out how, and what the learned β changes in the return of training."""
    found = _claims(folder)
    counts = Counter(claim[ROBUST]["verdict"] for claim in found["claims"])
    literal = Counter(claim[LITERAL]["verdict"] for claim in found["claims"])
    verdicts = ("reproduced", "contradicted", "inconclusive")
    total = len(found["claims"])
    robust = ", ".join(f"{counts[verdict]} {verdict}" for verdict in verdicts)
    words = ", ".join(f"{literal[verdict]} {verdict}" for verdict in verdicts)
    parts = [part for claim in found["claims"] for part in claim[ROBUST]["parts"]]
    failed = [part for part in parts if part["outcome"] == "fails"]
    opposite = [part for part in failed if part["p_holm"] < LEVEL and part["difference"] < 0]
    overall = next(
        part for part in parts if len(part["environments"]) > 1 and part["baseline"] == PPO
    )
    return [
        f"**Of the paper's {total} claims: {robust}** by robust metrics ({words} {LITERAL})."
        f" {len(opposite) or 'None'} of the {len(failed)} comparisons that fail"
        f" {'show' if len(opposite) > 1 else 'shows'} the opposite of the claim;"
        f" {'each of the others' if opposite else 'each'} rules out an improvement of"
        f" {100 * WORTH_MENTIONING:.0f} %."
        " Over the paper's environments the mean"
        " return of training with the learned β differs from PPO's by"
        f" {percent(overall['difference'])} of the way from random actions to the reference"
        f" return (95 % interval {percent(overall['low'])} to {percent(overall['high'])}, at"
        f" least {overall['seeds']} seeds in each environment)."
    ]


def ledger(folder: Path) -> list[str]:
    """The verdicts."""
    lines = [
        f"| | the paper's claim | {LITERAL} | {ROBUST} | the paper's own Table 1 |",
        "|---|---|---|---|---|",
    ]
    for claim in _claims(folder)["claims"]:
        verdicts = " | ".join(claim[how]["verdict"] for how in (LITERAL, ROBUST))
        lines.append(f"| {claim['claim']} | {claim['statement']} | {verdicts} | {claim['paper']} |")
    return lines


def parts(folder: Path, how: str = ROBUST) -> list[str]:
    """Every part of every claim."""
    return parts_table(_claims(folder)["claims"], how)


def table1(folder: Path) -> list[str]:
    """Sample efficiency / convergence by variant and environment: ours, and the paper's."""
    table = pd.read_csv(folder / "table1.csv")
    environments = list(table["env"].unique())
    lines = [f"| | {' | '.join(environments)} |", "|---" * (1 + len(environments)) + "|"]
    for variant in table["variant"].unique():
        cells = []
        for environment in environments:
            rows = table[(table["env"] == environment) & (table["variant"] == variant)]
            means = " / ".join(
                f"{row['mean']:.0f}" + (f"†{row['censored']}" if row["censored"] else "")
                for _, row in rows.iterrows()
            )
            ends = " / ".join(
                f"{row['low']:.0f} to {row['high']:.0f}" for _, row in rows.iterrows()
            )
            paper = " / ".join(f"{value:.0f}" for value in rows["paper"])
            cells.append(f"{means} ({ends}); paper: {paper}")
        lines.append(f"| {variant} | {' | '.join(cells)} |")
    return lines


def means(folder: Path, *columns: str) -> list[str]:
    """Means over seeds with their intervals."""
    table = pd.read_csv(folder / "metrics.csv")
    wanted = list(columns) or ["final_return", AREA]
    lines = [f"| | | seeds | {' | '.join(wanted)} |", "|---" * (3 + len(wanted)) + "|"]
    for (environment, variant), runs in table.groupby(["env", "variant"], sort=False):
        cells = " | ".join(mean(runs[column]) for column in wanted)
        lines.append(f"| {environment} | {variant} | {len(runs)} | {cells} |")
    return lines


def solved(folder: Path) -> list[str]:
    """Seeds that solve a task, of how many, and the mean return of training."""
    return _columns(
        folder,
        lambda runs: (
            f"{int((runs['solved'] >= SOLVED).sum())} of {len(runs)}; {short(runs[AREA].mean())}"
        ),
    )


def constants(folder: Path) -> list[str]:
    """The mean return of training by variant."""
    return _columns(folder, lambda runs: mean(runs[AREA]))


def finals(folder: Path) -> list[str]:
    """The final return, that of the worst seed, and the mean return of training by variant."""
    return _columns(
        folder,
        lambda runs: (
            f"{short(runs['final_return'].mean())} [{short(runs['final_return'].min())}] /"
            f" {short(runs[AREA].mean())}"
        ),
    )


def regret(folder: Path) -> list[str]:
    """regret.csv."""
    lines = ["| | best constant | its return | learned β | regret | seeds |", "|---" * 6 + "|"]
    for _, row in pd.read_csv(folder / "regret.csv", keep_default_na=False).iterrows():
        cells = [row["env"], row["best_constant"], *map(short, row[["best_area", "variant_area"]])]
        regret, low, high = (number(row[name], 4) for name in ("regret", "low", "high"))
        interval = f" ({low} to {high})" if low else ""
        lines.append(f"| {' | '.join(cells)} | {regret}{interval} | {row['seeds']} |")
    return lines


def improvement(folder: Path, metric: str = AREA) -> list[str]:
    """P(a run of one is better) in each environment and over all, from comparisons.csv."""
    table = _comparisons(folder, metric)
    environments = list(table["env"].unique())
    lines = [f"| | {' | '.join(environments)} |", "|---" * (1 + len(environments)) + "|"]
    for (variant, baseline), rows in table.groupby(["variant", "baseline"], sort=False):
        values = rows.set_index("env")
        cells = [
            f"{values.loc[name, 'probability']:.2f} ({values.loc[name, 'probability_low']:.2f} to"
            f" {values.loc[name, 'probability_high']:.2f})"
            for name in environments
        ]
        lines.append(f"| {variant} over {baseline} | {' | '.join(cells)} |")
    return lines


def differences(folder: Path, metric: str = AREA) -> list[str]:
    """Mean of the paired differences, with their test by itself and corrected."""
    lines = ["| | | seeds | difference | p | p, corrected |", "|---" * 6 + "|"]
    for _, row in _comparisons(folder, metric).iterrows():
        if pd.isna(row["difference"]):
            continue  # over all environments there is a probability only
        value, low, high = (short(row[name]) for name in ("difference", "low", "high"))
        tests = " | ".join(f"{row[name]:.4f}" for name in ("p_value", "p_holm"))
        lines.append(
            f"| {row['env']} | {row['variant']} − {row['baseline']} | {row['seeds']} |"
            f" {value} ({low} to {high}) | {tests} |"
        )
    return lines


def together(folder: Path, *words: str) -> list[str]:
    """P(a run of one variant is better) over all environments that two have in any of the studies.

    The first word that is no folder beside `folder` is the variant, the others are those it is
    compared with. Where several studies have the same runs, the one that has most of them counts.
    """
    names = [word for word in words if (folder.parent / word).is_dir()]
    variant, *others = [word for word in words if word not in names] or [""]
    if not others:
        sys.exit("show: together wants a variant and those to compare it with")
    runs: dict[tuple[str, str], np.ndarray] = {}
    for place in (folder, *(folder.parent / name for name in names)):
        table = pd.read_csv(place / "metrics.csv")
        for (env, name), rows in table.groupby(["env", "variant"], sort=False):
            areas = rows[AREA].to_numpy(np.float64)
            key = str(env), str(name)
            runs[key] = max(areas, runs.get(key, areas[:0]), key=len)
    lines = ["| | environments | seeds in each | probability |", "|---" * 4 + "|"]
    for other in others:
        both = [env for env, name in runs if name == other and (env, variant) in runs]
        if not both:
            sys.exit(f"show: no environment has runs of both {variant!r} and {other!r}")
        pairs = [(runs[env, variant], runs[env, other]) for env in both]
        generator = np.random.default_rng(SETTINGS.bootstrap_seed)
        value, low, high = probability_of_improvement(
            pairs, SETTINGS.confidence, SETTINGS.bootstrap_repetitions, generator
        )
        counts = {min(len(x), len(y)) for x, y in pairs}
        seeds = str(*counts) if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
        lines.append(
            f"| {variant} over {other} | {len(both)} | {seeds} |"
            f" {value:.2f} ({low:.2f} to {high:.2f}) |"
        )
    return lines


def aggregate(folder: Path) -> list[str]:
    """aggregate.csv."""
    lines = ["| | | runs | mean | interquartile mean |", "|---" * 5 + "|"]
    for _, row in pd.read_csv(folder / "aggregate.csv").iterrows():
        cells = [
            f"{row[name]:.3f} ({row[f'{name}_low']:.3f} to {row[f'{name}_high']:.3f})"
            for name in ("mean", "iqm")
        ]
        lines.append(
            f"| {row['metric']} | {row['variant']} | {row['runs']} | {' | '.join(cells)} |"
        )
    return lines


def readings(folder: Path) -> list[str]:
    """readings.md as it is."""
    return (folder / "readings.md").read_text(encoding="utf-8").splitlines()


def _claims(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "claims.json").read_text(encoding="utf-8")))


def _comparisons(folder: Path, metric: str) -> pd.DataFrame:
    """The rows of comparisons.csv on one metric."""
    table = pd.read_csv(folder / "comparisons.csv")
    table = table[table["metric"] == metric]
    if table.empty:
        sys.exit(f"show: {folder / 'comparisons.csv'} has no metric {metric!r}")
    return table


def _columns(folder: Path, cell: Callable[[pd.DataFrame], str]) -> list[str]:
    """A table of metrics.csv with a line per variant and a column per environment."""
    table = pd.read_csv(folder / "metrics.csv")
    environments = list(table["env"].unique())
    lines = [f"| | {' | '.join(environments)} |", "|---" * (1 + len(environments)) + "|"]
    for variant in table["variant"].unique():
        own = table[table["variant"] == variant]
        groups = [own[own["env"] == name] for name in environments]
        cells = [cell(runs) if len(runs) else "" for runs in groups]
        lines.append(f"| {variant} | {' | '.join(cells)} |")
    return lines
