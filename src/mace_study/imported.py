"""Runs of others as run folders, for the workflow's metrics, tables, figures and claims.

A run is a CSV file with a row an episode: stable-baselines3's `monitor.csv`, one of `mace-rl
export`, or any other whose columns are named. A folder is one run of several Monitors, of a vector
environment, whose episodes are put in the order in which they ended, as `load_results` does there.
"""

import argparse
import csv
import itertools
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.base.tables import RecordError
from mace_rl.config.reading import merge, read_yaml
from mace_rl.config.run import IDENTITY
from mace_rl.config.section import ConfigError, check
from mace_rl.run_settings import check_name
from mace_rl.runs import provenance
from mace_rl.runs.export import RUN
from mace_rl.runs.finished import FinishedRun
from mace_rl.training.records import EpisodeRecord, as_columns, write_episodes

STUDY = "study.yaml"  # in the folder of results: what the workflow is to do with it
MONITORS = "*monitor.csv"
# What columns are called, the first that is there: by Monitor, by `mace-rl export`, by others.
RETURN = ("r", "return", "extrinsic_return", "episode_return", "episodic_return", "episode_reward")
LENGTH = ("l", "length", "episode_length", "episodic_length")
PARTS = {"beta": "β", "intrinsic_return": "bonus"}  # that a run may have, by their columns
WRITTEN: dict[str, Any] = {"sort_keys": False, "allow_unicode": True, "default_flow_style": None}


class Row(NamedTuple):
    """One episode."""

    ended: float  # when, s; NaN where the file does not say
    extrinsic_return: float
    length: int
    parts: dict[str, float]  # of `PARTS`, those that the file has


def read(path: Path, returns: str | None = None, lengths: str | None = None) -> list[Row]:
    """The episodes of a file, or of the Monitors' files in a folder; seconds are from its start.

    returns, lengths: the names of these columns; None: one of `RETURN`, of `LENGTH`. Where there is
    no length an episode counts as one step. `RecordError` names file and line, also of another run.
    """
    if not path.is_dir():
        return _read(path, returns, lengths)[1]
    found = [_read(file, returns, lengths) for file in sorted(path.glob(MONITORS))]
    if not found:
        raise RecordError(f"{path}: no file in it is called {MONITORS}")
    if any(math.isnan(row.ended) for _, part in found for row in part):
        raise RecordError(f"{path}: a file in it has no column t, the order of episodes")
    first = min(start for start, _ in found)
    rows = [row._replace(ended=start - first + row.ended) for start, part in found for row in part]
    return sorted(rows, key=lambda row: row.ended)


def _read(path: Path, returns: str | None, lengths: str | None) -> tuple[float, list[Row]]:
    """When its training began, s, or 0; its rows."""
    try:
        first, *rest = text = files.content(path).decode("utf-8-sig").splitlines()
        start = float(json.loads(first[1:])["t_start"]) if first.startswith("#") else 0.0
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError) as error:
        raise RecordError(f"{path}: line 1: no text, or no head of a Monitor: {error!r}") from None
    skipped = int(first.startswith("#"))
    lines = csv.DictReader(rest if skipped else text, strict=True)
    names = lines.fieldnames or []
    column = _column(path, names, "return", returns, RETURN)
    length = _column(path, names, "length", lengths, LENGTH) if lengths else None
    length = length or next((name for name in LENGTH if name in names), None)
    parts = [name for name in PARTS if name in names]
    rows: list[Row] = []
    exported = RUN if {*RUN} <= {*names} else ()  # by which runs are told apart there
    run: dict[str, str] = {}
    try:
        for line in lines:
            for name in exported:
                if run.setdefault(name, line[name]) != line[name]:
                    raise ValueError(f"{name} is {line[name]!r} after {run[name]!r}: another run")
            rows.append(
                Row(
                    ended=_number(line, "t") if "t" in names else math.nan,
                    extrinsic_return=_number(line, column),
                    length=_whole(line, length) if length else 1,
                    parts={name: _number(line, name) for name in parts},
                )
            )
    except (ValueError, csv.Error) as error:
        raise RecordError(f"{path}: line {lines.line_num + skipped}: {error}") from None
    if not rows:
        raise RecordError(f"{path}: it has no episode")
    return start, rows


def _column(
    path: Path, names: Sequence[str], what: str, wanted: str | None, known: Sequence[str]
) -> str:
    found = [name for name in ([wanted] if wanted else known) if name in names]
    if not found:
        of = f"{wanted!r}" if wanted else f"a {what}, as {', '.join(known)}: name it by --{what}"
        raise RecordError(f"{path}: its columns are {', '.join(names)}, and none is {of}")
    return found[0]


def _number(line: dict[str, Any], name: str) -> float:
    if line[name] is None:
        raise ValueError(f"it ends before its {name}")
    try:
        value = float(line[name])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} is {line[name]!r}, not a finite number")
    return value


def _whole(line: dict[str, Any], name: str) -> int:
    value = _number(line, name)
    if value < 1 or value % 1:
        raise ValueError(f"{name} is {line[name]!r}, not a whole number from 1 on")
    return int(value)


