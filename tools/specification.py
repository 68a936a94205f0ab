"""The paper's claims asked of every reading of its learned β: reference/readings/protocol.md.

A part of `make tables`. Only a reading all of whose runs are kept is asked.
"""

import json
import statistics
from collections.abc import Collection, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.config.run import RunConfig
from mace_study.compare import ceiling
from mace_study.compare.claims_config import parse_claims, parts_of
from mace_study.compare.comparisons import comparisons
from mace_study.compare.specification import MOVES, alone, asked_beta, in_tasks, specification
from mace_study.config.metrics import MetricsConfig
from mace_study.config.study import read_study
from mace_study.measure.betas import betas_table
from mace_study.measure.metrics import OF_BETAS, all_metrics, metric_units
from mace_study.measure.metrics_csv import metrics_table
from mace_study.show import worlds
from mace_study.show.curves import save_figure
from mace_study.show.markdown import page
from mace_study.show.sections import Section
from mace_study.show.tables import number
from tools import kept_runs

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "config.yaml"
WORLDS = {  # the seeds of each environment
    "tuned": dict.fromkeys(("Acrobot-v1", "CartPole-v1"), range(200, 240)),
    "plain": {"Acrobot-v1": range(300, 500), "CartPole-v1": range(300, 400)},
}
# What tools.ceiling wrote, with the world of each row; its controls are tasks of these files.
CEILING = ROOT / "reference" / "measured" / "ceiling.csv"
CONTROLS = [ROOT / "config" / "tasks.yaml", ROOT / "config" / "planted.yaml"]
BASELINES = ("ppo", "mace_fixed")
# By claim of ours the files of its study over config.yaml, the last also the runs' folder; seeds.
TASKS = {"P1": (["tasks"], range(200, 220)), "G2": (["tasks", "minigrid"], range(700, 720))}
# By problem its kinds of episodes, which take turns. (A trial reset takes the first of the two.)
PLANTED = {"Help": ["helps"], "Nothing": ["tells nothing"], "Harm": ["harms"]}
PLANTED |= {"Mixed": ["mixed: harms", "mixed: helps"]}
HELD_OUT = range(320, 340)
DEFAULT = "mace_full"
READINGS = (
    *(DEFAULT, "mace_score", "mace_progress", "mace_return", "mace_centred", "mace_words"),
    *("mace_credit_network", "mace_evidence"),
)
OTHERS = ("mace_constant_input", "mace_untrusting", "mace_credit", "mace_pretrained")
DECIDES = "robust"


def asked_by(run: kept_runs.Kept) -> np.ndarray:
    """The β that is asked for in each episode of a run, [E]."""
    config = RunConfig.model_validate(json.loads(run.record)["config"])
    return asked_beta(run.episodes["beta"].to_numpy(), config)


