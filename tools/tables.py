"""The tables, figures and verdicts of the studies that are kept, without training.

    python -m tools.tables [--check] [--cores N]        (make tables)

Of the kept runs are made, in results/tables/STUDY, the outputs that reference/studies.yaml names,
by the functions that the workflow's rules call, and README.md: tables.md with the pictures that are
among these. What the worlds of reference/worlds/protocol.md say together comes into
results/tables/worlds, and what they say of every reading of the learned β into
results/tables/readings. Pictures are reduced to 256 colours. All is compared with reference/tables.
New files are kept there, and README.md, which only shows the others, is renewed; with --check both
are mistakes.
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

import mace_rl.base.cpu_features  # noqa: F401  isort: skip  (before NumPy: equal bits on every processor)

import pandas as pd
from PIL import Image

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.config.reading import merge, read_options, read_yaml
from mace_rl.runs.finished import require_settings
from mace_rl.training.records import RunKey
from mace_study import results
from mace_study.config.study import load_study
from mace_study.plan import FIGURES, Plan
from tools import kept_runs, specification, worlds

ROOT = Path(__file__).resolve().parent.parent

STUDIES = Path("reference/studies.yaml")
EXPECTED, MADE = Path("reference/tables"), Path("results/tables")
PICTURE = r"\n!\[[^]]*\]\(([^)]*)\)\n"  # as `write_page` writes them
TABLES, README = "tables.md", "README.md"
KEPT, READINGS = Path("reference/worlds"), "readings"
CONFIG = "config.yaml"


def make(name: str, entry: dict[str, Any]) -> int:
    """Make the outputs of one study; returns how many runs it has.

    Raises `Refusal` or `ValueError` with the study's name for what cannot be.
    """
    try:
        return _make(name, entry)
    except (Refusal, ValueError, OSError) as error:
        raise ValueError(f"{name}: {error}") from None


def _make(name: str, entry: dict[str, Any]) -> int:
    folder, given = MADE / name, entry["configfiles"]
    folder.mkdir(parents=True)
    layers = [*(read_yaml(Path(file)) for file in (CONFIG, *given)), read_options(entry["config"])]
    study = load_study(reduce(merge, layers) | {"results": str(folder)}, " + ".join(given))
    plan = Plan(study, ROOT)
    frames, records = kept(plan, Path(entry["runs"]))
    own, outputs = (folder, plan.with_episodes, plan.measured), entry["outputs"]
    options = ["--config", *entry["config"]] if entry["config"] else []
    command = shlex.join(["snakemake", "all", "--configfile", *given, *options])
    pictures = [one for one in (*FIGURES, *plan.pictures) if f"{one}.png" in outputs]
    curves = [one for one in FIGURES if one in pictures]
    readings = plan.read and (plan.has_papers or "readings" in pictures)
    results.measure(frames, plan.measured, folder, curves, plan.paper if readings else None)
    results.tabulate(*own, plan.paper, study.labels)
    results.write_table2(folder, plan.ppo_settings(), plan.paper)
    if plan.judged:
        seconds = sum(record["seconds"] for record in records)
        results.judge(*own, plan.paper, command, seconds)
    every = [*FIGURES, *plan.pictures]
    results.write_page(*own, plan.paper, plan.tabulated, every, command, plan.judged)
    results.draw(folder, pictures, *own[1:], plan.paper, plan.style, plan.judged)
    return len(frames)


def kept(plan: Plan, archives: Path) -> tuple[dict[RunKey, pd.DataFrame], list[dict[str, Any]]]:
    """The records of each run of a study, and its run.json, in the study's order.

    `ValueError` for one that is not kept, `RecordError` for one of another study.
    """
    there: dict[tuple[str, str], dict[int, kept_runs.Kept]] = {}
    frames, records = {}, []
    for environment, variant, seed in plan.runs:
        path = archives / files.folder_of(environment) / f"{variant}.tar.xz"
        pair = environment, variant
        if pair not in there:
            there = {pair: kept_runs.runs_of(path)}  # one at a time: each has millions of texts
        if seed not in there[pair]:
            raise ValueError(f"{path} lacks seed {seed}")
        run = there[pair][seed]
        record = json.loads(run.record)
        require_settings(record["config"], plan.run_settings[pair] | {"seed": seed}, str(path))
        frames[environment, variant, seed] = kept_runs.frame(run)
        records.append(record)
    return frames, records


def write_readme(name: str, outputs: list[str]) -> None:
    """README.md of a study, beside what is kept of it: its name, its tables, these pictures."""
    text = (MADE / name / TABLES).read_text(encoding="utf-8")
    text = re.sub(PICTURE, lambda found: found[0] if found[1] in outputs else "", text)
    text = re.sub("^# .*", f"# {name}", text)
    (MADE / name / README).write_text(text, encoding="utf-8")


def reduce_colours(picture: Path) -> None:
    """Keep 256 colours of a PNG file that cover all of its own, in less than half the bytes.

    Those that are nearest on average would leave out a dot of a colour that is nowhere else.
    """
    with Image.open(picture) as image:
        how = Image.Quantize.MAXCOVERAGE
        reduced = image.convert("RGB").quantize(256, how, dither=Image.Dither.NONE)
    reduced.save(picture, optimize=True)


def difference(name: str, outputs: list[str], check: bool) -> list[str]:
    """The outputs that are not those in `EXPECTED`, where new ones and pages go, unless `check`."""
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
    return different


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
    studies = read_yaml(STUDIES)
    if MADE.exists():
        shutil.rmtree(MADE)
    try:
        with ProcessPoolExecutor(min(cores, len(studies))) as pool:
            counts = [*pool.map(make, studies, studies.values())]
    except ValueError as error:
        sys.exit(f"tables: {error}")
    outputs = {name: entry["outputs"] for name, entry in studies.items()}
    for name in outputs:
        write_readme(name, outputs[name])
        outputs[name] = [*outputs[name], README]
    if together := worlds.make(MADE):
        outputs[worlds.FOLDER] = together
    if asked := specification.make(KEPT, MADE / READINGS, cores):
        outputs[READINGS] = asked
    made = [MADE / name / output for name, own in outputs.items() for output in own]
    with ProcessPoolExecutor(cores) as pool:
        list(pool.map(reduce_colours, [path for path in made if path.suffix == ".png"]))
    different = [
        path for name in outputs for path in difference(name, outputs[name], arguments.check)
    ]
    count = sum(map(len, outputs.values()))
    print(
        f"{count} tables and figures of {len(studies)} studies from {sum(counts)} runs, in {MADE}"
    )
    if different:
        sys.exit("tables: not those that are kept: " + ", ".join(different))


if __name__ == "__main__":
    main()
