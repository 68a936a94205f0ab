"""The command `mace-rl`: one training run by hand."""

import argparse
import json
import logging
import sys
from pathlib import Path

from mace_rl.hyperparameters import ConfigError, RunConfig
from mace_rl.study import read_study

CONFIG = Path(__file__).parents[2] / "config.yaml"


def parser() -> argparse.ArgumentParser:
    """The command line of `mace-rl`."""
    top = argparse.ArgumentParser(prog="mace-rl", description=__doc__, allow_abbrev=False)
    commands = top.add_subparsers(dest="command", required=True)
    train = commands.add_parser(
        "train",
        allow_abbrev=False,
        help="carry out one training run",
        description="Carry out one training run; the same command resumes it if interrupted.",
    )
    train.add_argument("--env", required=True, help="a registered Gymnasium id")
    train.add_argument("--variant", required=True, help="one of the config's variant_settings")
    train.add_argument("--seed", required=True, type=int)
    train.add_argument("--episodes", type=int, help="instead of the config's budget")
    train.add_argument(
        "--config", type=Path, help="a YAML file read over the project's config.yaml"
    )
    train.add_argument("--out", required=True, type=Path, help="folder for the results")
    return top


def run_config(arguments: argparse.Namespace) -> RunConfig:
    """The run that the command line asks for; raises `ConfigError`."""
    study = read_study([CONFIG, arguments.config] if arguments.config else [CONFIG])
    config = study.run_config(arguments.env, arguments.variant, arguments.seed)
    if arguments.episodes is None:
        return config
    if arguments.episodes < 1:
        raise ConfigError(f"--episodes is {arguments.episodes}, but should be at least 1")
    return config.model_copy(update={"episodes": arguments.episodes})


def finished(config: RunConfig, directory: Path) -> bool:
    """Whether `directory` holds the results of this run; `ConfigError` if they are of another."""
    record = directory / "run.json"
    if not record.exists():
        return False
    found = json.loads(record.read_text(encoding="utf-8"))["config"]
    wanted = config.model_dump()
    different = [key for key in wanted if found.get(key) != wanted[key]]
    if different:
        key = different[0]
        raise ConfigError(
            f"{directory} holds a finished run whose {key} is {found.get(key)!r}, "
            f"not {wanted[key]!r}; choose another --out"
        )
    return True


def main() -> None:
    """Entry point; exits with 1 and one line on standard error for what cannot be done."""
    arguments = parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    log = logging.getLogger("mace-rl")
    try:
        config = run_config(arguments)
        if finished(config, arguments.out):
            log.info("%s holds this run already, finished", arguments.out)
            return
        # Imported here: PyTorch takes seconds, and a mistake in the command should not.
        from mace_rl import run

        run.run(config, arguments.out)
        log.info("finished: %s", arguments.out / "episodes.csv")
    except (ConfigError, RuntimeError, ArithmeticError, OSError) as error:
        sys.exit(f"mace-rl: {error}")
    except KeyboardInterrupt:
        log.info("interrupted; the same command resumes it")
        sys.exit(130)