def end_of_beta(run: kept_runs.Kept, first: int = 0, step: int = 1) -> float:
    """Its mean over the last tenth of a run, or over each `step`-th episode of that."""
    asked = asked_by(run)
    return float(asked[-(len(asked) // 10) :][first::step].mean())


class Measured(NamedTuple):
    """The runs of a variant in one environment."""

    rows: pd.DataFrame  # of metrics.csv and betas.csv, the columns that are asked for
    deviations: list[float]  # how far the β that is asked for deviates, of each
    first: dict[int, float]  # by seed the mean return of the episodes that the ceiling is about


def measured(
    cell: tuple[str, str],
    runs: Mapping[int, kept_runs.Kept],
    settings: MetricsConfig,
    columns: Collection[str],
) -> Measured:
    """The runs of an environment and variant, by seed; columns: of metrics.csv and betas.csv."""
    frames = {(*cell, seed): run.episodes for seed, run in runs.items()}
    returns = {seed: run.episodes["extrinsic_return"] for seed, run in runs.items()}
    first = {seed: float(own[: ceiling.LAST].mean()) for seed, own in returns.items()}
    moved = [float(asked_by(run).std()) for run in runs.values() if cell[1] in READINGS]
    metrics = [metric for metric in all_metrics(settings) if metric.name in columns]
    rows = metrics_table(frames, settings, metrics)
    if of_betas := [name for name in OF_BETAS if name in columns]:
        rows = rows.merge(betas_table(frames, settings, of_betas), on=["env", "variant", "seed"])
    return Measured(rows, moved, first)


def asked(
    folder: Path,
    seeds: Mapping[str, range],
    settings: MetricsConfig,
    baselines: Sequence[str],
    columns: Collection[str],
) -> dict[tuple[str, str], Measured]:
    """By environment and variant the runs of baselines and of the readings that have them all.

    columns: as of `measured`.
    """
    found = {}
    for name, env in product((*baselines, *READINGS), seeds):
        there = kept_runs.read(folder / f"{files.folder_of(env)}.parquet", [name])
        runs = {seed: there[name, seed] for seed in seeds[env] if (name, seed) in there}
        if len(runs) == len(seeds[env]):
            found[env, name] = measured((env, name), runs, settings, columns)
    names = {name for _, name in found}
    whole = [name for name in names if all((env, name) in found for env in seeds)]
    if lacking := [name for name in baselines if name not in whole]:
        raise Refusal(f"{folder} lacks runs of {', '.join(lacking)}")
    return {job: runs for job, runs in found.items() if job[1] in whole}


def in_our_tasks(kept: Path) -> pd.DataFrame:
    """`in_tasks` of `TASKS`."""
    found = []
    for claim, (layers, seeds) in TASKS.items():
        study = read_study([CONFIG, *(ROOT / "config" / f"{layer}.yaml" for layer in layers)])
        path = ROOT / study.claims
        [family] = alone(parse_claims(path), claim).families.values()
        [part] = family.claims[claim].parts[DECIDES]
        each = dict.fromkeys(part.environments, seeds)
        runs = asked(kept / layers[-1], each, study.metrics, part.over, [part.metric])
        table = pd.concat([of_env.rows for of_env in runs.values()], ignore_index=True)
        readings = [name for name in READINGS if name in set(table["variant"])]
        found.append(in_tasks(table, study.metrics, path, readings, claim, DECIDES))
    return pd.concat(found, ignore_index=True)


def in_planted(kept: Path) -> pd.DataFrame:
    """Which β is asked for where the right one is known, on held-out seeds, by all that set one.

    Columns: the bonus (`PLANTED`), variant, seeds, mean, least, most (of the seeds), above (0.8: of
    how many seeds), below (0.1), return (mean, of all training).
    """
    rows = []
    for problem, kinds in PLANTED.items():
        there = kept_runs.read(kept / "planted" / f"Planted{problem}-v0.parquet")
        variants = [name for name in (*READINGS, *OTHERS) if (name, HELD_OUT[0]) in there]
        for (first, kind), variant in product(enumerate(kinds), variants):
            runs = [there[variant, seed] for seed in HELD_OUT]
            ends = np.array([end_of_beta(run, first, len(kinds)) for run in runs])
            returns = [run.episodes["extrinsic_return"].mean() for run in runs]
            found = ends.mean(), ends.min(), ends.max(), sum(ends > 0.8), sum(ends < 0.1)
            rows.append((kind, variant, len(ends), *found, np.mean(returns)))
    names = ["seeds", "mean", "least", "most", "above", "below", "return"]
    return pd.DataFrame(rows, columns=["bonus", "variant", *names])


def make(kept: Path, goal: Path) -> list[str]:
    """Make what the module says; returns the files' names in `goal`, none if a world is lacking."""
    if not all((kept / world).exists() for world in WORLDS):
        return []
    study = read_study([CONFIG])
    families = parse_claims(ROOT / study.claims).families.values()
    columns = {part.metric for family in families for _, part in parts_of(family)}
    columns |= {*metric_units(study.metrics)}  # to compare
    found, compared, moved, earned = [], [], {}, []
    for world, seeds in WORLDS.items():
        runs = asked(kept / world, seeds, study.metrics, BASELINES, columns)
        table = pd.concat([of_env.rows for of_env in runs.values()], ignore_index=True)
        by_reading: dict[str, list[float]] = {}
        for (_, name), of_env in runs.items():
            by_reading.setdefault(name, []).extend(of_env.deviations)
        moved[world] = {
            name: statistics.median(by_reading[name]) for name in READINGS if name in by_reading
        }
        first = {job: of_env.first for job, of_env in runs.items()}
        earned.append(ceiling.over_ppo(first, study.metrics).assign(world=world))
        answers = specification(table, study.metrics, ROOT / study.claims, moved[world], DECIDES)
        found.append(answers.assign(world=world))
        pairs = [[name, other] for name in moved[world] for other in BASELINES]
        asked_for = study.metrics.model_copy(update={"comparisons": pairs})
        compared.append(comparisons(table, asked_for, together=False).assign(world=world))
    forks, metrics = pd.read_csv(CEILING), read_study([CONFIG, *CONTROLS]).metrics
    tables = {
        "specification": pd.concat(found, ignore_index=True),
        "comparisons": pd.concat(compared),
        "deviations": pd.DataFrame(moved).round(4).rename_axis("reading").reset_index(),
        "tasks": in_our_tasks(kept),
        "planted": in_planted(kept),
        "gains": ceiling.gains(forks, metrics),
        "effects": ceiling.effects(forks, metrics),
        "ceiling": pd.concat([ceiling.of_oracle(forks, metrics), *earned], ignore_index=True),
    }
    answers = tables["specification"]
    shown = [name for name in READINGS if name in set(answers["reading"])]
    pictures = {
        "specification": worlds.draw_specification(answers, shown),
        "ceiling": worlds.draw_gains(tables["ceiling"]),
    }
    told = [*sections(answers, tables["deviations"])]
    told += of_tasks(tables["tasks"], tables["planted"])
    told += of_ceiling(tables["gains"], tables["effects"])
    goal.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        table.to_csv(goal / f"{name}.csv", index=False)
    for name, picture in pictures.items():
        save_figure(picture, goal / f"{name}.png")
    (goal / "README.md").write_text(page("readings", ORIGIN, told, [*pictures]), encoding="utf-8")
    return [*(f"{name}.csv" for name in tables), *(f"{name}.png" for name in pictures), "README.md"]


def of_ceiling(gains: pd.DataFrame, effects: pd.DataFrame) -> list[Section]:
    """The tables of what any learner could gain."""
    shown = gains.assign(
        where=gains["env"] + " (" + gains["world"] + ")",
        gained=[span(row, "gain", 1 if abs(row["mean"]) > 1 else 3) for _, row in gains.iterrows()],
        p=gains["p_value"].map("{:.4f}".format),
    )[["where", "episodes", "over", "seeds", "gained", "p"]]
    note = (
        f"At every tenth of the first {ceiling.LAST} episodes an oracle takes the β of 0, 0.1, 0.4"
        " and 1 whose four forks, of so many episodes, have the best mean. Gained: in the mean"
        " return of these, over the same seeds. *p*: of no difference."
    )
    told = effects.assign(
        where=effects["env"] + " (" + effects["world"] + ")",
        effect=[span(row, "effect", 2 if row["noise"] > 1 else 4) for _, row in effects.iterrows()],
        noise=effects["noise"].map("{:.3g}".format),
        needed=effects["needed"].map("{:,.0f}".format),
    )[["where", "episodes", "stretch", "effect", "noise", "needed"]]
    what = (
        "What β = 1 earns over β = 0 in each of the next episodes (`stretch` of them), beside the"
        " noise of one such stretch. *Needed*: episodes in all that tell the two apart with a"
        " probability of 0.8, by this effect."
    )
    return [
        Section("The most that any could gain", note, shown.map(str)),
        Section("What β does to the next episodes", what, told.map(str)),
    ]


def span(row: pd.Series, name: str, digits: int) -> str:
    """A value with its interval."""
    value, low, high = (number(row[key], digits) for key in (name, "low", "high"))
    return f"{value} ({low} to {high})"


def of_tasks(tasks: pd.DataFrame, planted: pd.DataFrame) -> list[Section]:
    """The tables of tasks in which the weight matters."""
    shown = tasks.assign(
        difference=[span(row, "difference", 3) for _, row in tasks.iterrows()],
        p=tasks["p_holm"].map("{:.4f}".format),
    )[["claim", "reading", "over", "seeds", "difference", "p", "outcome", "verdict"]]
    note = (
        "P1: mean return of training over five tasks in which no constant is good in all; G2: over"
        " MiniGrid's four. As shares of what solving gives; *p* is corrected for a reading's parts."
    )
    digits = dict.fromkeys(("mean", "least", "most"), "{:.3f}") | {"return": "{:.1f}"}
    ends = planted.assign(**{name: planted[name].map(how.format) for name, how in digits.items()})
    what = (
        "By what the bonus does. β: the mean over the last tenth of training. Above, below: in how"
        " many of seeds 320 to 339 it is above 0.8, below 0.1. Return: mean of all training."
    )
    return [
        Section("Where the weight matters", note, shown.map(str)),
        Section("Planted problems: the β that is asked for", what, ends.astype(str)),
    ]


ORIGIN = "By `make tables`, from the runs of [the protocol](../../readings/protocol.md)."


def sections(answers: pd.DataFrame, betas: pd.DataFrame) -> list[Section]:
    """The tables of the page: the answers world by world, and how much β moves."""
    found = []
    for world, of_world in answers.groupby("world", sort=False):
        said = of_world["verdict"].where(of_world["whole"], of_world["verdict"] + " †")
        wide = of_world.assign(verdict=said).pivot(
            index="claim", columns="reading", values="verdict"
        )
        order = of_world[["claim", "statement"]].drop_duplicates("claim")
        wide = wide[[name for name in READINGS if name in wide]].fillna("").reset_index()
        same = shared(of_world).rename("as the default")
        frame = order.merge(wide).merge(same, "left", left_on="claim", right_index=True).fillna("")
        frame = frame.sort_values("claim", key=lambda names: names.str[1:].astype(int))
        note = (
            "†: the claim is about Hopper, too, where not all readings have runs; asked of the"
            f" other environments, and not counted. *As the default*: readings with {DEFAULT}'s"
            " answer, of all."
        )
        found.append(Section(f"{world}: each claim, by reading", note, frame.map(str)))
    note = (
        "Median over trainings of the standard deviation of the β that the network asks for,"
        f" without what a reading adds to learn by. Above {MOVES} β moves."
    )
    frame = betas.set_index("reading").map("{:.3f}".format, na_action="ignore").fillna("–")
    frame = frame.reset_index()
    return [*found, Section("How much β moves", note, frame)]


def shared(answers: pd.DataFrame) -> pd.Series:
    """By whole claim of one world, how many readings share the default's answer, of how many."""
    found = {}
    for claim, of_claim in answers[answers["whole"]].groupby("claim", sort=False):
        said = of_claim.set_index("reading")["verdict"]
        if DEFAULT in said:
            found[claim] = f"{(said == said[DEFAULT]).sum()} of {len(said)}"
    return pd.Series(found, dtype=object)
