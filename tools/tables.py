"""Every table, figure and verdict from the runs that are kept, without training.

    python -m tools.tables [--check]        (make tables)
    python -m tools.tables --report STUDY   (make report)

The runs in reference/study are unpacked, and Snakemake makes of them, into results/tables/STUDY,
the outputs that reference/studies.yaml names. They are compared with those in reference/tables.
New ones are kept there; with --check that one is missing is a mistake too. With --report only the
page of one study is made, and not compared.
"""

import argparse
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mace_rl.config.reading import read_yaml
from tools import archive

ROOT = Path(__file__).resolve().parent.parent
KEPT, STUDIES = Path("reference/study"), Path("reference/studies.yaml")
EXPECTED, MADE = Path("reference/tables"), Path("results/tables")
PAGE = "report.html"
# All but training: what is not kept of a run cannot be asked for.
RULES = (
    *("metrics", "table1", "table2", "comparisons", "aggregate", "curves", "figure", "claims"),
    *("pictures", "regret_figure", "readings", "page"),
)


def make(name: str, study: dict[str, Any]) -> None:
    """Make the `outputs` of one study; exits with what Snakemake says if it cannot."""
    folder = MADE / name
    folder.mkdir(parents=True)
    (folder / "runs").symlink_to("../runs", target_is_directory=True)
    command = [sys.executable, "-m", "snakemake", "--cores", "1", "--quiet", "all"]
    command += ["--allowed-rules", *RULES, "--configfile", *study["configfiles"]]
    command += ["--config", f"results={folder}", *study["config"]]
    command += ["--", *(f"{folder}/{output}" for output in study["outputs"])]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"tables: {name}: {done.stderr.strip()}")


def difference(name: str, outputs: list[str], check: bool) -> list[str]:
    """The outputs that are not those in `EXPECTED`; new ones go there, unless `check`."""
    different = []
    for output in outputs:
        made, expected = MADE / name / output, EXPECTED / name / output
        if not expected.exists() and not check:
            expected.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(made, expected)
            print(f"new: {expected}")
        elif not expected.exists() or made.read_bytes() != expected.read_bytes():
            different.append(str(expected))
    return different


def main() -> None:
    """Entry point; exits with 1 if anything differs from what is kept."""
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.tables --check"
    )
    parser.add_argument("--check", action="store_true", help="keep nothing new")
    parser.add_argument("--report", metavar="STUDY", help="make only this study's page")
    arguments = parser.parse_args()
    check, only = arguments.check, arguments.report
    os.chdir(ROOT)
    studies = read_yaml(STUDIES)
    if only and only not in studies:
        sys.exit(f"tables: --report is {only!r}, but should be one of {', '.join(studies)}")
    shutil.rmtree(MADE, ignore_errors=True)
    runs = archive.unpack(KEPT, MADE)
    if only:
        make(only, {**studies[only], "outputs": [PAGE]})
        print(MADE / only / PAGE)
        return
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(make, studies, studies.values()))
    outputs = {name: study["outputs"] for name, study in studies.items()}
    different = [path for name in outputs for path in difference(name, outputs[name], check)]
    count = sum(map(len, outputs.values()))
    print(f"{count} tables and figures of {len(studies)} studies from {runs} runs, in {MADE}")
    if different:
        sys.exit("tables: not those that are kept: " + ", ".join(different))


if __name__ == "__main__":
    main()
