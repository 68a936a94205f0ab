"""Train under emulated processors and compare with this one to the bit.

    python -m tools.cross_cpu [--short] [--engine torch]        (make cross-cpu)

Libraries ask the processor what it can do, and who made it, and choose their code by that; under
qemu-user the emulated processor answers. Every environment and variant is trained for some episodes
on this processor, and again under each emulated one, which compiles everything for itself.
Trainings are also begun here and ended there, and the other way round. What is there in the end has
to equal the undisturbed training here byte for byte. So have Table 1 and Figure 1, made of the kept
runs in reference/.

An emulator does what the instructions are defined to do. So this finds whatever depends on which
instructions are chosen, but not what real processors make of the same ones.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product, zip_longest
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

from mace_rl import files
from mace_rl.results.paper import ENVIRONMENTS, VARIANTS

ROOT = Path(__file__).resolve().parent.parent
QEMU = "qemu-x86_64"
# Older ones read the wrong numbers where a gather, of which NumPy has many, has its index in ymm4:
# https://gitlab.com/qemu-project/qemu/-/issues/2474
OLDEST_QEMU = (9, 1)
HERE = "here"
PROCESSORS = ("Haswell", "EPYC", "Dhyana")  # by Intel, AMD, and Hygon, which few libraries know
HALVED = "mace_full"  # the variant with most in its checkpoint
# More than the 10 updates after which the meta network learns.
EPISODES = {"Acrobot-v1": 14, "CartPole-v1": 60, "HopperBulletEnv-v0": 60}
# So small that memory and buffer are full before the end, and what is in them is replaced.
CHANGES = {"memory": {"capacity": 50}, "novelty": {"buffer_size": 100}}
SHORT = {  # --short: every environment and every variant, each under one processor
    "Haswell": ("mace_full", "CartPole-v1"),
    "EPYC": ("mace_fixed", "HopperBulletEnv-v0"),
    "Dhyana": ("ppo", "Acrobot-v1"),
}


TABLES = Path("reference")  # in the place of an environment: what is made of the runs there
TABLE_FILES = tuple(f"table1.{kind}" for kind in ("csv", "tex")) + tuple(
    f"figure1{kind}" for kind in (".csv", "_seeds.csv", ".png", ".pdf")
)


class Training(NamedTuple):
    """One training, or the tables and figures of the kept runs."""

    processor: str
    environment: str
    variant: str
    half: str = ""  # "begun" or "ended" if that half is done here

    def __str__(self) -> str:
        halved = f", {self.half} here" if self.half else ""
        if self.environment == str(TABLES):
            return f"{self.processor} Table 1 and Figure 1"
        return f"{self.processor} {self.environment} {self.variant}{halved}"


Step = tuple[Training, bool]  # a training, or what is left of it; whether to stop half way


class CrossError(RuntimeError):
    """Trainings that could not be carried out; the message says where and why."""


class Interrupted(Exception):
    """A training was, as it should be."""


def planned(short: bool) -> list[Training]:
    """What is trained under the emulated processors."""
    trainings = []
    for processor in PROCESSORS:
        cells = [SHORT[processor]] if short else product(VARIANTS, ENVIRONMENTS)
        for variant, environment in cells:
            halves = ("", "begun", "ended") if variant == HALVED else ("",)
            trainings += [Training(processor, environment, variant, half) for half in halves]
        if not short:
            trainings.append(Training(processor, str(TABLES), ""))
    return trainings


def train() -> None:
    """Train as the command line says, as JSON: engine, then environment, variant, folder, halt.

    A process trains all that there is for a processor: emulated, importing and compiling take
    minutes. It prints the number of what it has done.
    """
    from mace_rl.cli import CONFIG
    from mace_rl.config.reading import merge_layers
    from mace_rl.config.run import RunConfig
    from mace_rl.config.section import check
    from mace_rl.config.study import read_study
    from mace_rl.runs import run

    engine, *tasks = json.loads(sys.argv[1])
    study = read_study([CONFIG])
    for number, (environment, variant, folder, halt) in enumerate(tasks):
        if environment == str(TABLES):
            tabulate(Path(folder))
            print(f"\nfinished {number}", flush=True)
            continue
        settings = study.run_config(environment, variant, 0).settings()
        changes: dict[str, Any]
        changes = {section: values for section, values in CHANGES.items() if section in settings}
        changes |= {"engine": engine, "episodes": EPISODES[environment]}
        config = check(RunConfig, merge_layers(settings, changes), "tools/cross_cpu.py")
        if halt:
            begin(run, config, Path(folder))
        else:
            run.run(config, Path(folder))
        print(f"\nfinished {number}", flush=True)


def tabulate(folder: Path) -> None:
    """Make `TABLE_FILES` of the kept runs as the workflow's rules do."""
    import pandas as pd

    from mace_rl.cli import CONFIG
    from mace_rl.config.study import read_study
    from mace_rl.results import figures, latex, summary
    from mace_rl.results.metrics_table import metrics_table
    from mace_rl.results.records import read_episodes

    study = read_study([CONFIG, CONFIG.parent / "config" / "reference.yaml"])
    settings, frames = study.metrics, {}
    for run in study.runs():
        environment, variant, seed = run
        path = TABLES / "runs" / environment / variant / f"seed{seed}" / files.EPISODES
        frames[run] = read_episodes(path, study.run_config(*run).episodes)
    table = summary.table1(metrics_table(frames, list(frames), settings), settings)
    folder.mkdir(parents=True)
    (folder / "table1.csv").write_text(table.to_csv(index=False), encoding="utf-8")
    fragment = latex.table1_latex(table, study.labels, settings)
    (folder / "table1.tex").write_text(fragment, encoding="utf-8")
    shown = figures.quantity("1", settings)
    seeds = figures.seed_curves(frames, shown)
    curves = figures.mean_curves(seeds, shown, settings)
    data = {"figure1.csv": curves, "figure1_seeds.csv": seeds}
    for name, frame in data.items():
        (folder / name).write_text(frame.to_csv(index=False), encoding="utf-8")
    drawn, drawn_seeds = (pd.read_csv(folder / name) for name in data)
    figure = figures.draw_figure(
        drawn,
        drawn_seeds,
        shown,
        study.figure,
        settings.confidence,
        study.labels,
        study.colours,
    )
    for name in ("figure1.pdf", "figure1.png"):  # as the rule does: each saving lays out anew
        figures.save_figure(figure, folder / name)


