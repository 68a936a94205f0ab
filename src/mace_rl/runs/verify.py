"""Do the runs that this project ships come out again? A sample is repeated and compared to the bit.

With the arithmetic and the versions that they were made with they have to, on whatever processor.
With others a last bit may differ, and training amplifies it; then the question is whether the
repeated runs can be shown to do as well.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mace_rl import files
from mace_rl.config.run import RunConfig
from mace_rl.config.section import check
from mace_rl.refusal import Refusal
from mace_rl.results.records import RecordError, read_episodes
from mace_rl.results.statistics import paired_comparison
from mace_rl.runs.checkpoint import difference
from mace_rl.runs.provenance import read_record

# Standard deviations of an episode's return: how far the mean return may have changed.
MARGIN = 0.5


class NotReproducedError(Refusal):
    """Repeated runs are neither equal to the bit nor shown to do as well."""


class Repetition(NamedTuple):
    """One run and its repetition."""

    name: str  # environment, variant and seed
    equal: bool  # records and agent, to the bit
    same: bool  # arithmetic and versions: then all of it has to be equal
    first: int | None  # the first episode whose record differs, from 1; None if none does
    returns: tuple[float, float]  # mean extrinsic return over all episodes, then and now
    spread: float  # standard deviation of the episodes' returns then
    origin: str  # what is different in the making of the two


def reference_runs(folder: Path) -> list[Path]:
    """The run folders below `folder`, sorted; `RecordError` if there are none."""
    runs = sorted(path.parent for path in folder.glob("runs/*/*/seed*/run.json"))
    if not runs:
        raise RecordError(f"{folder}: no runs/ENVIRONMENT/VARIANT/seedN/run.json in it")
    return runs


def repeat(run_folder: Path) -> Repetition:
    """Train as the `run.json` in `run_folder` says, and compare.

    Raises `RecordError` if the files there are not those that `run.json` describes.
    """
    from mace_rl.runs.run import run  # PyTorch takes seconds to import

    then = read_record(run_folder / files.RECORD)
    config = check(RunConfig, then["config"], str(run_folder / files.RECORD))
    records = run_folder / files.EPISODES
    before = read_episodes(records, config.episodes, then["outputs"][files.EPISODES])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run(config, folder)
        now = read_record(folder / files.RECORD)
        after = read_episodes(folder / files.EPISODES, config.episodes)
    different = (before != after).any(axis=1).to_numpy()
    old, new = (
        {key: record[key] for key in ("arithmetic", "versions", "sources")}
        | {"cpu": record["machine"]["cpu"]}
        for record in (then, now)
    )
    return Repetition(
        name=f"{config.environment} {config.variant} seed {config.seed}",
        equal=then["outputs"] == now["outputs"],
        same=_made_with(then) == _made_with(now),
        first=int(different.argmax()) + 1 if different.any() else None,
        returns=(before["extrinsic_return"].mean(), after["extrinsic_return"].mean()),
        spread=before["extrinsic_return"].std(),
        origin=difference(old, new),
    )


def _made_with(record: Mapping[str, Any]) -> tuple[Any, dict[str, str]]:
    """Arithmetic and versions; of Python, which no lock can choose, without the last number."""
    versions = record["versions"]
    return record["arithmetic"], versions | {"python": versions["python"].rpartition(".")[0]}


def describe(result: Repetition) -> str:
    """One line on one repetition."""
    if result.equal:
        return f"{result.name}: equal to the bit"
    then, now = result.returns
    where = f"from episode {result.first}" if result.first else "in the agent's weights only"
    return (
        f"{result.name}: different {where}; mean return {then:.2f} then, {now:.2f} now "
        f"({result.origin})"
    )


def verdict(results: Sequence[Repetition], confidence: float) -> tuple[bool, str]:
    """Whether the runs are reproduced, and a line that says how.

    Runs of other arithmetic or versions that differ are reproduced if the interval of the mean
    change of their returns, each in units of its run's spread over episodes, lies within `MARGIN`
    on both sides of 0. Few runs have a wide interval, which does not: agreement has to be shown.
    """
    different = [result for result in results if not result.equal]
    line = f"{len(results) - len(different)} of {len(results)} runs equal to the bit"
    if not different:
        return True, line
    if any(result.same for result in different):
        return False, f"{line}; with equal arithmetic and versions all of them should be"
    if len(different) == 1:
        return False, f"{line}; with one that differs, statistics cannot agree or disagree"
    then, now = np.array([result.returns for result in different]).T
    spread = np.array([result.spread for result in different])
    if not spread.all():
        return False, f"{line}; where a run's returns are all equal there is no unit of change"
    change = paired_comparison((now - then) / spread, confidence, 10_000, np.random.default_rng(0))
    agree = change.low > -MARGIN and change.high < MARGIN
    return bool(agree), (
        f"{line}; the others' mean return changed by {change.difference:+.3f} "
        f"[{change.low:.3f}, {change.high:.3f}] standard deviations of an episode: "
        f"{'less' if agree else 'not shown to be less'} than {MARGIN} either way"
    )


def verify(folder: Path, sample: int | None, seed: int, confidence: float) -> Iterator[str]:
    """Repeat `sample` runs of `folder` (None: all), chosen with `seed`; yields lines to show.

    The last line is the verdict. Raises `RecordError` for damaged files and `NotReproducedError` if
    the runs are not reproduced.
    """
    runs = reference_runs(folder)
    if sample is not None and sample < len(runs):
        chosen = np.random.default_rng(seed).choice(len(runs), sample, replace=False)
        runs = [runs[i] for i in sorted(chosen)]
    results = []
    for run_folder in runs:
        results.append(repeat(run_folder))
        yield describe(results[-1])
    reproduced, line = verdict(results, confidence)
    if not reproduced:
        raise NotReproducedError(f"not reproduced: {line}")
    yield line
