"""The paper's claims asked of every reading of its learned β: reference/readings/protocol.md.

A part of `make tables`. Only a reading all of whose runs are kept is asked.
"""

import json
import statistics
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.config.run import RunConfig
from mace_study.compare import ceiling
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
# What tools.ceiling wrote, with the world of each row; its controls are tasks of these files.
CEILING = ROOT / "reference" / "measured" / "ceiling.csv"
CONTROLS = [ROOT / "config" / "tasks.yaml", ROOT / "config" / "planted.yaml"]
BASELINES = ("ppo", "mace_fixed")
DEFAULT = "mace_full"
READINGS = (
    *(DEFAULT, "mace_score", "mace_progress", "mace_return", "mace_centred", "mace_words"),
    *("mace_credit_network", "mace_evidence"),
)
DECIDES = "robust"


class Measured(NamedTuple):
    """The runs of a variant in one environment."""

    rows: pd.DataFrame  # of metrics.csv and betas.csv
    deviations: list[float]  # how far the β that is asked for deviates, of each
    first: dict[int, float]  # by seed the mean return of the episodes that the ceiling is about


def measured(path: Path, variant: str, seeds: range, settings: MetricsConfig) -> Measured | None:
    """A variant's runs; None where some are lacking."""
    there = kept_runs.read(path, [variant])
    if not {(variant, seed) for seed in seeds} <= {*there}:
        return None
    frames, moved, first = {}, [], {}
    for seed in seeds:
        record, frame = there[variant, seed]
        config = RunConfig.model_validate(json.loads(record)["config"])
        frames[config.environment, variant, seed] = frame
        first[seed] = float(frame["extrinsic_return"][: ceiling.LAST].mean())
        if variant not in BASELINES:
            moved.append(float(asked_beta(frame["beta"].to_numpy(), config).std()))
    both = metrics_table(frames, settings), betas_table(frames, settings)
    return Measured(both[0].merge(both[1], on=["env", "variant", "seed"]), moved, first)


def asked(
    folder: Path, seeds: Mapping[str, range], settings: MetricsConfig, cores: int
) -> dict[tuple[str, str], Measured]:
    """By environment and variant the runs of one world, of those that are complete there."""
    jobs = [(env, name) for name in (*BASELINES, *READINGS) for env in seeds]
    paths = [folder / f"{files.folder_of(env)}.parquet" for env, _ in jobs]
    ranges, variants = zip(*((seeds[env], name) for env, name in jobs), strict=True)
    with ProcessPoolExecutor(cores) as pool:
        made = pool.map(measured, paths, variants, ranges, repeat(settings))
        found = {job: runs for job, runs in zip(jobs, made, strict=True) if runs}
    whole = [name for _, name in jobs if all((env, name) in found for env in seeds)]
    if lacking := [name for name in BASELINES if name not in whole]:
        raise Refusal(f"{folder} lacks runs of {', '.join(lacking)}")
    return {job: runs for job, runs in found.items() if job[1] in whole}


def make(kept: Path, goal: Path, cores: int) -> list[str]:
    """Make what the module says; returns the names, none if no world is there."""
    study = read_study([ROOT / "config.yaml"])
    found, compared, moved, earned = [], [], {}, []
    for world, (place, seeds) in WORLDS.items():
        if (kept / place).exists():
            runs = asked(kept / place, seeds, study.metrics, cores)
            table = pd.concat([of_env.rows for of_env in runs.values()], ignore_index=True)
            by_reading: dict[str, list[float]] = {}
            for (_, name), of_env in runs.items():
                by_reading.setdefault(name, []).extend(of_env.deviations)
            deviations = {
                name: statistics.median(by_reading[name]) for name in READINGS if name in by_reading
            }
            first = {job: of_env.first for job, of_env in runs.items()}
            earned.append(ceiling.over_ppo(first, study.metrics).assign(world=world))
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
    told, pictures = sections(answers, betas), ["specification"]
    names = ["specification.csv", "comparisons.csv", "deviations.csv"]
    if CEILING.exists():
        rows = pd.read_csv(CEILING)
        metrics = read_study([ROOT / "config.yaml", *CONTROLS]).metrics
        gains, effects = ceiling.gains(rows, metrics), ceiling.effects(rows, metrics)
        both = pd.concat([of_oracle(rows, metrics), *earned], ignore_index=True)
        for name, table in {"gains": gains, "effects": effects, "ceiling": both}.items():
            table.to_csv(goal / f"{name}.csv", index=False)
            names.append(f"{name}.csv")
        save_figure(worlds.draw_gains(both), goal / "ceiling.png")
        told, pictures = [*told, *of_ceiling(gains, effects)], [*pictures, "ceiling"]
    (goal / "README.md").write_text(page("readings", ORIGIN, told, pictures), encoding="utf-8")
    return [*names, *(f"{name}.png" for name in pictures), "README.md"]


def of_oracle(rows: pd.DataFrame, settings: MetricsConfig) -> pd.DataFrame:
    """What the oracle and β = 0.4 earn over PPO with the seeds of the ceiling, as `over_ppo`."""
    found = []
    for (world, horizon), own in rows.groupby(["world", "episodes"], sort=False):
        named = own.assign(who=own["who"].replace("oracle", f"oracle, H = {horizon}"))
        single = named.drop_duplicates(["env", "who", "seed"])
        means = {
            (str(env), str(who)): dict(zip(each["seed"], each["mean_return"], strict=True))
            for (env, who), each in single.groupby(["env", "who"], sort=False)
        }
        found.append(ceiling.over_ppo(means, settings).assign(world=str(world)))
    return pd.concat(found).drop_duplicates(["world", "env", "variant"])


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
    value, low, high = (f"{row[key]:.{digits}f}".replace("-", "−") for key in (name, "low", "high"))
    return f"{value} ({low} to {high})"


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