def begin(run: Any, config: Any, folder: Path) -> None:
    """Let the module `run` train to half of the episodes, and leave the checkpoint in `folder`."""

    def interrupt(progress: dict[str, Any]) -> None:
        if progress["episode"] > config.episodes // 2:
            raise Interrupted

    every_round: dict[str, Any]
    every_round = {"CHECKPOINT_SECONDS": 0.0, "CHECKPOINT_COST": 1e9, "OBSERVER_SECONDS": 0.0}
    os.environ.pop(run.CHECKPOINT_VARIABLE, None)  # which would come before the first of these
    try:
        with patch.multiple(run, **every_round):
            run.run(config, folder, interrupt)
    except Interrupted:
        return
    raise CrossError(f"{folder}: the training was not interrupted")


def carry_out(
    processor: str, prefix: Sequence[str], engine: str, steps: Sequence[Step], scratch: Path
) -> Iterator[Step]:
    """Carry out steps in a new process, whose command starts with `prefix`; yields each when done.

    The results are in a folder below `scratch` with the training's name. Raises `CrossError` if the
    process ends too early.
    """
    command = [*prefix, sys.executable, "-c", "from tools.cross_cpu import train; train()"]
    tasks = [(t.environment, t.variant, str(scratch / str(t)), halt) for t, halt in steps]
    left = dict(enumerate(steps))
    with (
        tempfile.TemporaryFile("w+", errors="replace") as errors,
        subprocess.Popen(
            [*command, json.dumps([engine, *tasks])],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            errors="replace",
            cwd=ROOT,
            env=os.environ | {"NUMBA_CACHE_DIR": str(scratch / "numba" / processor)},
        ) as process,
    ):
        assert process.stdout is not None  # a pipe, as asked for
        try:
            for line in process.stdout:
                if number := re.fullmatch(r"finished (\d+)\n", line):
                    yield left.pop(int(number[1]))
            process.wait()
        finally:
            process.kill()
        errors.seek(0)
        said = [line for line in errors.read().splitlines() if line.strip()]
    if process.returncode or left:
        reason = said[-1] if said else f"exit code {process.returncode}"
        raise CrossError(f"{processor}: FAILED, {len(left)} of {len(steps)} steps left: {reason}")


def emulate(
    emulator: str, engine: str, trainings: Sequence[Training], scratch: Path, processor: str
) -> list[Training]:
    """Carry out what is to be done under one processor; returns the trainings that ended equal.

    None does if the process that they come from fails in the end.
    """
    equal = []
    steps = [(t, t.half == "ended") for t in trainings if t.processor == processor]
    try:
        prefix = [emulator, "-cpu", processor]
        for training, halted in carry_out(processor, prefix, engine, steps, scratch):
            if not halted and judge(training, scratch):
                equal.append(training)
    except CrossError as error:
        print(error, flush=True)
        return []
    return equal


