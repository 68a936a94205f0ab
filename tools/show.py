"""Print what the kept results say, as the Markdown that README and docs have between marks.

    .venv/bin/python -m tools.show WHAT FOLDER [...]

FOLDER is one of reference/tables, or the results of any study; of the last five reference/study
and reference/measured. Intervals that a study's files have are printed as they are; those that are
computed here follow `metrics` of config.yaml. WHAT is one of

    headline    what holds, in three sentences                                      (claims.json)
    ledger      a verdict for each claim                                           (claims.json)
    parts       what the verdicts rest on, part by part; `parts FOLDER robust`     (claims.json)
    table1      Table 1, the paper's numbers beside ours                            (table1.csv)
    means       final return and mean return of training; `means FOLDER COLUMN ...` (metrics.csv)
    solved      how many seeds solve each task                                     (metrics.csv)
    constants   mean return of training by variant, in columns                     (metrics.csv)
    finals      final return [worst seed] / mean return of training, in columns     (metrics.csv)
    regret      what the learned β loses against the best constant                   (regret.csv)
    improvement probability that one variant's run is better than another's    (comparisons.csv)
    differences of the same pairs, by seed; p, by itself and corrected         (comparisons.csv)
    together    the same over the environments of several studies: `together FOLDER NAME ... VARIANT
                OTHER ...`, NAMEs of folders beside FOLDER                         (metrics.csv)
    aggregate   scores between random and the best run, all environments          (aggregate.csv)
    readings    Table 1 under every reading                                         (readings.md)
    betas       the learned β at the end of training: `betas FOLDER ENVIRONMENT ...`   (kept runs)
    lowest      the lowest that it was; arguments as of betas                      (kept runs)
    stagnation  how it goes with stagnation (C9); arguments as of betas            (kept runs)
    shares      the bonus's share of the advantages, by β                       (bonus_share.csv)
    signals     signal and noise of the credit of β                             (meta_signal.csv)
"""

import argparse
import inspect
import sys
from collections.abc import Callable
from pathlib import Path

from tools.shown import results, runs

SHOWN: dict[str, Callable[..., list[str]]] = {
    function.__name__: function
    for function in (
        *(results.headline, results.ledger, results.parts, results.table1, results.means),
        *(results.solved, results.constants, results.finals, results.regret, results.improvement),
        *(results.differences, results.together, results.aggregate, results.readings),
        *(runs.betas, runs.lowest, runs.stagnation, runs.shares, runs.signals),
    )
}


def main() -> None:
    """Entry point; exits with what is wrong with the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m tools.show means reference/tables/study",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=SHOWN, metavar="WHAT")
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("more", nargs="*", metavar="...")
    arguments = parser.parse_args()
    show = SHOWN[arguments.what]
    try:
        inspect.signature(show).bind(arguments.folder, *arguments.more)
    except TypeError:
        sys.exit(f"show: {arguments.what} does not take {' '.join(arguments.more)!r}")
    try:
        lines = show(arguments.folder, *arguments.more)
    except OSError as error:
        sys.exit(f"show: {error.filename}: {error.strerror}")
    except KeyError as error:
        sys.exit(f"show: there is no {error} in what {arguments.folder} has")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
