"""What is made of a study's runs, file by file in its folder of results.

`measure` reads the runs; all others read only what that left. The workflow has a rule for runs,
tables and pictures each, and `make tables` calls all of them one after the other.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from mace_rl.base.files import write_atomically
from mace_rl.base.tables import read_made
from mace_rl.config.agent import PPOConfig
from mace_rl.training.records import RunKey
from mace_study.compare import ledger, verdicts
from mace_study.compare.aggregate import aggregate
from mace_study.compare.claims_config import ClaimsConfig
from mace_study.compare.comparisons import comparisons
from mace_study.compare.readings import readings
from mace_study.compare.summary import split, summary
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.betas import betas_table
from mace_study.measure.metrics_csv import metrics_table, read_metrics
from mace_study.show import markdown, sections
from mace_study.show.latex import table1_latex, table2_latex

Runs = Sequence[Sequence[str | int]]  # of each environment, variant, seed, number of episodes


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a CSV file."""
    write_atomically(path, table.to_csv(index=False))


def measure(
    frames: Mapping[RunKey, pd.DataFrame],
    settings: MetricsConfig,
    folder: Path,
    figures: Iterable[str],
    paper: ClaimsConfig | None,
    every_seed: bool = True,
) -> None:
    """metrics.csv, betas.csv, the curves of the figures, and the readings of `paper`'s Table 1.

    frames: the records of each run; paper: None without readings.csv; every_seed: False to write
    the curves of single seeds only where the figure shows some.
    """
    from mace_study.show import curves  # draws: a second

    table = metrics_table(frames, settings)
    write_table(folder / "metrics.csv", table)
    write_table(folder / "betas.csv", betas_table(frames, settings))
    for figure in figures:
        shown = curves.quantity(figure.removeprefix("figure"), settings)
        seeds = curves.seed_curves(frames, shown)
        means = curves.mean_curves(seeds, shown, settings)
        write_table(folder / f"{figure}.csv", means)
        if every_seed or curves.shows_seeds(means):
            write_table(folder / f"{figure}_seeds.csv", seeds)
    if paper is not None:
        write_table(folder / "readings.csv", readings(frames, table, settings, paper.table1))


def tabulate(
    folder: Path,
    runs: Runs,
    settings: MetricsConfig,
    paper: ClaimsConfig,
    labels: Mapping[str, str],
) -> None:
    """Table 1 and its supplement, comparisons, and all environments together."""
    table = read_metrics(folder / "metrics.csv", runs, settings)
    table1, supplement = split(summary(table, settings, paper.table1), paper.table1)
    write_table(folder / "comparisons.csv", comparisons(table, settings))
    write_table(folder / "aggregate.csv", aggregate(table, settings))
    write_table(folder / "table1.csv", table1)
    write_table(folder / "supplement.csv", supplement)
    write_atomically(folder / "table1.tex", table1_latex(table1, labels, settings, paper.table1))


def write_table2(folder: Path, ppo: Mapping[str, Any], paper: ClaimsConfig) -> None:
    """The hyperparameters; ppo: by environment."""
    configs = {env: PPOConfig.model_validate(settings) for env, settings in ppo.items()}
    write_atomically(folder / "table2.tex", table2_latex(configs, paper.table2))


def judge(
    folder: Path,
    runs: Runs,
    settings: MetricsConfig,
    paper: ClaimsConfig,
    command: str,
    seconds: float,
) -> None:
    """The ledger: what of the paper holds, and what of our own questions (docs/metrics.md).

    seconds: that all runs took, 0 if unknown; command: that makes them.
    """
    data = sections.read_data(folder, ["metrics", "betas"], runs, settings)
    keys = ["env", "variant", "seed"]
    table = data["metrics"].merge(data["betas"], how="left", on=keys, validate="1:1")
    answers, hours = verdicts.ledger(table, settings, paper), seconds / 3600
    cost = {"command": command, "runs": len(table), "core_hours": hours}
    write_atomically(folder / "claims.json", ledger.to_json(cost, answers))
    took = f", {hours:.1f} core-hours" if seconds else ""  # unknown of imported runs
    origin = f"`{command}`: {len(table)} runs{took}."
    page = markdown.page("Does it hold?", origin, sections.of_ledger(answers, paper))
    write_atomically(folder / "claims.md", page)


def write_page(
    folder: Path,
    runs: Runs,
    settings: MetricsConfig,
    paper: ClaimsConfig,
    names: Iterable[str],
    pictures: Sequence[str],
    command: str,
    judged: bool,
) -> None:
    """tables.md: every table on one page, beside `pictures`; names: of its data."""
    data = sections.read_data(folder, names, runs, settings)
    answers = ledger.read_ledger(folder / "claims.json") if judged else []
    shown = [*sections.of_ledger(answers, paper), *sections.of_runs(data, paper, settings)]
    origin = f"`{command}`: {len(runs)} runs."
    page = markdown.page("The tables of this study", origin, shown, pictures)
    write_atomically(folder / "tables.md", page)


def draw(
    folder: Path,
    names: Iterable[str],
    runs: Runs,
    settings: MetricsConfig,
    paper: ClaimsConfig,
    style: Mapping[str, Any],
    judged: bool,
    kinds: Iterable[str] = ("png", "pdf"),
) -> None:
    """Figures and pictures, as files of these kinds, from the data that is in `folder`.

    style: of `plot_style`; judged: whether there is a ledger.
    """
    from mace_study.show import curves, pictures

    names = list(names)
    read = ["metrics", *{"readings"}.intersection(names)]
    data = sections.read_data(folder, read, runs, settings)
    answers = ledger.read_ledger(folder / "claims.json") if judged else []
    look = curves.plot_style(settings, **style)
    for name in names:
        if name in pictures.PICTURES:
            picture = pictures.PICTURES[name]
            table = picture.data(pictures.Source(data, answers, settings, paper))
            if name not in read:
                write_table(folder / f"{name}.csv", table)
            figure = picture.draw(table, look)
        else:
            shown = curves.quantity(name.removeprefix("figure"), settings)
            means = read_made(folder / f"{name}.csv")
            columns = ["env", "variant", "seed", "episode", shown.name]
            seeds = pd.DataFrame(columns=columns)
            if curves.shows_seeds(means):
                seeds = read_made(folder / f"{name}_seeds.csv")
            figure = curves.draw_figure(means, seeds, shown, look)
        curves.save_figure(figure, *(folder / f"{name}.{kind}" for kind in kinds))
