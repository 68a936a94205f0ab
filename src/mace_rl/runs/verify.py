"""Do the runs that this project ships come out again? A sample is repeated and compared to the bit.

With the versions that they were made with they have to, on whatever processor.
With others a last bit may differ, and training amplifies it: a run that differs says in what.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mace_rl import files
from mace_rl.config.plugins import config_of_run
from mace_rl.refusal import Refusal
from mace_rl.runs.checkpoint import difference
from mace_rl.runs.provenance import read_record
from mace_rl.runs.records import RecordError, read_episodes


class NotReproducedError(Refusal):
    """Repeated runs are not equal to the bit."""


def reference_runs(folder: Path) -> list[Path]:
    """The run folders in and below `folder`, sorted; `RecordError` if there are none."""
    runs = files.runs_below(folder, [files.RECORD])
    if not runs:
        raise RecordError(f"{folder}: no finished run in it")
    return runs


def repeat(run_folder: Path, trust: bool = False) -> tuple[bool, str]:
    """Train as the `run.json` in `run_folder` says; whether records and agent are equal, in words.

    Raises `RecordError` if the files there are not those that `run.json` describes.
    """
    from mace_rl.runs.run import run  # PyTorch takes seconds to import

    then = read_record(run_folder / files.RECORD)
    config = config_of_run(then["config"], str(run_folder / files.RECORD), trust)
    records = run_folder / files.EPISODES
    before = read_episodes(records, config.episodes, then["outputs"][files.EPISODES])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        run(config, folder)
        now = read_record(folder / files.RECORD)
        after = read_episodes(folder / files.EPISODES, config.episodes)
    name = f"{config.environment} {config.variant} seed {config.seed}"
    if then["outputs"] == now["outputs"]:
        return True, f"{name}: equal to the bit"
    old, new = (
        {key: record[key] for key in ("versions", "sources")} | {"cpu": record["machine"]["cpu"]}
        for record in (then, now)
    )
    different = (before != after).any(axis=1).to_numpy()
    first = f"from episode {different.argmax() + 1}"
    where = first if different.any() else "in the agent's weights only"
    means = [frame["extrinsic_return"].mean() for frame in (before, after)]
    return False, (
        f"{name}: different {where}; "
        f"mean return {means[0]:.2f} then, {means[1]:.2f} now ({difference(old, new)})"
    )


def verify(folder: Path, sample: int | None, trust: bool = False) -> Iterator[str]:
    """Repeat `sample` runs of `folder` (None: all), at random but always the same; yields lines.

    Raises `RecordError` for damaged files and `NotReproducedError` if a run is not reproduced.
    """
    runs = reference_runs(folder)
    if sample is not None and sample < len(runs):
        chosen = np.random.default_rng(0).choice(len(runs), sample, replace=False)
        runs = [runs[i] for i in sorted(chosen)]
    reproduced = 0
    for run_folder in runs:
        equal, line = repeat(run_folder, trust)
        reproduced += equal
        yield line
    line = f"{reproduced} of {len(runs)} runs equal to the bit"
    if reproduced < len(runs):
        raise NotReproducedError(f"not reproduced: {line}")
    yield line
