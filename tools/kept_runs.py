"""Keep finished runs as tables, or train some of them again.

    .venv/bin/python -m tools.kept_runs pack RESULTS FOLDER
    .venv/bin/python -m tools.kept_runs verify FOLDER --sample 3        (make verify)

FOLDER/ENVIRONMENT.parquet has a row for each run, a group of rows for each variant. Of a run are
kept its `run.json` and the columns of `episodes.csv` that tables read (`COLUMNS`), each as a list.
Where a return follows from how an episode ended and when, as Acrobot's does, the file's metadata
have these returns instead. Packing again adds runs to those that are there; equal runs give equal
files.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import parquet

from mace_rl.base import files
from mace_rl.base.errors import Refusal
from mace_rl.base.files import write_atomically
from mace_rl.config.run import RunConfig
from mace_rl.runs import verify
from mace_rl.runs.finished import FinishedRun

LONGEST = 60  # seconds of a run that is trained again
COLUMNS = {
    "length": np.int64,
    "extrinsic_return": np.float64,
    "beta": np.float64,
    "terminated": np.int64,
}
SMALLER = {"length": pa.int32(), "terminated": pa.bool_()}  # in the file
END, RETURN = ["length", "terminated"], "extrinsic_return"
FOLLOWS = b"extrinsic_return by length and terminated"  # key of the metadata
REPEATED = 0.5  # of a column's numbers are different ones: with fewer a dictionary is smaller


class Kept(NamedTuple):
    """A kept run."""

    record: str  # its run.json
    episodes: pd.DataFrame  # of episodes.csv `episode`, `env_steps` and `COLUMNS`


Runs = dict[tuple[str, int], Kept]  # by variant and seed


def read(path: Path, variants: Collection[str] | None = None) -> Runs:
    """The runs in a file, of some variants or all; `ValueError` with its path for a damaged one."""
    chosen = None if variants is None else [("variant", "in", sorted(variants))]
    try:
        table = parquet.read_table(path, filters=chosen, page_checksum_verification=True)
        columns = {
            name: _lists(table.column(name), kind)
            for name, kind in COLUMNS.items()
            if name in table.column_names
        }
        if follows := (table.schema.metadata or {}).get(FOLLOWS):
            columns[RETURN] = _returns(json.loads(follows), *(columns[name] for name in END))
        rows = zip(
            *(table.column(name).to_pylist() for name in ("variant", "seed", "record", "digest")),
            *(columns[name] for name in COLUMNS),
            strict=True,
        )
        found: Runs = {}
        for variant, seed, record, digest, *lists in rows:
            if _digest(lists) != digest:
                raise ValueError(f"{variant} seed {seed} has other episodes (SHA-256 differs)")
            found[variant, seed] = Kept(record, _frame(dict(zip(COLUMNS, lists, strict=True))))
        return found
    except (ValueError, LookupError, OSError) as error:  # pyarrow's own are among these
        raise ValueError(f"{path} is not as a packed one is: {error}") from None


def _lists(column: pa.ChunkedArray, kind: type) -> list[np.ndarray]:
    """The list of each run, as `kind`."""
    lists = column.combine_chunks()
    values = lists.flatten()
    single = pa.types.is_float32(values.type)
    numbers = _doubles(values) if single else values.to_numpy(zero_copy_only=False).astype(kind)
    ends = np.cumsum(pc.list_value_length(lists).to_numpy())
    return np.split(numbers, ends)[:-1]


def _returns(
    follows: list[list[float]], lengths: list[np.ndarray], terminated: list[np.ndarray]
) -> list[np.ndarray]:
    """The return of each episode; follows: length, whether it terminated, and its return."""
    known = np.zeros((1 + max(int(length) for length, *_ in follows), 2))
    for length, end, value in follows:
        known[int(length), int(end)] = value
    return [known[length, end] for length, end in zip(lengths, terminated, strict=True)]


def _doubles(single: pa.Array) -> np.ndarray:
    """The doubles of at most six significant digits that were made single-precision numbers.

    The shortest decimal of such a number is the one that it was made of.
    """
    coded = single.dictionary_encode()  # most numbers stand there many times
    return pc.cast(pc.cast(coded.dictionary, pa.string()), pa.float64()).to_numpy()[coded.indices]


def _digest(columns: list[np.ndarray]) -> str:
    """SHA-256 of the bytes of `COLUMNS` of one run."""
    return hashlib.sha256(b"".join(column.tobytes() for column in columns)).hexdigest()


def _frame(columns: dict[str, np.ndarray]) -> pd.DataFrame:
    counted = {"episode": np.arange(1, len(columns["length"]) + 1)}
    return pd.DataFrame(counted | {"env_steps": columns["length"].cumsum()} | columns)


def write(path: Path, runs: Runs) -> None:
    """Write a file of runs, sorted; equal runs give an equal file."""
    runs = dict(sorted(runs.items()))
    columns = {name: [run.episodes[name].to_numpy() for run in runs.values()] for name in COLUMNS}
    digests = [_digest(list(lists)) for lists in zip(*columns.values(), strict=True)]
    keys: dict[str, list[str] | list[int]] = {
        "variant": [variant for variant, _ in runs],
        "seed": [seed for _, seed in runs],
        "record": [run.record for run in runs.values()],
        "digest": digests,
    }
    together = pd.DataFrame({name: np.concatenate(columns[name]) for name in [*END, RETURN]})
    together["bits"] = together[RETURN].to_numpy().view(np.int64)  # 0.0 and -0.0 are two
    pairs = together.drop_duplicates([*END, "bits"])
    follows = not pairs.duplicated(END).any()
    kept = [name for name in columns if name != RETURN or not follows]
    table = pa.table(keys | {name: _packed(name, columns[name]) for name in kept})
    if follows:
        rows = pairs[[*END, RETURN]].to_numpy().tolist()
        table = table.replace_schema_metadata({FOLLOWS: json.dumps(rows)})
    coded = together["bits"].nunique() < REPEATED * len(together)
    split = [name for name in kept if name != "terminated" and not (name == RETURN and coded)]
    sink = pa.BufferOutputStream()
    with parquet.ParquetWriter(
        sink,
        table.schema,
        compression="brotli",
        compression_level=11,
        use_dictionary=["variant", *([f"{RETURN}.list.element"] if coded and not follows else [])],
        column_encoding={f"{name}.list.element": "BYTE_STREAM_SPLIT" for name in split},
        write_statistics=["variant"],  # by which variants are found
        write_page_checksum=True,
    ) as file:
        for variant in dict.fromkeys(keys["variant"]):
            file.write_table(table.filter(pc.equal(table["variant"], variant)))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, sink.getvalue().to_pybytes())


def _packed(name: str, lists: list[np.ndarray]) -> pa.Array:
    """A column's lists, in the smallest type that gives its numbers back."""
    values = pa.array(np.concatenate(lists))
    kind = SMALLER.get(name) or pa.float32()
    packed = values.cast(kind, safe=False)
    back = _doubles(packed) if pa.types.is_float32(kind) else packed.cast(values.type).to_numpy()
    ends = np.cumsum([0, *map(len, lists)])
    exact = back.tobytes() == values.to_numpy().tobytes()
    return pa.ListArray.from_arrays(pa.array(ends, pa.int32()), packed if exact else values)


