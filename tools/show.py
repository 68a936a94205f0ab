"""Print what the kept results say, as the Markdown that README and docs have between marks.

    .venv/bin/python -m tools.show WHAT FOLDER [...]

FOLDER is one of reference/tables, or the results of any study; of the last four reference/study
and reference/measured. WHAT is one of

    headline    what holds, in three sentences                                      (claims.json)
    ledger      a verdict for each claim                                           (claims.json)
    parts       what the verdicts rest on, part by part; `parts FOLDER robust`     (claims.json)
    table1      Table 1, the paper's numbers beside ours                            (table1.csv)
    means       final return and mean return of training; `means FOLDER COLUMN ...` (metrics.csv)
    solved      how many seeds solve each task                                     (metrics.csv)
    constants   mean return of training by variant, in columns                     (metrics.csv)
    finals      final return [worst seed] / mean return of training, in columns     (metrics.csv)
    regret      what the learnt β loses against the best constant                   (regret.csv)
    improvement probability that one variant's run is better than another's    (comparisons.csv)
    together    the same over the environments of several studies: `together FOLDER NAME ... VARIANT
                OTHER ...`, NAMEs of folders beside FOLDER                         (metrics.csv)
    aggregate   scores between random and the best run, all environments          (aggregate.csv)
    readings    Table 1 under every reading                                         (readings.md)
    betas       the learnt β at the end of training: `betas FOLDER ENVIRONMENT ...`   (kept runs)
    stagnation  how it goes with stagnation (C9); arguments as of betas            (kept runs)
    shares      the bonus's share of the advantages, by β                       (bonus_share.csv)
    signals     signal and noise of the credit of β                             (meta_signal.csv)
"""

import argparse
import inspect
import io
import json
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mace_rl import files
from mace_rl.config.reading import read_yaml
from mace_rl.config.results import MetricsConfig
from mace_rl.results.claims import (
    LEVEL,
    LITERAL,
    ROBUST,
    WORTH_MENTIONING,
    parts_table,
    stagnation_correlation,
)
from mace_rl.results.metrics import final_return
from mace_rl.results.paper import FULL, PPO
from mace_rl.results.statistics import mean_interval, probability_of_improvement
from tools import archive

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = MetricsConfig.model_validate(read_yaml(ROOT / "config.yaml")["metrics"])
SOLVED = 0.9  # of the last episodes, for a seed to count
AREA = "area_under_curve"


def headline(folder: Path) -> list[str]:
    """How many claims came out how, and what the learnt β changes in the return of training."""
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
        f"**Of the paper's {total} claims: {robust}** by robust metrics ({words} as the paper's own"
        f" code measures). In {len(opposite) or 'none'} of the {len(failed)} comparisons that fail"
        f" is the opposite shown; {'the others' if opposite else 'they'} leave no room for an"
        f" advantage of {100 * WORTH_MENTIONING:.0f} %. Over the paper's environments the mean"
        " return of training with the learned β differs from PPO's by"
        f" {_percent(overall['difference'])} of the way from random actions to the reference"
        f" return (95 % interval {_percent(overall['low'])} to {_percent(overall['high'])}, at"
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
        cells = " | ".join(_mean(runs[column]) for column in wanted)
        lines.append(f"| {environment} | {variant} | {len(runs)} | {cells} |")
    return lines


def solved(folder: Path) -> list[str]:
    """Seeds that solve a task, of how many, and the mean return of training."""
    return _columns(
        folder,
        lambda runs: (
            f"{int((runs['solved'] >= SOLVED).sum())} of {len(runs)}; {_short(runs[AREA].mean())}"
        ),
    )


def constants(folder: Path) -> list[str]:
    """The mean return of training by variant."""
    return _columns(folder, lambda runs: _mean(runs[AREA]))


def finals(folder: Path) -> list[str]:
    """The final return, that of the worst seed, and the mean return of training by variant."""
    return _columns(
        folder,
        lambda runs: (
            f"{_short(runs['final_return'].mean())} [{_short(runs['final_return'].min())}] /"
            f" {_short(runs[AREA].mean())}"
        ),
    )


def regret(folder: Path) -> list[str]:
    """regret.csv."""
    lines = ["| | best constant | its return | learned β | regret | seeds |", "|---" * 6 + "|"]
    for _, row in pd.read_csv(folder / "regret.csv", keep_default_na=False).iterrows():
        cells = [row["env"], row["best_constant"], *map(_short, row[["best_area", "variant_area"]])]
        regret, low, high = (_number(float(row[name]), 4) for name in ("regret", "low", "high"))
        lines.append(f"| {' | '.join(cells)} | {regret} ({low} to {high}) | {row['seeds']} |")
    return lines


def improvement(folder: Path, metric: str = AREA) -> list[str]:
    """P(a run of one is better) in each environment and over all, from comparisons.csv."""
    table = pd.read_csv(folder / "comparisons.csv")
    table = table[table["metric"] == metric]
    if table.empty:
        sys.exit(f"show: {folder / 'comparisons.csv'} has no metric {metric!r}")
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


