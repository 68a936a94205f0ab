"""The paper's claims asked of every reading of its learned β: reference/readings/protocol.md.

A part of `make tables`. Only a reading all of whose runs are kept is asked.
"""

import json
import statistics
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path

import pandas as pd

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.config.run import RunConfig
from mace_study.compare.comparisons import ALL, comparisons
from mace_study.compare.specification import MOVES, asked_beta, specification
from mace_study.config.metrics import MetricsConfig
from mace_study.config.study import read_study
from mace_study.measure.betas import betas_table
from mace_study.measure.metrics_csv import metrics_table
from mace_study.show import worlds
from mace_study.show.curves import save_figure
from mace_study.show.markdown import page
from mace_study.show.sections import Section
from tools import kept_runs

ROOT = Path(__file__).resolve().parent.parent
# By world the folder that its runs are in, and the seeds of each environment.
WORLDS = {
    "tuned": ("tuned", dict.fromkeys(("Acrobot-v1", "CartPole-v1"), range(200, 240))),
    "plain": ("plain", {"Acrobot-v1": range(300, 500), "CartPole-v1": range(300, 400)}),
}
BASELINES = ("ppo", "mace_fixed")
DEFAULT = "mace_full"
READINGS = (
    *(DEFAULT, "mace_score", "mace_progress", "mace_return", "mace_centred", "mace_words"),
    *("mace_credit_network", "mace_evidence"),
)
DECIDES = "robust"


def measured(
    path: Path, variant: str, seeds: range, settings: MetricsConfig
) -> tuple[pd.DataFrame, list[float]] | None:
    """Rows of metrics.csv and betas.csv of a variant's runs, and how far each asked β deviates.

    None where runs are lacking.
    """
    there = kept_runs.read(path, [variant])
    if not {(variant, seed) for seed in seeds} <= {*there}:
        return None
    frames, moved = {}, []
    for seed in seeds:
        record, frame = there[variant, seed]
        config = RunConfig.model_validate(json.loads(record)["config"])
        frames[config.environment, variant, seed] = frame
        if variant not in BASELINES:
            moved.append(float(asked_beta(frame["beta"].to_numpy(), config).std()))
    both = metrics_table(frames, settings), betas_table(frames, settings)
    return both[0].merge(both[1], on=["env", "variant", "seed"]), moved


def asked(
    folder: Path, seeds: Mapping[str, range], settings: MetricsConfig, cores: int
) -> tuple[pd.DataFrame, dict[str, float]]:
    """The runs of one world, and of each reading that is complete there how much its β moves."""
    jobs = [(name, env) for name in (*BASELINES, *READINGS) for env in seeds]
    paths = [folder / f"{files.folder_of(env)}.parquet" for _, env in jobs]
    variants, ranges = zip(*((name, seeds[env]) for name, env in jobs), strict=True)
    with ProcessPoolExecutor(cores) as pool:
        made = pool.map(measured, paths, variants, ranges, repeat(settings))
        found = dict(zip(jobs, made, strict=True))
    whole = {
        name: [part for env in seeds if (part := found[name, env]) is not None]
        for name in (*BASELINES, *READINGS)
    }
    whole = {name: own for name, own in whole.items() if len(own) == len(seeds)}
    if lacking := [name for name in BASELINES if name not in whole]:
        raise Refusal(f"{folder} lacks runs of {', '.join(lacking)}")
    table = pd.concat([rows for own in whole.values() for rows, _ in own], ignore_index=True)
    moved = {name: [one for _, runs in own for one in runs] for name, own in whole.items()}
    return table, {name: statistics.median(moved[name]) for name in READINGS if name in whole}


def make(kept: Path, goal: Path, cores: int) -> list[str]:
    """Make what the module says; returns the names, none if no world is there."""
    study = read_study([ROOT / "config.yaml"])
    found, compared, moved = [], [], {}
    for world, (place, seeds) in WORLDS.items():
        if (kept / place).exists():
            table, deviations = asked(kept / place, seeds, study.metrics, cores)
            own = specification(table, study.metrics, ROOT / study.claims, deviations, DECIDES)
            found.append(own.assign(world=world))
            pairs = [[name, other] for name in deviations for other in BASELINES]
            own = comparisons(table, study.metrics.model_copy(update={"comparisons": pairs}))
            compared.append(own[own["env"] != ALL].assign(world=world))
            moved[world] = deviations
    if not found:
        return []
    answers = pd.concat(found, ignore_index=True)
    shown = [name for name in READINGS if name in set(answers["reading"])]
    goal.mkdir(parents=True, exist_ok=True)
    answers.to_csv(goal / "specification.csv", index=False)
    pd.concat(compared).to_csv(goal / "comparisons.csv", index=False)
    betas = pd.DataFrame(moved).rename_axis("reading").reset_index()
    betas.to_csv(goal / "deviations.csv", index=False, float_format="%.4f")
    save_figure(worlds.draw_specification(answers, shown), goal / "specification.png")
    text = page("readings", ORIGIN, sections(answers, betas), ["specification"])
    (goal / "README.md").write_text(text, encoding="utf-8")
    names = ("specification.csv", "comparisons.csv", "deviations.csv", "specification.png")
    return [*names, "README.md"]


ORIGIN = "By `make tables`, from the runs of [the protocol](../../readings/protocol.md)."


def sections(answers: pd.DataFrame, betas: pd.DataFrame) -> list[Section]:
    """The tables of the page: the answers world by world, and how much β moves."""
    found = []
    for world, own in answers.groupby("world", sort=False):
        said = own["verdict"].where(own["whole"], own["verdict"] + " †")
        wide = own.assign(verdict=said).pivot(index="claim", columns="reading", values="verdict")
        order = own[["claim", "statement"]].drop_duplicates("claim")
        wide = wide[[name for name in READINGS if name in wide]].fillna("").reset_index()
        same = shared(own).rename("as the default")
        frame = order.merge(wide).merge(same, "left", left_on="claim", right_index=True).fillna("")
        frame = frame.sort_values("claim", key=lambda names: names.str[1:].astype(int))
        note = (
            "†: the claim is about Hopper, too, whose runs are of the default alone; asked of the"
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
    for claim, own in answers[answers["whole"]].groupby("claim", sort=False):
        said = own.set_index("reading")["verdict"]
        if DEFAULT in said:
            found[claim] = f"{(said == said[DEFAULT]).sum()} of {len(said)}"
    return pd.Series(found, dtype=object)
