"""The tables, figures and verdicts of the studies that are kept, without training.

    python -m tools.tables [--check]        (make tables)
    python -m tools.tables --report STUDY   (make report)

The runs in `KEPT` are unpacked, and Snakemake makes of them, into results/tables/STUDY, the outputs
that reference/studies.yaml names, and README.md: tables.md with the pictures that are among these,
and the verdicts of the first study beside those of this one. They are compared with those in
reference/tables. New ones are kept there, and README.md, which only shows the others, is renewed;
with --check both are mistakes. With --report only the page of one study is made, and not compared.
"""

import argparse
import gc
import importlib
import json
import multiprocessing.connection
import os
import queue
import re
import runpy
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pandas as pd
import snakemake.cli
import snakemake.script
from threadpoolctl import threadpool_limits

from mace_rl.config.reading import read_yaml
from mace_rl.study.claims_config import ROBUST
from mace_rl.study.show.cells import markdown
from mace_rl.study.show.markdown import Ledger
from mace_rl.study.show.tables import parts
from tools import kept_runs

ROOT = Path(__file__).resolve().parent.parent
CORES = len(os.sched_getaffinity(0))
# What the workflow and its jobs import, or let be imported, which takes longer than most of the
# jobs' work: imported once, before the processes of all of them are forked.
SHARED = (
    *("gymnasium", "smart_open", "nbformat", "pandas", "seaborn", "fontTools.subset"),
    *("matplotlib.backends.backend_agg", "matplotlib.backends.backend_pdf"),
    *("mace_rl.study.config", "mace_rl.runs.provenance", "mace_rl.runs.queueing"),
    *("mace_rl.study.compare.comparisons", "mace_rl.study.compare.readings"),
    *("mace_rl.study.show.markdown", "mace_rl.study.show.pictures"),
)
fork = multiprocessing.get_context("fork")

KEPT, STUDIES = Path("reference/study"), Path("reference/studies.yaml")
EXPECTED, MADE = Path("reference/tables"), Path("results/tables")
FIRST = Path("reference/measured/first_study.json")
PICTURE = r"\n!\[[^]]*\]\(([^)]*)\)\n"  # as `tables_page` writes them
PAGE, TABLES, README = "report.html", "tables.md", "README.md"
# All but training: what is not kept of a run cannot be asked for.
RULES = (
    *("metrics", "tables", "table2", "tables_page", "figure", "claims", "picture", "forest"),
    *("readings", "page"),
)


def make(name: str, study: dict[str, Any]) -> None:
    """Make the `outputs` of one study and end this process, with 1 if Snakemake cannot.

    What it says is in `log_of(name)`.
    """
    folder = MADE / name
    folder.mkdir(parents=True)
    with log_of(name).open("wb") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    (folder / "runs").symlink_to("../runs", target_is_directory=True)
    command = ["--cores", str(CORES), "--allowed-rules", *RULES]
    command += ["--configfile", *study["configfiles"]]
    command += ["--config", f"results={folder}", *study["config"]]
    command += ["--", *(f"{folder}/{output}" for output in study["outputs"])]
    sys.argv = ["snakemake", *command]  # where profiles/default looks for --cores
    idle: queue.SimpleQueue[Connection] = queue.SimpleQueue()
    pipes = [fork.Pipe() for _ in range(CORES)]
    for jobs, scripts in pipes:
        fork.Process(target=run_scripts, args=(scripts, pipes)).start()
        idle.put(jobs)
    for _, scripts in pipes:
        scripts.close()  # so that an end of that process does not leave this one waiting

    def execute_script(_: object, script: str, edit: bool = False) -> None:
        jobs = idle.get()
        jobs.send(script)
        status = jobs.recv()
        idle.put(jobs)
        if status:
            raise subprocess.CalledProcessError(status, script)

    snakemake.script.PythonScript.execute_script = execute_script
    try:
        snakemake.cli.main(command)
    finally:
        for jobs, _ in pipes:
            jobs.send(None)


def run_scripts(mine: Connection, pipes: Sequence[tuple[Connection, Connection]]) -> None:
    """Run each script that comes in a process forked from this one, and send its exit status.

    Not forked from Snakemake's own process, which has threads by then. mine: the end of one of
    `pipes`. The others are closed, so that the end of Snakemake is the end of this.
    """
    for end in (end for pipe in pipes for end in pipe if end is not mine):
        end.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the scripts end, which Snakemake is to hear
    for script in iter(mine.recv, None):
        process = fork.Process(
            target=runpy.run_path, args=(script,), kwargs={"run_name": "__main__"}
        )
        process.start()
        process.join()
        mine.send(process.exitcode)


