"""The tables, figures and verdicts of the studies that are kept, without training.

    python -m tools.tables [--check] [--cores N]        (make tables)

Of the kept runs of each of `STUDIES` are made, in results/tables/STUDY, its tables and pictures, by
the functions that the workflow's rules call, and README.md: tables.md with these pictures. What the
worlds of reference/worlds/protocol.md say together comes into results/tables/worlds, and what they
say of every reading of the learned β into results/tables/readings. All is compared with
reference/tables. New files are kept there, and README.md, which only shows the others, is renewed;
with --check both are mistakes.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import reduce
from pathlib import Path
from typing import Any

import pandas as pd
from threadpoolctl import threadpool_limits

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.config.reading import merge, read_yaml
from mace_rl.runs.finished import require_settings
from mace_rl.training.records import RunKey
from mace_study import results
from mace_study.config.study import load_study
from mace_study.plan import FIGURES, Plan
from mace_study.show import curves  # noqa: F401  (what draws: once, not in each process)
from tools import kept_runs, specification, worlds

ROOT = Path(__file__).resolve().parent.parent

# The files in config/ of each study whose runs are kept, over config.yaml. The longest come first.
STUDIES = {
    "tasks": ("tasks",),
    "plain": ("plain",),
    "minigrid": ("tasks", "minigrid"),
    "tuned": ("tuned",),
    "planted": ("tasks", "planted"),
    "published": ("published",),
    "initial": ("plain", "initial"),
}
KEPT = Path("reference/worlds")
ELSEWHERE = {"initial": "plain"}  # whose folder of `KEPT` has its runs, if not its own
OF_PAPERS = ("betas.csv", "table1.csv", "table1.tex", "readings.csv", "readings.png")
OF_ALL = ("metrics.csv", "claims.json", "claims.md", "comparisons.csv", "aggregate.csv")
EXPECTED, MADE = Path("reference/tables"), Path("results/tables")
TABLES, README = "tables.md", "README.md"
READINGS = "readings"
CONFIG = "config.yaml"


def make(name: str) -> tuple[int, list[str]]:
    """Make the outputs of one study; returns how many runs it has, and what is kept of them.

    Raises `ValueError` with the study's name for what cannot be.
    """
    try:
        return _make(name)
    except (Refusal, ValueError, OSError) as error:
        raise ValueError(f"{name}: {error}") from None


def _make(name: str) -> tuple[int, list[str]]:
    folder, given = MADE / name, [f"config/{file}.yaml" for file in STUDIES[name]]
    folder.mkdir(parents=True)
    layers = [read_yaml(Path(file)) for file in (CONFIG, *given)]
    study = load_study(reduce(merge, layers) | {"results": str(folder)}, " + ".join(given))
    plan = Plan(study, ROOT)
    frames, records = kept(plan, KEPT / ELSEWHERE.get(name, name))
    made = folder, plan.with_episodes, plan.measured
    command = shlex.join(["snakemake", "all", "--configfile", *given])
    papers = "readings" in plan.tabulated
    pictures = [name for name in plan.pictures if name != "readings" or papers]
    results.measure(frames, plan.measured, folder, FIGURES, plan.paper if papers else None, False)
    results.tabulate(*made, plan.paper, study.labels)
    results.write_table2(folder, plan.ppo_settings(), plan.paper)
    if plan.judged:
        seconds = sum(record["seconds"] for record in records)
        results.judge(*made, plan.paper, command, seconds)
    results.write_page(*made, plan.paper, plan.tabulated, pictures, command, plan.judged)
    results.draw(folder, pictures, *made[1:], plan.paper, plan.style, plan.judged, kinds=["png"])
    wanted = [*OF_ALL, *(OF_PAPERS if papers else ()), *(f"{name}.png" for name in pictures)]
    write_readme(name)
    return len(frames), [*dict.fromkeys(o for o in wanted if (folder / o).exists()), README]


def kept(plan: Plan, folder: Path) -> tuple[dict[RunKey, pd.DataFrame], list[dict[str, Any]]]:
    """The records of each run of a study, and its run.json, in the study's order.

    `ValueError` for one that is not kept, `RecordError` for one of another study.
    """
    there: dict[str, kept_runs.Runs] = {}
    frames, records = {}, []
    for environment, variant, seed in plan.runs:
        path = folder / f"{files.folder_of(environment)}.parquet"
        if environment not in there:
            there = {environment: kept_runs.read(path, plan.study.variants)}  # one at a time
        run = there[environment].get((variant, seed))
        if not run:
            raise ValueError(f"{path} lacks {variant} seed {seed}")
        record = json.loads(run.record)
        settings = plan.run_settings[environment, variant] | {"seed": seed}
        require_settings(record["config"], settings, str(path))
        frames[environment, variant, seed] = run.episodes
        records.append(record)
    return frames, records


def write_readme(name: str) -> None:
    """README.md of a study, beside what is kept of it: its name, its tables and its pictures."""
    text = (MADE / name / TABLES).read_text(encoding="utf-8")
    (MADE / name / README).write_text(re.sub("^# .*", f"# {name}", text), encoding="utf-8")


def difference(name: str, outputs: list[str], check: bool) -> list[str]:
    """What is not as in `EXPECTED`, or gone; new files and pages go there, unless `check`."""
    different = []
    for output in outputs:
        made, expected = MADE / name / output, EXPECTED / name / output
        if expected.exists() and made.read_bytes() == expected.read_bytes():
            continue
        if check or (expected.exists() and output != README):
            different.append(str(expected))
            continue
        print(f"{'renewed' if expected.exists() else 'new'}: {expected}")
        expected.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(made, expected)
    gone = sorted({path.name for path in (EXPECTED / name).glob("*")}.difference(outputs))
    return [*different, *(f"{EXPECTED / name / output} (no longer made)" for output in gone)]


def main() -> None:
    """Entry point; exits with 1 if anything differs from what is kept."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.tables --check"
    )
    parser.add_argument("--check", action="store_true", help="keep and renew nothing")
    parser.add_argument("--cores", default="all", metavar="N", help="jobs at once, default: all")
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    if arguments.cores != "all":
        if not arguments.cores.isdecimal() or not int(arguments.cores):
            parser.error(f"--cores is {arguments.cores!r}, but should be all, or at least 1")
        cores = int(arguments.cores)
    os.chdir(ROOT)
    if MADE.exists():
        shutil.rmtree(MADE)
    threadpool_limits(1)  # in each process
    try:
        with ProcessPoolExecutor(cores) as pool:
            readings = pool.submit(specification.make, KEPT, MADE / READINGS)
            made = dict(zip(STUDIES, pool.map(make, STUDIES), strict=True))
            asked = readings.result()
    except (Refusal, ValueError) as error:
        sys.exit(f"tables: {error}")
    outputs = {name: kept_outputs for name, (_, kept_outputs) in made.items()}
    if together := worlds.make(MADE):
        outputs[worlds.FOLDER] = together
    if asked:
        outputs[READINGS] = asked
    different = [
        path for name in outputs for path in difference(name, outputs[name], arguments.check)
    ]
    different += sorted(str(path) for path in EXPECTED.iterdir() if path.name not in outputs)
    count, runs = sum(map(len, outputs.values())), sum(runs for runs, _ in made.values())
    print(f"{count} tables and figures of {len(made)} studies from {runs} runs, in {MADE}")
    if different:
        sys.exit("tables: not those that are kept: " + ", ".join(different))


if __name__ == "__main__":
    main()
