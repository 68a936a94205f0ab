"""Around the workflow's jobs: one Snakemake in a results folder, and what it says at its end."""

import fcntl
import os
import platform
import sys
import textwrap
from typing import TextIO

from mace_rl.base import files
from mace_rl.base.tables import read_made
from mace_study.plan import Plan

SHOWN = ["figure1.pdf", "figure2.pdf", "table1.tex", "table2.tex", "tables.md", "claims.md"]
MOST_NAMED = 24  # other files, by name


def occupy(folder: str) -> TextIO:
    """Keep other Snakemakes out of `folder` as long as the file that this returns is open.

    Snakemake's own lock (9.27.1) outlives a kill; profiles/default/config.yaml turns it off. Exits
    with a line if another one is there, or the folder cannot be used.
    """
    try:
        os.makedirs(folder, exist_ok=True)
        lock = open(f"{folder}/{files.LOCK}", "a+", encoding="utf-8")  # noqa: SIM115 (stays open)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.seek(0)
        sys.exit(f"Error: {lock.read() or 'another Snakemake'} is at work in {folder}; wait for it")
    except OSError as error:
        sys.exit(f"Error: the results folder {folder} cannot be used: {error.strerror}")
    lock.truncate(0)
    lock.write(f"Snakemake (process {os.getpid()} on {platform.node()})")
    lock.flush()
    return lock


def outcome(plan: Plan, wanted: set[str], asked: set[str], of_all: set[str]) -> str:
    """Table 1, if it is among what was asked for, and where all of this lies.

    Only of files that are there: with --touch, --until and the like Snakemake makes not all.
    wanted: what jobs make; asked: of these what was asked for; of_all: what a rule without output,
    such as `all`, needs.
    """
    made = set(filter(os.path.exists, wanted))
    lines = []
    if f"{plan.results}/table1.csv" in made:
        from mace_study.show import markdown, tables  # only now: it takes as long as planning

        table1 = read_made(f"{plan.results}/table1.csv")
        named = tables.named(table1, plan.study.labels)
        shown = tables.table1(named, plan.measured, plan.paper.table1)
        lines = [f"\n{title(plan)}\n", markdown.plain(shown), ""]
    lie = [path for path in (f"{plan.results}/{name}" for name in SHOWN) if path in made]
    others = sorted((asked & made).difference(lie))
    if len(others) > MOST_NAMED:
        others = [f"{len(others)} files more in {plan.results}"]
    lines += textwrap.wrap(", ".join([*lie, *others]), 100)
    if missing := sorted(path for path in asked | of_all if not os.path.exists(path)):
        more = f" and {len(missing) - 1} more" if missing[1:] else ""
        lines.append(f"Not there, and not made now: {missing[0]}{more}")
    return "\n".join(lines)


def title(plan: Plan) -> str:
    """That of Table 1, with what its marks mean."""
    from mace_study.show.tables import counts_episodes

    caption = plan.paper.table1.caption
    name = f"Table 1: {caption[0].lower()}{caption[1:]}"
    if not counts_episodes(plan.measured, plan.paper.table1):
        return f"{name}; *: best"
    return f"{name} in episodes; *: lowest; †k: k seeds do not succeed"