def judge(training: Training, scratch: Path) -> bool:
    """Whether a training ended as the undisturbed one here did; prints a line that says so."""
    undisturbed = training._replace(processor=HERE, half="")
    if training.environment == str(TABLES):
        folders = scratch / str(undisturbed), scratch / str(training)
        pairs = ([folder / name for folder in folders] for name in TABLE_FILES)
        found = ", ".join(a.name for a, b in pairs if a.read_bytes() != b.read_bytes())
    else:
        found = difference(scratch / str(undisturbed), scratch / str(training), bool(training.half))
    print(f"{training}: {f'DIFFERENT: {found}' if found else 'equal'}", flush=True)
    return not found


def difference(wanted: Path, found: Path, resumed: bool = False) -> str:
    """What is wrong with the results in `found`; empty if they equal those in `wanted`.

    Names the files that differ, the first such row of `episodes.csv`, and libraries that compute
    with other instructions. A training that should be `resumed` must not have started afresh.
    """
    records = [json.loads((folder / files.RECORD).read_bytes()) for folder in (wanted, found)]
    if resumed and not records[1]["interruptions"]:
        return "it was not continued, but started afresh"
    parts = []
    for name in files.RESULTS:
        contents = [(folder / name).read_bytes() for folder in (wanted, found)]
        if contents[0] != contents[1]:
            parts.append(f"{name} from {row(*contents)}" if name == files.EPISODES else name)
    if parts:
        expected, used = (record["arithmetic"] for record in records)
        parts += [f"{key} computes with {used[key]}" for key in used if used[key] != expected[key]]
    return ", ".join(parts)


def row(wanted: bytes, found: bytes) -> str:
    """The first row in which two different `episodes.csv` differ, and the first column there."""
    tables = [content.decode(errors="replace").split("\n") for content in (wanted, found)]
    for number, rows in enumerate(zip_longest(*tables, fillvalue="nothing")):
        cells = (line.split(",") for line in (tables[0][0], *rows))
        for column, value, other in zip_longest(*cells, fillvalue="nothing"):
            if value != other:
                return f"row {number} ({column} is {other}, not {value})"
    raise ValueError("the two are equal")


def qemu() -> str:
    """The emulator's path; exits with one line if it is missing, or too old to be right."""
    oldest = ".".join(map(str, OLDEST_QEMU))
    wanted = f"this wants Debian's package qemu-user, version {oldest} or newer"
    path = shutil.which(QEMU)
    if path is None:
        sys.exit(f"cross-cpu: there is no {QEMU}; {wanted}")
    said = subprocess.run([path, "--version"], capture_output=True, text=True, check=True).stdout
    version = re.search(r"version (\d+)\.(\d+)", said)
    if version is None or tuple(map(int, version.groups())) < OLDEST_QEMU:
        sys.exit(f"cross-cpu: {said.splitlines()[0]} computes wrongly; {wanted}")
    return path


def main() -> None:
    """Run everything; exit with 1 unless every outcome is equal."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.cross_cpu --short"
    )
    parser.add_argument(
        "--short",
        action="store_true",
        help="three trainings under Haswell, one under each of the others",
    )
    parser.add_argument(
        "--engine", choices=["compiled", "torch"], default="compiled", help="(default: compiled)"
    )
    arguments = parser.parse_args()
    emulator, engine = qemu(), arguments.engine
    trainings = planned(arguments.short)
    undisturbed = dict.fromkeys(t._replace(processor=HERE, half="") for t in trainings)
    first = [(t, False) for t in undisturbed] + [(t, True) for t in trainings if t.half == "begun"]
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        try:
            for training, halted in carry_out(HERE, [], engine, first, scratch):
                if not halted:
                    print(f"{training}: done", flush=True)
            with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
                work = partial(emulate, emulator, engine, trainings, scratch)
                equal = [t for found in pool.map(work, PROCESSORS) for t in found]
            left = [t for t in trainings if t.half == "ended"]
            begun = [(t, False) for t in left if (scratch / str(t) / files.CHECKPOINT).exists()]
            equal += [
                t for t, _ in carry_out(HERE, [], engine, begun, scratch) if judge(t, scratch)
            ]
        except CrossError as error:
            sys.exit(f"cross-cpu: {error}")
    kinds = {
        "trainings": lambda t: t.environment != str(TABLES) and not t.half,
        "continued on another processor": lambda t: bool(t.half),
        "Table 1 and Figure 1": lambda t: t.environment == str(TABLES),
    }
    counts = (
        f"{sum(map(kind, equal))} of {sum(map(kind, trainings))} {name}"
        for name, kind in kinds.items()
        if any(map(kind, trainings))
    )
    print(f"{', '.join(counts)}: equal to the bit under {len(PROCESSORS)} emulated processors")
    sys.exit(len(equal) != len(trainings))


if __name__ == "__main__":
    main()
