"""Keep finished runs small, or put kept ones back: exact, one file per environment and variant.

    .venv/bin/python -m tools.kept_runs pack RESULTS ARCHIVE
    .venv/bin/python -m tools.kept_runs unpack ARCHIVE RESULTS
    .venv/bin/python -m tools.kept_runs unpack ARCHIVE RESULTS --sample 3       (make verify)

Of RESULTS/runs/ENV/VARIANT/seedN are kept `episodes.csv` and `run.json`, which has the digests of
what is not kept.
ARCHIVE/ENV/VARIANT.tar.xz has them as seedN/FILE, but the episodes of all seeds column by column,
without those that the others tell, and each in the form that takes least room: as text, as doubles,
or as six digits with an exponent. Packing again adds seeds to those that are there; equal runs give
equal files. `make tables` reads what is there, without unpacking it.
"""

import argparse
import hashlib
import io
import itertools
import json
import lzma
import os
import re
import sys
import tarfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import numpy as np
import pandas as pd

from mace_rl.base import files
from mace_rl.base.files import write_atomically
from mace_rl.runs.finished import FinishedRun
from mace_rl.training.records import EpisodeRecord

LONGEST = 60  # seconds of a run in a sample
# What an archive expands to at most, and the memory that this may take, bytes. Ours have 8 MB.
EXPANDED, MEMORY = 1 << 26, 1 << 27
COLUMNS = [name for name in get_type_hints(EpisodeRecord) if name not in ("episode", "env_steps")]
MEMBERS = re.compile(
    rf"({'|'.join(COLUMNS)})(\.doubles|\.digits)?"
    rf"|seed[0-9]{{1,10}}/{files.RECORD}"
)
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]*\.tar\.xz"
DAMAGE = (tarfile.TarError, lzma.LZMAError, OSError, EOFError)


class Kept(NamedTuple):
    """A kept run."""

    record: bytes  # its run.json
    columns: dict[str, list[str]]  # cells of episodes.csv, by `COLUMNS`
    episodes: bytes  # episodes.csv


def read(archive: Path) -> dict[str, bytes]:
    """What is in an archive, by name; `ValueError` with its path for what `write` never wrote."""
    found = {}
    for seed, run in runs_of(archive).items():
        found[f"seed{seed}/{files.RECORD}"] = run.record
        found[f"seed{seed}/{files.EPISODES}"] = run.episodes
    return found


def frame(run: Kept) -> pd.DataFrame:
    """The records of a kept run, as `read_episodes` gives them."""
    told = {name: np.array([*map(float, cells)]) for name, cells in run.columns.items()}
    told |= {"episode": np.arange(1, len(told["length"]) + 1), "env_steps": told["length"].cumsum()}
    types = get_type_hints(EpisodeRecord)
    return pd.DataFrame({name: told[name].astype(kind) for name, kind in types.items()})


def runs_of(archive: Path) -> dict[int, Kept]:
    """The runs in an archive, by seed; `ValueError` as `read`."""
    try:
        if not re.fullmatch(NAME, archive.name):
            raise ValueError("its name is not VARIANT.tar.xz")
        return _read(archive.read_bytes())
    except (*DAMAGE, ValueError, LookupError, TypeError, RecursionError) as error:
        raise ValueError(f"{archive} is not as a packed one is: {error}") from None


def _read(compressed: bytes) -> dict[int, Kept]:
    # Decompressed at once: tarfile's own way takes twice as long.
    decompressor = lzma.LZMADecompressor(lzma.FORMAT_XZ, MEMORY)
    content = decompressor.decompress(compressed, EXPANDED)
    if not decompressor.eof:
        raise ValueError(f"cut off, or larger than {EXPANDED} bytes when expanded")
    found: dict[str, bytes] = {}
    with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as tar:
        for member in tar:
            plain = member.type == tarfile.REGTYPE and not member.issparse()
            file = tar.extractfile(member) if plain else None
            if not file or member.name in found or not MEMBERS.fullmatch(member.name):
                raise ValueError(f"it should not have {member.name[:60]!r}, or not as it does")
            found[member.name] = file.read()
    columns = {name: _cells(found, name) for name in COLUMNS}
    if twice := [name for name in found if "/" not in name]:
        raise ValueError(f"it should not have {twice[0]!r} beside another form of it")
    start, runs = 0, {}
    for name in [name for name in found if name.endswith(files.RECORD)]:
        record, left = json.loads(found[name]), len(columns["length"]) - start
        episodes, seconds = record["config"]["episodes"], record["seconds"]
        if type(episodes) is not int or not 0 < episodes <= left:
            raise ValueError(f"{name} has {episodes!r} episodes, of which there are {left}")
        if not isinstance(seconds, int | float):
            raise ValueError(f"{name} has {seconds!r} seconds")
        own = {column: values[start : start + episodes] for column, values in columns.items()}
        together = _together(own)
        if hashlib.sha256(together).hexdigest() != record["outputs"][files.EPISODES]:
            raise ValueError(f"{name} has other episodes (SHA-256 differs)")
        runs[int(name.partition("/")[0].removeprefix("seed"))] = Kept(found[name], own, together)
        start += episodes
    if not start or any(len(values) != start for values in columns.values()):
        raise ValueError(f"its runs have {start} episodes together, but its columns others")
    return runs


