"""The records of runs as event files for TensorBoard."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.base.tables import RecordError
from mace_rl.runs import checkpoint
from mace_rl.runs.finished import NEVER_WRITTEN, FinishedRun


def write_all(folder: Path, out: Path) -> int:
    """Write the events of every run in and below `folder` to the same places below `out`.

    Returns their number. `RecordError` for none or damaged ones, `Refusal` without tensorboardX.
    """
    runs = files.runs_below(folder, [files.RECORD, files.CHECKPOINT])
    if not runs:
        raise RecordError(f"{folder}: no run in it, finished or with a checkpoint")
    for run in runs:
        write(run, out / run.relative_to(folder))
    return len(runs)


def write(run: Path, out: Path) -> None:
    """Write the events of one run to `out`, over earlier ones; equal records, equal bytes."""
    try:
        from tensorboardX import RecordWriter
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary
    except ImportError:
        raise Refusal(
            "events are written by the package tensorboardX: pip install tensorboardX"
        ) from None
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch, files.EVENTS)
        writer = RecordWriter(str(path))
        writer.write(Event(file_version="brain.Event:2").SerializeToString())
        for episode, values in rows(read(run)):
            scalars = [Summary.Value(tag=tag, simple_value=x) for tag, x in values.items()]
            event = Event(step=episode, summary=Summary(value=scalars))
            writer.write(event.SerializeToString())
        writer.close()
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(out / files.EVENTS, files.content(path))


def read(run: Path) -> dict[str, pd.DataFrame]:
    """The tables of a run by the prefix of their tags, with the episode as their index.

    From its files, or its checkpoint if it is not finished or goes on; raises what their reading
    raises.
    """
    if not (run / files.RECORD).exists():
        return of_checkpoint(run)
    finished = FinishedRun(run)
    if files.newer(run / files.CHECKPOINT, run / files.RECORD):  # or was only copied later
        later = of_checkpoint(run)
        if len(later["episodes"]) > finished.record["config"]["episodes"]:
            return later
    both = {"episodes": finished.episodes, "updates": finished.diagnostics}
    there = {prefix: table for prefix, table in both.items() if table is not None}
    return {prefix: table.set_index("episode") for prefix, table in there.items()}


def of_checkpoint(run: Path) -> dict[str, pd.DataFrame]:
    """The same from its checkpoint."""
    found = checkpoint.read(run / files.CHECKPOINT)
    try:
        state = found["state"]["trainer"]
        tables = {
            prefix: pd.DataFrame({name: column.numpy() for name, column in state[key].items()})
            for prefix, key in (("episodes", "records"), ("updates", "diagnostics"))
        }
        for table in tables.values():
            kinds = {*table.dtypes.map(str)}
            if not kinds <= {"int64", "float64"} or table["episode"].dtype != "int64":
                raise ValueError("no training writes such columns")
        return {prefix: table.set_index("episode") for prefix, table in tables.items()}
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError):
        path = run / files.CHECKPOINT
        raise checkpoint.CheckpointError(f"{path}: {NEVER_WRITTEN}") from None


def rows(tables: Mapping[str, pd.DataFrame]) -> list[tuple[int, dict[str, float]]]:
    """Each row's episode and its values by tag, without NaN, in the order of episodes."""
    found: list[Any] = []
    for prefix, table in tables.items():
        values = table.drop(columns="update", errors="ignore")
        tagged = values.add_prefix(f"{prefix}/").iterrows()
        found += [(episode, row.dropna().to_dict()) for episode, row in tagged]
    return sorted(found, key=lambda row: row[0])  # stable: episodes before their update
