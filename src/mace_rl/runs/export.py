"""Finished runs as one tidy table, a row per episode, for other tools."""

import re
from pathlib import Path
from typing import Any

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.config.run import IDENTITY
from mace_rl.runs.finished import FinishedRun

RUN = ("task", "algorithm", "seed", "folder")  # environment, variant, seed, where the run is
EPISODE = {"step": "env_steps", "return": "extrinsic_return"}  # our names of the other columns
EPISODE |= {name: name for name in ("episode", "length", "beta")}


def columns(folder: Path) -> dict[str, list[Any]]:
    """The table of every finished run in and below `folder`.

    Raises `RecordError` if there are none, or records are damaged.
    """
    table: dict[str, list[Any]] = {name: [] for name in (*RUN, *EPISODE)}
    for run in FinishedRun.below(folder):
        key = [run.record["config"][name] for name in IDENTITY]
        for name, value in zip(RUN, [*key, in_a_cell(run.folder.relative_to(folder))], strict=True):
            table[name] += [value] * len(run.rows)
        for name, ours in EPISODE.items():
            table[name] += [getattr(row, ours) for row in run.rows]
    return table


def in_a_cell(folder: Path) -> str:
    """Its path, with '/' between names; what would end a cell of a CSV file stands as '?'."""
    return re.sub(r'[,"\n\r]', "?", folder.as_posix())


def write(table: dict[str, list[Any]], out: Path) -> None:
    """Write the table to a .csv or .parquet file; `Refusal` without pyarrow for the latter."""
    header = ",".join(table)
    files.require_ours(out, header.encode() if out.suffix == ".csv" else b"PAR1")
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".csv":
        lines = (",".join(map(str, row)) for row in zip(*table.values(), strict=True))
        write_atomically(out, "\n".join([header, *lines, ""]))
        return
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise Refusal(f"--out is '{out}', but .parquet needs: pip install pyarrow") from None
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.table(table), sink)
    write_atomically(out, sink.getvalue().to_pybytes())
