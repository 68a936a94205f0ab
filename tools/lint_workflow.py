"""Run `snakemake --lint` and accept nothing but its notice that a rule names no environment.

One lock serves all rules here, so no rule names a conda environment or container of its own.
"""

import argparse
import contextlib
import io
import json
import sys
from pathlib import Path

from snakemake.api import SnakemakeApi
from snakemake.settings.types import OutputSettings, Quietness, ResourceSettings

ACCEPTED = "Specify a conda environment or container for each rule."


def lints(snakefile: Path) -> list[tuple[str, str]]:
    """Return (rule or file, title) of every lint, accepted or not."""
    # The API, because the command accepts --lint json and then writes text all the same.
    report = io.StringIO()
    with SnakemakeApi(OutputSettings(quiet={Quietness.ALL})) as api:
        workflow = api.workflow(resource_settings=ResourceSettings(cores=1), snakefile=snakefile)
        with contextlib.redirect_stdout(report):
            workflow.lint(json=True)
    found = json.loads(report.getvalue())
    places = [(item["for"], item) for item in found["snakefiles"]]
    places += [(f"rule {item['for']['rule']}", item) for item in found["rules"]]
    return [(place, lint["title"]) for place, item in places for lint in item["lints"]]


def main() -> None:
    """Print what is left of the lints and fail if that is anything."""
    argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="example: python -m tools.lint_workflow"
    ).parse_args()
    left = [lint for lint in lints(Path("Snakefile")) if lint[1] != ACCEPTED]
    for where, title in left:
        print(f"{where}: {title}", file=sys.stderr)
    sys.exit(bool(left))


if __name__ == "__main__":
    main()
