"""The tables, figures and verdicts of the studies that are kept, without training.

    python -m tools.tables [--check] [--cores N]        (make tables)
    python -m tools.tables --report STUDY   (make report)

The kept runs are unpacked, and Snakemake makes of them, in results/tables/STUDY, the outputs that
reference/studies.yaml names, and README.md: tables.md with the pictures that are among these. What
the worlds of reference/worlds/protocol.md say together comes into results/tables/worlds, and what
they say of every reading of the learned β into results/tables/readings. Pictures are reduced to 256
colours. All is compared with reference/tables. New files are kept there, and README.md, which only
shows the others, is renewed; with --check both are mistakes. With --report only the page of one
study is made, and not compared.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any

from PIL import Image

from mace_rl.config.reading import read_yaml
from tools import kept_runs, specification, worlds

ROOT = Path(__file__).resolve().parent.parent

STUDIES = Path("reference/studies.yaml")
EXPECTED, MADE = Path("reference/tables"), Path("results/tables")
PICTURE = r"\n!\[[^]]*\]\(([^)]*)\)\n"  # as `tables_page` writes them
PAGE, TABLES, README = "report.html", "tables.md", "README.md"
KEPT, READINGS = Path("reference/worlds"), "readings"
# All but training: what is not kept of a run cannot be asked for.
RULES = (
    *("metrics", "tables", "table2", "tables_page", "figures", "claims", "picture", "readings"),
    "page",
)


def make(name: str, study: dict[str, Any], cores: int) -> None:
    """Make the `outputs` of one study; `ValueError` with what Snakemake says if it cannot.

    Where it is started `config/` is the project's, so that the pages name the command.
    """
    folder = ROOT / MADE / name
    folder.mkdir(parents=True)
    (folder / "runs").symlink_to(ROOT / MADE / study["runs"] / "runs", target_is_directory=True)
    (folder / "config").symlink_to(ROOT / "config", target_is_directory=True)
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(ROOT / "Snakefile")]
    command += ["--cores", str(cores), "--allowed-rules", *RULES]
    command += ["--configfile", *study["configfiles"]]
    command += ["--config", f"results={folder}", *study["config"]]
    command += ["--", *(f"{folder}/{output}" for output in study["outputs"])]
    done = subprocess.run(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        raise ValueError(f"{name}: {done.stdout.strip()}")


def make_all(studies: dict[str, Any], cores: int) -> None:
    """Make the outputs of every study, as many studies at once as there are cores for."""
    at_once = min(cores, len(studies))
    with ThreadPoolExecutor(at_once) as pool:
        list(pool.map(make, studies, studies.values(), repeat(cores // at_once)))


def write_readme(name: str, outputs: list[str]) -> None:
    """README.md of a study, beside what is kept of it: its name, its tables, these pictures."""
    text = (MADE / name / TABLES).read_text(encoding="utf-8")
    text = re.sub(PICTURE, lambda found: found[0] if found[1] in outputs else "", text)
    text = re.sub("^# .*", f"# {name}", text)
    (MADE / name / README).write_text(text, encoding="utf-8")


def reduce_colours(picture: Path) -> None:
    """Keep 256 colours of a PNG file that cover all of its own, in less than half the bytes.

    Those that are nearest on average would leave out a dot of a colour that is nowhere else.
    """
    with Image.open(picture) as image:
        how = Image.Quantize.MAXCOVERAGE
        reduced = image.convert("RGB").quantize(256, how, dither=Image.Dither.NONE)
    reduced.save(picture, optimize=True)


def difference(name: str, outputs: list[str], check: bool) -> list[str]:
    """The outputs that are not those in `EXPECTED`, where new ones and pages go, unless `check`."""
    different = []
    for output in outputs:
        made, expected = MADE / name / output, EXPECTED / name / output
        if expected.exists() and made.read_bytes() == expected.read_bytes():
            continue
        if check or (expected.exists() and output != README):
            different.append(str(expected))
            continue
        print(f"{'renewed' if expected.exists() else 'new'}: {expected}")
        expected.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(made, expected)
    return different


def main() -> None:
    """Entry point; exits with 1 if anything differs from what is kept."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.tables --check"
    )
    parser.add_argument("--check", action="store_true", help="keep and renew nothing")
    parser.add_argument("--report", metavar="STUDY", help="make only this study's page")
    parser.add_argument("--cores", default="all", metavar="N", help="jobs at once, default: all")
    arguments = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    if arguments.cores != "all":
        if not arguments.cores.isdecimal() or not int(arguments.cores):
            parser.error(f"--cores is {arguments.cores!r}, but should be all, or at least 1")
        cores = int(arguments.cores)
    check, only = arguments.check, arguments.report
    os.chdir(ROOT)
    studies = read_yaml(STUDIES)
    if only and only not in studies:
        sys.exit(f"tables: --report is {only!r}, but should be one of {', '.join(studies)}")
    wanted = {only: studies[only]} if only else studies
    archives = dict.fromkeys(study["runs"] for study in wanted.values())
    for stale in [MADE / only, *(MADE / archive for archive in archives)] if only else [MADE]:
        if stale.exists():
            shutil.rmtree(stale)
    outputs = {name: [PAGE] if only else study["outputs"] for name, study in wanted.items()}
    try:
        runs = sum(kept_runs.unpack(Path(archive), MADE / archive, cores) for archive in archives)
        make_all(
            {name: wanted[name] | {"outputs": [*own, TABLES]} for name, own in outputs.items()},
            cores,
        )
    except ValueError as error:
        sys.exit(f"tables: {error}")
    if only:
        print(MADE / only / PAGE)
        return
    for name in outputs:
        write_readme(name, outputs[name])
        outputs[name] = [*outputs[name], README]
    if together := worlds.make(MADE):
        outputs[worlds.FOLDER] = together
    if asked := specification.make(MADE / KEPT, MADE / READINGS, cores):
        outputs[READINGS] = asked
    made = [MADE / name / output for name, own in outputs.items() for output in own]
    with ProcessPoolExecutor(cores) as pool:
        list(pool.map(reduce_colours, [path for path in made if path.suffix == ".png"]))
    different = [path for name in outputs for path in difference(name, outputs[name], check)]
    count = sum(map(len, outputs.values()))
    print(f"{count} tables and figures of {len(studies)} studies from {runs} runs, in {MADE}")
    if different:
        sys.exit("tables: not those that are kept: " + ", ".join(different))


if __name__ == "__main__":
    main()
