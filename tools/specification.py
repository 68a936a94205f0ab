"""The paper's claims asked of every reading of its learned β: reference/readings/protocol.md.

    python -m tools.specification FOLDER GOAL      `make tables` does it, too

FOLDER/WORLD/runs has the runs of each of `WORLDS` that is there. Only a reading all of whose runs
are there is asked. Into GOAL come the answers, their picture, and a page.
"""

import argparse
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pandas as pd

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.runs.finished import FinishedRun
from mace_study.compare.specification import MOVES, asked_beta, specification
from mace_study.config.metrics import MetricsConfig
from mace_study.config.study import Study, read_study
from mace_study.measure.betas import betas_table
from mace_study.measure.metrics_csv import metrics_table
from mace_study.show import worlds
from mace_study.show.curves import save_figure
from mace_study.show.markdown import page
from mace_study.show.sections import Section

ROOT = Path(__file__).resolve().parent.parent
# By world the folder that its runs are in, and the seeds of each environment.
WORLDS = {
    "tuned": ("tuned", dict.fromkeys(("Acrobot-v1", "CartPole-v1"), range(200, 240))),
    "plain": ("decided", {"Acrobot-v1": range(300, 500), "CartPole-v1": range(300, 400)}),
}
BASELINES = ("ppo", "mace_fixed")
DEFAULT = "mace_full"
READINGS = (
    *(DEFAULT, "mace_score", "mace_progress", "mace_return", "mace_centred", "mace_words"),
    *("mace_credit_network", "mace_evidence"),
)
DECIDES = "robust"
CORES = 2


def measured(run: tuple[Path, MetricsConfig]) -> tuple[pd.DataFrame, float]:
    """A run's row of metrics.csv and betas.csv, and the standard deviation of its `asked_beta`."""
    folder, settings = run
    found = FinishedRun(folder)
    config = found.record["config"]
    frames = {(config["environment"], config["variant"], config["seed"]): found.episodes}
    both = metrics_table(frames, settings), betas_table(frames, settings)
    moved = asked_beta(found).std() if config["variant"] not in BASELINES else 0.0
    return both[0].merge(both[1], on=["env", "variant", "seed"]), float(moved)


def asked(
    folder: Path, seeds: Mapping[str, range], study: Study, cores: int
) -> tuple[pd.DataFrame, dict[str, float]]:
    """The runs of one world, and of each reading that is complete there how much its β moves."""
    places = {
        name: [
            folder / "runs" / files.folder_of(env) / name / f"seed{seed}"
            for env, own in seeds.items()
            for seed in own
        ]
        for name in (*BASELINES, *READINGS)
    }
    whole = {
        name: own
        for name, own in places.items()
        if all((run / files.RECORD).exists() for run in own)
    }
    if lacking := [name for name in BASELINES if name not in whole]:
        raise Refusal(f"{folder} lacks runs of {', '.join(lacking)}")
    jobs = [(run, study.metrics) for own in whole.values() for run in own]
    with ProcessPoolExecutor(cores) as pool:
        rows, moved = zip(*pool.map(measured, jobs, chunksize=20), strict=True)
    table = pd.concat(rows, ignore_index=True)
    deviations = pd.Series(moved).groupby(table["variant"]).median()
    return table, {name: deviations[name] for name in READINGS if name in whole}


def make(folder: Path, goal: Path, cores: int) -> list[str]:
    """Make what the module says; returns the names, none if no world is there."""
    study = read_study([ROOT / "config.yaml"])
    found, moved = [], {}
    for world, (place, seeds) in WORLDS.items():
        if (folder / place / "runs").exists():
            table, deviations = asked(folder / place, seeds, study, cores)
            own = specification(table, study.metrics, ROOT / study.claims, deviations, DECIDES)
            found.append(own.assign(world=world))
            moved[world] = deviations
    if not found:
        return []
    answers = pd.concat(found, ignore_index=True)
    goal.mkdir(parents=True, exist_ok=True)
    answers.to_csv(goal / "specification.csv", index=False)
    betas = pd.DataFrame(moved).rename_axis("reading").reset_index()
    betas.to_csv(goal / "deviations.csv", index=False, float_format="%.4f")
    save_figure(worlds.draw_specification(answers), goal / "specification.png")
    text = page("readings", ORIGIN, sections(answers, betas), ["specification"])
    (goal / "README.md").write_text(text, encoding="utf-8")
    return ["specification.csv", "deviations.csv", "specification.png", "README.md"]


ORIGIN = (
    "By `python -m tools.specification`, from the runs of"
    " [the protocol](../../readings/protocol.md)."
)


def sections(answers: pd.DataFrame, betas: pd.DataFrame) -> list[Section]:
    """The tables of the page: the answers world by world, and how much β moves."""
    found = []
    for world, own in answers.groupby("world", sort=False):
        said = own["verdict"].where(own["whole"], own["verdict"] + " †")
        wide = own.assign(verdict=said).pivot(index="claim", columns="reading", values="verdict")
        order = own[["claim", "statement"]].drop_duplicates("claim")
        wide = wide[list(own["reading"].unique())].fillna("").reset_index()
        same = shared(own).rename("as the default")
        frame = order.merge(wide).merge(same, left_on="claim", right_index=True)
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
    frame = betas.set_index("reading").map("{:.3f}".format).reset_index()
    return [*found, Section("How much β moves", note, frame)]


def shared(answers: pd.DataFrame) -> pd.Series:
    """By whole claim of one world, how many readings share the default's answer, of how many."""
    found = {}
    for claim, own in answers[answers["whole"]].groupby("claim", sort=False):
        said = own.set_index("reading")["verdict"]
        if DEFAULT in said:
            found[claim] = f"{(said == said[DEFAULT]).sum()} of {len(said)}"
    return pd.Series(found, dtype=object)


def main() -> None:
    """Entry point."""
    example = "example: python -m tools.specification results/worlds results/worlds/readings"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], epilog=example)
    parser.add_argument("folder", type=Path, help="where the worlds' folders are")
    parser.add_argument("goal", type=Path, help="where the answers go")
    arguments = parser.parse_args()
    try:
        made = make(arguments.folder, arguments.goal, CORES)
    except (Refusal, OSError) as error:
        sys.exit(f"specification: {error}")
    if not made:
        sys.exit(f"specification: {arguments.folder} has no runs of {' or '.join(WORLDS)}")
    print(*(arguments.goal / name for name in made), sep="\n")


if __name__ == "__main__":
    main()