def write(archive: Path, content: dict[str, bytes]) -> None:
    """Write an archive without times and owners: equal content gives an equal file.

    `ValueError` where the episodes could not be put together again.
    """
    names = sorted(content, key=lambda name: (int(name[4 : name.index("/")]), name))
    columns: dict[str, list[str]] = {name: [] for name in COLUMNS}
    members = {name: content[name] for name in names if not name.endswith(files.EPISODES)}
    for name in (name for name in names if name.endswith(files.EPISODES)):
        header, *rows = (line.split(",") for line in content[name].decode().splitlines())
        own = {column: [row[header.index(column)] for row in rows] for column in COLUMNS}
        if _together(own) != content[name]:
            raise ValueError(f"{archive}: {name} is not as a training writes it")
        for column, values in own.items():
            columns[column] += values
    members |= dict(_smallest(name, values) for name, values in columns.items())
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    if buffer.tell() > EXPANDED:
        raise ValueError(f"{archive}: more than {EXPANDED} bytes, which would not be unpacked")
    archive.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(archive, lzma.compress(buffer.getvalue(), preset=9 | lzma.PRESET_EXTREME))


def _smallest(column: str, cells: list[str]) -> tuple[str, bytes]:
    """The name and the content of the form that is smallest compressed and gives `cells` back."""
    forms = [("", "\n".join(cells).encode())]
    numbers = [float(cell) for cell in cells]
    forms.append((".doubles", _planes(np.array(numbers))))
    parts = [f"{number:+.5e}".split("e") for number in numbers]  # such as +1.30000, +01
    digits = np.array([int(mantissa.replace(".", "")) for mantissa, _ in parts], np.int32)
    exponents = np.array([int(exponent) for _, exponent in parts], np.int16)
    forms.append((".digits", _planes(digits) + _planes(exponents)))
    fitting = [form for form in forms if _cells({column + form[0]: form[1]}, column) == cells]
    form, data = min(fitting, key=lambda form: len(lzma.compress(form[1])))
    return column + form, data


