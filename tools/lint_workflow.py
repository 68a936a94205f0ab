"""Run `snakemake --lint` and accept nothing but its notice that a rule names no environment.

One lock serves all rules here, so no rule names a conda environment or container of its own.
"""

import argparse
import re
import subprocess
import sys

ACCEPTED = "Specify a conda environment or container for each rule."


def lints() -> list[tuple[str, str]]:
    """Return (rule or file, title) of every lint, accepted or not.

    Raises RuntimeError with what Snakemake said if it failed and named no lint.
    """
    # The text: as JSON, a lint about a whole file makes Snakemake fail (9.27.1).
    command = [sys.executable, "-m", "snakemake", "--lint"]
    run = subprocess.run(command, capture_output=True, text=True)
    found, where = [], ""
    for line in run.stderr.splitlines():
        if match := re.match(r"Lints for (?:snakefile )?(.+?)(?: \(line .*\))?:$", line):
            where = match[1]
        elif match := re.match(r"    \* (.+):$", line):
            found.append((where, match[1]))
    if run.returncode and not found:
        raise RuntimeError(run.stderr)
    return found


def main() -> None:
    """Print what is left of the lints and fail if that is anything."""
    argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.lint_workflow"
    ).parse_args()
    left = [lint for lint in lints() if lint[1] != ACCEPTED]
    for where, title in left:
        print(f"{where}: {title}", file=sys.stderr)
    sys.exit(bool(left))


if __name__ == "__main__":
    main()