def write(runs: Mapping[Path, Sequence[Row]], environment: str, variant: str, out: Path) -> None:
    """Leave the runs of a variant in a study's folder of results, in place of imported ones.

    runs: episodes by the file or folder that they are from; the seeds are 0, 1, … `ConfigError`
    where there are runs that were trained.
    """
    place = out / "runs" / files.folder_of(environment) / variant
    for record in sorted(place.glob(f"*/{files.RECORD}")):
        if "imported" not in provenance.read_record(record):
            raise ConfigError(
                f"{record.parent} is a run that was trained here: name another --variant"
            )
        record.unlink()
    for seed, (origin, rows) in enumerate(runs.items()):
        steps = itertools.accumulate(row.length for row in rows)
        records = [
            EpisodeRecord(
                episode=number,
                env_steps=step,
                length=row.length,
                extrinsic_return=row.extrinsic_return,
                intrinsic_return=row.parts.get("intrinsic_return", 0.0),
                beta=row.parts.get("beta", 0.0),
                terminated=0,  # unknown, and asked by nothing
            )
            for number, (step, row) in enumerate(zip(steps, rows, strict=True), start=1)
        ]
        folder = place / f"seed{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        write_episodes(folder / files.EPISODES, as_columns(EpisodeRecord, records))
        sources = sorted(origin.glob(MONITORS)) if origin.is_dir() else [origin]
        run = {"environment": environment, "variant": variant, "seed": seed}
        content = {
            "config": run | {"episodes": len(records), "imported": True},
            "imported": {str(path): provenance.file_digest(path) for path in sources},
            "versions": {},  # nothing is known of these, ...
            "sources": "",  # ... of the code ...
            "machine": {},  # ... and of where it ran
            "seconds": 0.0 if math.isnan(rows[-1].ended) else rows[-1].ended,
            "start_seconds": 0.0,
            "outputs": {files.EPISODES: provenance.file_digest(folder / files.EPISODES)},
        }
        check(provenance.RunRecord, content, str(folder))
        write_atomically(folder / files.RECORD, json.dumps(content, indent=2) + "\n")


def write_study(
    results: Path, labels: dict[str, str], random_return: dict[str, float]
) -> list[str]:
    """Write or renew `STUDY`: the imported runs of `results` that each variant there has.

    labels: of variants; random_return: by environment. Both are added to what the file says.
    Returns the runs that it leaves out, since another variant has not their seed or environment.
    """
    path, runs = results / STUDY, set()
    for run in FinishedRun.below(results / "runs"):
        if "imported" in run.record:
            runs.add(tuple(run.record["config"][key] for key in IDENTITY))
    environments = sorted({environment for environment, _, _ in runs})
    pairs = {run[:2] for run in runs}
    variants = [
        name
        for name in sorted({name for _, name in pairs})
        if all((environment, name) in pairs for environment in environments)
    ]
    seeds = {
        environment: [
            seed
            for seed in sorted({seed for _, _, seed in runs})
            if all((environment, name, seed) in runs for name in variants)
        ]
        for environment in environments
    }
    if not variants or not all(seeds.values()):
        what = "variant" if not variants else "seed"
        raise ConfigError(f"{results}: no {what} is in each of {', '.join(environments)}")
    changes = {
        "results": str(results),
        "environments": environments,
        "variants": variants,
        "seeds": [*seeds[environments[0]]],
        "environment_seeds": seeds,
        "variant_settings": {
            name: {"imported": True} | ({"label": labels[name]} if name in labels else {})
            for name in variants
        },
        "metrics": {
            "comparisons": [list(pair) for pair in itertools.combinations(variants, 2)],
            "random_return": random_return,
        },
    }
    known = read_yaml(path) if path.exists() else {}
    text = yaml.safe_dump(merge(known, changes), None, **WRITTEN)
    write_atomically(path, f"# Runs of others: mace-import wrote this, and renews it.\n{text}")
    shown = {(env, name, seed) for env in environments for name in variants for seed in seeds[env]}
    return [" ".join(map(str, run)) for run in sorted(runs - shown)]


def main() -> None:
    """Entry point of `mace-import`; exits with 1 and one line for what cannot be."""
    example = "mace-import logs/ppo_* --env CartPole-v1 --variant sb3_ppo --out results/sb3"
    parser = argparse.ArgumentParser(
        prog="mace-import",
        description="make a study of runs that were trained elsewhere",
        epilog=f"example: {example}",
    )
    add = parser.add_argument
    which = "a CSV file with a row an episode, or a folder of Monitors' files: seeds 0, 1, ..."
    add("runs", nargs="+", type=Path, metavar="RUN", help=which)
    add("--env", required=True, help="what the environment is called")
    add("--variant", required=True, help="what the algorithm is called, a name for a folder")
    add("--label", help="what it is called in tables and figures")
    first = "(default: the first of {})".format
    add(
        "--return",
        dest="returns",
        metavar="COLUMN",
        help=f"of an episode {first(', '.join(RETURN))}",
    )
    add("--length", dest="lengths", metavar="COLUMN", help=f"its steps {first(', '.join(LENGTH))}")
    add("--random-return", type=float, help="of random actions, the mean, if config.yaml has none")
    add("--out", required=True, type=Path, help="the study's folder of results")
    given = parser.parse_args()
    try:
        check_name(given.env, "--env")
        check_name(given.variant, "--variant")
        runs = {path: read(path, given.returns, given.lengths) for path in given.runs}
        write(runs, given.env, given.variant, given.out)
        random = {} if given.random_return is None else {given.env: given.random_return}
        labels = {given.variant: given.label} if given.label else {}
        lacking = write_study(given.out, labels, random)
    except (Refusal, OSError) as error:
        sys.exit(f"mace-import: {' '.join(str(error).split())}")
    for seed, (path, rows) in enumerate(runs.items()):
        steps = f"{sum(row.length for row in rows)} steps"
        if all(row.length == 1 for row in rows):
            steps += ", one each"
        has = " and ".join(PARTS[name] for name in rows[0].parts) or "no β, no bonus"
        print(f"{path}: seed {seed}, {len(rows)} episodes, {steps}, {has}")
    if lacking:
        print("not in the study, since another variant lacks it:", ", ".join(lacking))
    print(f"next: snakemake -j2 all --configfile {given.out / STUDY}")


if __name__ == "__main__":
    main()
