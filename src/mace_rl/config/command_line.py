"""Snakemake's command line, checked before Snakemake reads it (profiles/default)."""

import argparse
import sys
from pathlib import Path

from mace_rl.config.reading import read_options, read_yaml
from mace_rl.config.section import ConfigError


def checked(cluster: bool = False) -> argparse.Namespace:
    """The `cores` and `configfile` of the command; exits with one line where they are wrong.

    On a cluster -j and --cores are two things: jobs in its queue, and cores of each.
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--snakefile", "-s", default="Snakefile")
    parser.add_argument("--cores", "-c", nargs="?", const="all")
    parser.add_argument("--jobs", "-j", nargs="?", const="all")
    parser.add_argument("--configfile", "--configfiles", nargs="+", action="append", default=[])
    # Beside the other one it is not short for --configfile.
    parser.add_argument("--config", "-C", nargs="*", action="append", default=[])
    given, _ = parser.parse_known_args()
    try:
        for option in ("configfile", "config"):
            once = getattr(given, option)
            if len(once) > 1:  # Snakemake reads the last alone
                raise ConfigError(f"--{option} is there {len(once)} times: give one all its values")
            setattr(given, option, [value for values in once for value in values])
        for file in [*Path(given.snakefile).parent.glob("config.yaml"), *given.configfile]:
            read_yaml(Path(file))
        read_options(given.config)
        if given.cores and given.jobs and given.cores != given.jobs and not cluster:
            raise ConfigError(
                f"-j {given.jobs} and --cores {given.cores} contradict each other: give one of them"
            )
    except ConfigError as error:
        sys.exit(f"Error in the configuration: {error}")
    given.cores = given.cores or given.jobs
    return given