def pack(results: Path, folder: Path) -> int:
    """Add the finished runs of `results` to `folder`; returns how many there are now.

    Raises `ValueError` if there are none in `results`, if a run's records are not those that its
    `run.json` describes, or if another run of the same seed is kept.
    """
    if not any(results.glob(f"runs/*/*/seed*/{files.RECORD}")):
        raise ValueError(f"{results}: no runs/ENV/VARIANT/seedN/{files.RECORD} in it")
    count = 0
    for environment in sorted(results.glob("runs/*")):
        path = folder / f"{environment.name}.parquet"
        before = read(path) if path.exists() else {}
        runs = dict(before)
        for record in environment.glob(f"*/seed*/{files.RECORD}"):
            run = FinishedRun(record.parent, trust=True)  # nothing of it is run
            key = record.parents[1].name, int(record.parent.name.removeprefix("seed"))
            if key not in before:
                runs[key] = Kept(record.read_text(encoding="utf-8"), run.episodes)
            elif json.loads(before[key].record)["outputs"] != run.record["outputs"]:
                raise ValueError(f"{run.folder}: {path} has another run of this seed")
        if len(runs) > len(before):  # compressing takes seconds
            write(path, runs)
        count += len(runs)
    return count


def sample(folder: Path, count: int) -> Iterator[Kept]:
    """Short runs of `count` variants, at random but always the same; `ValueError` if too few."""
    draws, left = np.random.default_rng(0), count
    variants = [
        (path, variant)
        for path in sorted(folder.glob("*.parquet"))
        for variant in sorted(
            {*parquet.read_table(path, columns=["variant"])["variant"].to_pylist()}
        )
    ]
    for place in draws.permutation(len(variants)):
        if not left:
            return
        path, variant = variants[place]
        runs = [*read(path, [variant]).values()]
        run = runs[draws.choice(len(runs))]
        if json.loads(run.record)["seconds"] < LONGEST:
            left -= 1
            yield run
    if left:
        raise ValueError(f"{folder}: {count - left} runs in it that take less than {LONGEST} s")


def main() -> None:
    """Entry point; exits with 1 if a run is not what is kept of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    packing = commands.add_parser("pack", help="add finished runs to those that are kept")
    packing.add_argument("results", type=Path, help="has runs/ENV/VARIANT/seedN")
    packing.add_argument("folder", type=Path, help="such as reference/worlds/tuned")
    verifying = commands.add_parser("verify", help="train kept runs again, and compare to the bit")
    verifying.add_argument("folder", type=Path)
    verifying.add_argument(
        "--sample", type=int, default=3, metavar="N", help="how many, default: 3"
    )
    arguments = parser.parse_args()
    try:
        if arguments.command == "pack":
            count = pack(arguments.results, arguments.folder)
            print(f"{count} runs in {arguments.folder}")
            return
        if arguments.sample < 1:
            raise ValueError("--sample is a number of runs, at least 1")
        equal = []
        for run in sample(arguments.folder, arguments.sample):
            record = json.loads(run.record)
            config = RunConfig.model_validate(record["config"])
            same, line = verify.repeated(config, record, run.episodes)
            equal.append(same)
            print(line, flush=True)
        print(f"{sum(equal)} of {len(equal)} runs equal to the bit")
        if not all(equal):
            sys.exit(1)
    except (Refusal, ValueError, OSError) as error:
        sys.exit(f"kept_runs: {error}")


if __name__ == "__main__":
    main()
