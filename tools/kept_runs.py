"""Keep finished runs small, or put kept ones back: exact, one file per environment and variant.

    .venv/bin/python -m tools.kept_runs pack RESULTS ARCHIVE      results/study reference/study
    .venv/bin/python -m tools.kept_runs unpack ARCHIVE RESULTS    reference/study results/study

Of RESULTS/runs/ENV/VARIANT/seedN are kept `episodes.csv` and `run.json`, which has the digests of
what is not kept; of seed0 the agent too, which the report shows at play.
ARCHIVE/ENV/VARIANT.tar.xz has them as seedN/FILE. Packing again adds seeds to those that are there;
equal runs give equal files. `make tables` reads what is in reference/study.
"""

import argparse
import io
import json
import lzma
import os
import sys
import tarfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mace_rl import files
from mace_rl.files import write_atomically
from mace_rl.runs.provenance import file_digest, read_record

AT_PLAY = "seed0"


def read(archive: Path) -> dict[str, bytes]:
    """What is in an archive, by name."""
    # Decompressed at once: tarfile's own way takes twice as long.
    content = lzma.decompress(archive.read_bytes())
    with tarfile.open(fileobj=io.BytesIO(content)) as tar:
        files_in_it = ((member.name, tar.extractfile(member)) for member in tar.getmembers())
        return {name: file.read() for name, file in files_in_it if file is not None}


def write(archive: Path, content: dict[str, bytes]) -> None:
    """Write an archive without times and owners: equal content gives an equal file."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name in sorted(content, key=lambda name: (int(name[4 : name.index("/")]), name)):
            member = tarfile.TarInfo(name)
            member.size = len(content[name])
            tar.addfile(member, io.BytesIO(content[name]))
    archive.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(archive, lzma.compress(buffer.getvalue(), preset=9 | lzma.PRESET_EXTREME))


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
            digests = read_record(run / files.RECORD)["outputs"]
            before = packed.get(f"{run.name}/{files.RECORD}")
            if before and json.loads(before)["outputs"] != digests:
                raise ValueError(f"{run}: {archive} has another run of this seed")
            kept = [files.EPISODES, *([files.AGENT] if run.name == AT_PLAY else [])]
            for name in kept:
                if file_digest(run / name) != digests[name]:
                    raise ValueError(f"{run / name}: not the file that run.json describes")
            for name in (*kept, files.RECORD):
                content[f"{run.name}/{name}"] = (run / name).read_bytes()
        if content != packed:  # compressing takes seconds
            write(archive, content)
        count += sum(name.endswith(files.RECORD) for name in content)
    return count


def unpack(archives: Path, results: Path) -> int:
    """Put the runs in `archives` where they were below `results`; returns how many.

    Raises `ValueError` if there are none.
    """

    def put_back(archive: Path) -> int:
        variant = results / "runs" / archive.parent.name / archive.name.removesuffix(".tar.xz")
        content = read(archive)
        for name, data in content.items():
            (variant / name).parent.mkdir(parents=True, exist_ok=True)
            (variant / name).write_bytes(data)  # half of it would not be what run.json describes
        return sum(name.endswith(files.RECORD) for name in content)

    packed = sorted(archives.glob("*/*.tar.xz"))
    if not packed:
        raise ValueError(f"{archives}: no ENV/VARIANT.tar.xz in it")
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return sum(pool.map(put_back, packed))


def main() -> None:
    """Entry point."""
    commands = {"pack": pack, "unpack": unpack}
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog="example: python -m tools.kept_runs pack results reference/study",
    )
    parser.add_argument("command", choices=commands)
    parser.add_argument("origin", type=Path, help="RESULTS to pack, or the ARCHIVE to unpack")
    parser.add_argument("goal", type=Path, help="the ARCHIVE, or RESULTS")
    arguments = parser.parse_args()
    try:
        count = commands[arguments.command](arguments.origin, arguments.goal)
    except (ValueError, OSError, tarfile.TarError, lzma.LZMAError) as error:
        sys.exit(f"kept_runs: {error}")
    print(f"{count} runs in {arguments.goal}")


if __name__ == "__main__":
    main()
