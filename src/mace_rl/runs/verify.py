"""Training kept runs again and comparing to the bit.

With the same versions they are equal on every processor; with others a last bit may differ.
"""

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.config.run import RunConfig
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.provenance import difference

if TYPE_CHECKING:
    import pandas as pd


class NotReproducedError(Refusal):
    """A repeated run is not equal to the bit."""


def repeat(then: FinishedRun) -> tuple[bool, str]:
    """Train as `then` was: whether records and agent are equal, and a line about it."""
    for name in files.RESULTS:
        if (then.folder / name).exists():  # a kept run may have its episodes only
            then.content(name)
    return repeated(then.config, then.record, then.episodes)


def repeated(
    config: RunConfig, record: Mapping[str, Any], before: "pd.DataFrame"
) -> tuple[bool, str]:
    """The same of a run with this `run.json` and these columns of `episodes.csv`."""
    from mace_rl.runs.run import run  # numba takes a second to import

    with tempfile.TemporaryDirectory() as temporary:
        run(config, Path(temporary))
        now = FinishedRun(temporary, trust=True)
        after = now.episodes[before.columns]
    name = f"{config.environment} {config.variant} seed {config.seed}"
    records = record, now.record
    outputs = [one["outputs"] for one in records]
    different = (before != after).any(axis=1).to_numpy()
    if outputs[0] == outputs[1] and not different.any():
        return True, f"{name}: equal to the bit"
    old, new = (
        {key: one[key] for key in ("versions", "sources")} | {"cpu": one["machine"].get("cpu")}
        for one in records
    )
    first = f"from episode {different.argmax() + 1}"
    others = [name for name in files.RESULTS if outputs[0].get(name) != outputs[1].get(name)]
    where = first if different.any() else f"in {' and '.join(others)} only"
    means = [frame["extrinsic_return"].mean() for frame in (before, after)]
    return False, (
        f"{name}: different {where}; "
        f"mean return {means[0]:.2f} then, {means[1]:.2f} now ({difference(old, new)})"
    )


def verify(folder: Path, sample: int | None, trust: bool = False) -> Iterator[str]:
    """Repeat `sample` runs of `folder` (None: all), always the same ones; yields lines.

    Raises `NotReproducedError` at the end, and what the parts of a `FinishedRun` raise.
    """
    runs = FinishedRun.below(folder.absolute(), trust)  # environments may change the folder
    if sample is not None and sample < len(runs):
        chosen = np.random.default_rng(0).choice(len(runs), sample, replace=False)
        runs = [runs[i] for i in sorted(chosen)]
    reproduced = 0
    for run in runs:
        equal, line = repeat(run)
        reproduced += equal
        yield line
    line = f"{reproduced} of {len(runs)} runs equal to the bit"
    if reproduced < len(runs):
        raise NotReproducedError(f"not reproduced: {line}")
    yield line
