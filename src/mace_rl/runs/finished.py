"""Finished runs, as the results are computed from them."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from mace_rl import files
from mace_rl.results.records import RunKey, read_episodes
from mace_rl.runs.provenance import read_record

if TYPE_CHECKING:
    import pandas as pd


def read_runs(
    records: Iterable[str], runs: Iterable[tuple[str, str, int, int]]
) -> dict[RunKey, "pd.DataFrame"]:
    """The episodes of each run (`read_episodes`).

    records: their `run.json`s, each beside its `episodes.csv`; runs: for each its environment,
    variant, seed and number of episodes. Raises `RecordError` and `ProvenanceError` for what is
    not what training wrote.
    """
    frames = {}
    for record, (environment, variant, seed, episodes) in zip(records, runs, strict=True):
        digest = read_record(Path(record))["outputs"][files.EPISODES]
        path = Path(record).with_name(files.EPISODES)
        frames[environment, variant, seed] = read_episodes(path, episodes, digest)
    return frames