def betas(folder: Path, *environments: str) -> list[str]:
    """The mean β of the last tenth of the episodes, of each seed, in order of size."""
    lines = ["| | seeds | β at the end |", "|---|---|---|"]
    for environment in environments:
        found = sorted(
            final_return(episodes["beta"].to_numpy(), 0.1)
            for episodes in _learnt(folder, environment)
        )
        numbers = ", ".join(f"{beta:.2f}" for beta in found)
        lines.append(f"| {environment} | {len(found)} | {numbers} |")
    return lines


def stagnation(folder: Path, *environments: str) -> list[str]:
    """The correlation of stagnation with the learnt β that follows (C9): mean over seeds."""
    lines = ["| | seeds | correlation |", "|---|---|---|"]
    for environment in environments:
        found = pd.Series(
            [
                stagnation_correlation(
                    episodes["extrinsic_return"].to_numpy(np.float64),
                    episodes["beta"].to_numpy(),
                    SETTINGS.moving_average,
                )
                for episodes in _learnt(folder, environment)
            ]
        )
        lines.append(f"| {environment} | {len(found)} | {_mean(found, '.3f')} |")
    return lines


def _learnt(folder: Path, environment: str) -> list[pd.DataFrame]:
    """The episodes of the kept runs in which β was learnt, in the order of seeds."""
    kept = archive.read(folder / environment / f"{FULL}.tar.xz")
    names = (name for name in kept if name.endswith(files.EPISODES))
    return [pd.read_csv(io.BytesIO(kept[name])) for name in names]


def shares(folder: Path) -> list[str]:
    """The share in the first tenth of the updates / in the last, by variant."""
    table = pd.read_csv(folder / "bonus_share.csv")
    variants = list(table["variant"].unique())
    lines = [f"| | seeds | {' | '.join(variants)} |", "|---" * (2 + len(variants)) + "|"]
    for environment, rows in table.groupby("env", sort=False):
        found = {row.variant: f"{row.first:.2f} / {row.last:.2f}" for row in rows.itertuples()}
        cells = " | ".join(found.get(variant, "") for variant in variants)
        lines.append(f"| {environment} | {rows['seeds'].min()} | {cells} |")
    return lines


def signals(folder: Path) -> list[str]:
    """Each measure of `tools.meta_signal` in the first / second / last third of training."""
    table = pd.read_csv(folder / "meta_signal.csv")
    measures = list(table["measure"].unique())
    lines = [f"| | seeds | {' | '.join(measures)} |", "|---" * (2 + len(measures)) + "|"]
    for (environment, episodes, seeds), rows in table.groupby(
        ["env", "episodes", "seeds"], sort=False
    ):
        found = {name: rows.loc[rows["measure"] == name, "value"] for name in measures}
        cells = [" / ".join(_number(value, 2) for value in found[name]) for name in measures]
        lines.append(f"| {environment}, {episodes} | {seeds} | {' | '.join(cells)} |")
    return lines


def _claims(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "claims.json").read_text(encoding="utf-8")))


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


def _mean(values: pd.Series, form: str = ".4g") -> str:
    """A mean over seeds with the interval of the tables."""
    numbers = values.to_numpy(np.float64)
    generator = np.random.default_rng(SETTINGS.bootstrap_seed)
    low, high = mean_interval(
        numbers, SETTINGS.confidence, SETTINGS.bootstrap_repetitions, generator
    )
    shown = [format(value, form).replace("-", "−") for value in (numbers.mean(), low, high)]
    return f"{shown[0]} ({shown[1]} to {shown[2]})"


def _short(value: float | str) -> str:
    """Four significant digits, with a true minus; an empty cell stays empty."""
    return f"{float(value):.4g}".replace("-", "−") if value != "" else ""


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−")


def _percent(share: float) -> str:
    return f"{100 * share:.2f} %".replace("-", "−")


SHOWN: dict[str, Callable[..., list[str]]] = {
    function.__name__: function
    for function in (
        *(headline, ledger, parts, table1, means, solved, constants, regret, improvement),
        *(finals, together, aggregate, readings, betas, stagnation, shares, signals),
    )
}


def main() -> None:
    """Entry point; exits with what is wrong with the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m tools.show means reference/tables/study",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=SHOWN, metavar="WHAT")
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("more", nargs="*", metavar="...")
    arguments = parser.parse_args()
    show = SHOWN[arguments.what]
    try:
        inspect.signature(show).bind(arguments.folder, *arguments.more)
    except TypeError:
        sys.exit(f"show: {arguments.what} does not take {' '.join(arguments.more)!r}")
    try:
        lines = show(arguments.folder, *arguments.more)
    except OSError as error:
        sys.exit(f"show: {error.filename}: {error.strerror}")
    except KeyError as error:
        sys.exit(f"show: there is no {error} in what {arguments.folder} has")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