def _cells(members: dict[str, bytes], column: str) -> list[str]:
    """Take a column out of `members`, in whichever form it is there."""
    if column in members:
        return members.pop(column).decode().splitlines()
    if f"{column}.doubles" in members:
        return [repr(number) for number in _of_planes(members.pop(f"{column}.doubles"), "<f8")]
    data = members.pop(f"{column}.digits")
    digits = _of_planes(data[: len(data) // 6 * 4], "<i4")
    exponents = _of_planes(data[len(digits) * 4 :], "<i2")
    scaled = zip(digits, exponents, strict=True)
    return [repr(float(f"{digit}e{exponent - 5}")) for digit, exponent in scaled]


def _planes(values: np.ndarray) -> bytes:
    """The first byte of every value, then the second …: alike bytes compress better together."""
    ordered = values.astype(values.dtype.newbyteorder("<"))
    return ordered[:, None].view(np.uint8).T.tobytes()


def _of_planes(data: bytes, dtype: str) -> list[Any]:
    width = np.dtype(dtype).itemsize
    return np.frombuffer(data, np.uint8).reshape(width, -1).T.copy().view(dtype).ravel().tolist()


def _together(columns: dict[str, list[str]]) -> bytes:
    """episodes.csv of one run, from its `COLUMNS`."""
    steps = itertools.accumulate(map(int, columns["length"]))
    told = {"episode": map(str, itertools.count(1)), "env_steps": map(str, steps)}
    cells = [told.get(name) or columns[name] for name in get_type_hints(EpisodeRecord)]
    lines = map(",".join, zip(*cells, strict=False))  # `episode` has no end
    return "\n".join([",".join(get_type_hints(EpisodeRecord)), *lines, ""]).encode()


def pack(results: Path, archives: Path) -> int:
    """Add the finished runs of `results` to `archives`; returns how many there are now.

    Raises `ValueError` if there are none in `results`, if a run's records are not those that its
    `run.json` describes, or if another run of the same seed is kept.
    """
    if not any(results.glob(f"runs/*/*/seed*/{files.RECORD}")):
        raise ValueError(f"{results}: no runs/ENV/VARIANT/seedN/{files.RECORD} in it")
    count = 0
    for variant in sorted(results.glob("runs/*/*")):
        archive = archives / variant.parent.name / f"{variant.name}.tar.xz"
        packed = read(archive) if archive.exists() else {}
        content = dict(packed)
        for run in variant.glob("seed*"):
            if not (run / files.RECORD).exists():
                continue  # not finished
            whole = FinishedRun(run)
            before = packed.get(f"{run.name}/{files.RECORD}")
            if before and json.loads(before)["outputs"] != whole.record["outputs"]:
                raise ValueError(f"{run}: {archive} has another run of this seed")
            content[f"{run.name}/{files.EPISODES}"] = whole.content(files.EPISODES)
            content[f"{run.name}/{files.RECORD}"] = (run / files.RECORD).read_bytes()
        if content != packed:  # compressing takes seconds
            write(archive, content)
        count += sum(name.endswith(files.RECORD) for name in content)
    return count


def _put(folder: Path, content: dict[str, bytes]) -> None:
    """Write files below `folder`; `ValueError` if another one is there."""
    for name, data in content.items():
        if (folder / name).exists() and (folder / name).read_bytes() != data:
            raise ValueError(f"{folder / name}: there already, and not the kept one")
    for name, data in content.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)  # half of it would not be what run.json describes


def unpack(archives: Path, results: Path, cores: int | None = None) -> int:
    """Put the runs in `archives` where they were below `results`; returns how many.

    Raises `ValueError` if there are none.
    """
    packed = sorted(archives.glob("*/*.tar.xz"))
    if not packed:
        raise ValueError(f"{archives}: no ENV/VARIANT.tar.xz in it")
    with ProcessPoolExecutor(cores or len(os.sched_getaffinity(0))) as pool:
        return sum(pool.map(_put_back, packed, itertools.repeat(results)))


def _put_back(archive: Path, results: Path) -> int:
    content = read(archive)
    _put(_folder(archive, results), content)
    return sum(name.endswith(files.RECORD) for name in content)


def _folder(archive: Path, results: Path) -> Path:
    return results / "runs" / archive.parent.name / archive.name.removesuffix(".tar.xz")


def unpack_sample(archives: Path, results: Path, count: int) -> int:
    """The same for one run each of `count` archives, at random but always the same.

    Runs that took longer than `LONGEST` are left out: they are to be repeated.
    """
    draws, left = np.random.default_rng(0), count
    packed = sorted(archives.glob("*/*.tar.xz"))
    for place in draws.permutation(len(packed)):
        if not left:
            break
        archive, content = packed[place], read(packed[place])
        run = draws.choice([name for name in content if name.endswith(files.RECORD)])
        if json.loads(content[run])["seconds"] < LONGEST:
            names = (run, run.replace(files.RECORD, files.EPISODES))
            _put(_folder(archive, results), {name: content[name] for name in names})
            left -= 1
    if left:
        raise ValueError(f"{archives}: {count - left} runs in it that take less than {LONGEST} s")
    return count


def main() -> None:
    """Entry point."""
    commands: dict[str, Callable[[Path, Path], int]] = {"pack": pack, "unpack": unpack}
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.kept_runs pack results reference/worlds/tuned",
    )
    parser.add_argument("command", choices=commands)
    parser.add_argument("origin", type=Path, help="RESULTS to pack, or the ARCHIVE to unpack")
    parser.add_argument("goal", type=Path, help="the ARCHIVE, or RESULTS")
    parser.add_argument("--sample", type=int, metavar="N", help="unpack only N short runs")
    arguments = parser.parse_args()
    try:
        if arguments.sample is None:
            count = commands[arguments.command](arguments.origin, arguments.goal)
        elif arguments.command == "pack" or arguments.sample < 1:
            raise ValueError("--sample is a number of runs to unpack, at least 1")
        else:
            count = unpack_sample(arguments.origin, arguments.goal, arguments.sample)
    except (ValueError, OSError) as error:
        sys.exit(f"kept_runs: {error}")
    print(f"{count} runs in {arguments.goal}")


if __name__ == "__main__":
    main()