def make_all(studies: dict[str, Any]) -> None:
    """Make the outputs of every study, as many studies at once as there are cores.

    Each in a process forked from this one, which has done what all of them begin with: imports and
    Snakemake's plugins.
    """
    snakemake.cli.get_argument_parser()
    # One thread for each job, as where Snakemake itself starts it: of libraries that are loaded and
    # of those that will be.
    threadpool_limits(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    gc.freeze()  # or each process would go through, and so copy, what all of them share
    waiting = [(name, fork.Process(target=make, args=(name, studies[name]))) for name in studies]
    running: dict[Any, tuple[str, Any]] = {}  # by what is ready when the process ends
    while waiting or running:
        while waiting and len(running) < CORES:
            name, process = waiting.pop(0)
            process.start()
            running[process.sentinel] = name, process
        for ended in multiprocessing.connection.wait(list(running)):
            name, process = running.pop(ended)
            process.join()
            if process.exitcode:
                sys.exit(f"tables: {name}: {log_of(name).read_text(encoding='utf-8').strip()}")


def log_of(name: str) -> Path:
    """The file of what Snakemake says about a study."""
    return MADE / name / "snakemake.log"


def write_readme(name: str, outputs: list[str]) -> None:
    """README.md of a study, beside what is kept of it: its name, its tables, these pictures."""
    text = (MADE / name / TABLES).read_text(encoding="utf-8")
    text = re.sub(PICTURE, lambda found: found[0] if found[1] in outputs else "", text)
    text = re.sub("^# .*", f"# {name}", text)
    if (ledger := MADE / name / "claims.json").exists():
        first, second = (json.loads(path.read_text(encoding="utf-8")) for path in (FIRST, ledger))
        text += beside_the_first(first, second["claims"])
    (MADE / name / README).write_text(text, encoding="utf-8")


def beside_the_first(first: Ledger, second: Ledger) -> str:
    """The verdicts and the parts of the second study, robust, beside those that the first has."""
    verdicts = {claim["claim"]: claim[ROBUST]["verdict"] for claim in first}
    rows = [
        [c["claim"], c["statement"], verdicts.get(c["claim"], ""), c[ROBUST]["verdict"]]
        for c in second
    ]
    said = pd.DataFrame(rows, columns=["", "statement", "first", "this"])
    what = ["", "environment", "metric", "over"]
    shown = [*what, "n", "difference", "outcome"]
    frames = [parts(claims, ROBUST, {}).iloc[:, [*range(6), -1]] for claims in (first, second)]
    before, now = (frame.set_axis(shown, axis=1) for frame in frames)
    both = now.merge(before, "left", on=what, suffixes=("", " (first)")).fillna("")
    return (
        "\n## The first study and this one\n\nBoth by the robust metrics and the same rule. The"
        " first study's runs, of seeds below 20, are in commit 3c9fd6f. It had no NoisyMountainCar"
        f" and no NoisyDeepSea10.\n\n{markdown(said)}\n{markdown(both)}"
    )


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
    arguments = parser.parse_args()
    check, only = arguments.check, arguments.report
    os.chdir(ROOT)
    studies = read_yaml(STUDIES)
    if only and only not in studies:
        sys.exit(f"tables: --report is {only!r}, but should be one of {', '.join(studies)}")
    for stale in [MADE / "runs", MADE / only] if only else [MADE]:
        if stale.exists():
            shutil.rmtree(stale)
    with ThreadPoolExecutor(1) as beside:
        unpacked = beside.submit(kept_runs.unpack, KEPT, MADE)
        for module in SHARED:
            importlib.import_module(module)
        runs = unpacked.result()
    if only:
        make_all({only: {**studies[only], "outputs": [PAGE]}})
        print(MADE / only / PAGE)
        return
    outputs = {name: study["outputs"] for name, study in studies.items()}
    make_all(
        {name: {**study, "outputs": [*study["outputs"], TABLES]} for name, study in studies.items()}
    )
    for name in outputs:
        write_readme(name, outputs[name])
        outputs[name] = [*outputs[name], README]
    different = [path for name in outputs for path in difference(name, outputs[name], check)]
    count = sum(map(len, outputs.values()))
    print(f"{count} tables and figures of {len(studies)} studies from {runs} runs, in {MADE}")
    if different:
        sys.exit("tables: not those that are kept: " + ", ".join(different))


if __name__ == "__main__":
    main()
