"""The command `mace-rl`: train one run, evaluate or film its agent, export records, repeat runs."""

import argparse
import logging
import sys
from pathlib import Path

from mace_rl import files
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError, check
from mace_rl.config.study import read_study
from mace_rl.refusal import Refusal
from mace_rl.runs.provenance import file_digest, read_record

logger = logging.getLogger(__name__)

CONFIG = Path(__file__).parents[2] / "config.yaml"


def parser() -> argparse.ArgumentParser:
    """The command line of `mace-rl`."""
    top = argparse.ArgumentParser(
        prog="mace-rl",
        description=__doc__,
        epilog="example: mace-rl train --help",
        allow_abbrev=False,
    )
    commands = top.add_subparsers(dest="command", required=True)
    train = commands.add_parser(
        "train",
        allow_abbrev=False,
        help="carry out one training run",
        description="Carry out one training run; the same command resumes it if interrupted.",
        epilog="example: mace-rl train --env CartPole-v1 --variant mace_full --seed 0 "
        "--episodes 100 --out cartpole_run",
    )
    train.add_argument("--env", required=True, help="a registered Gymnasium id")
    train.add_argument("--variant", required=True, help="one of the config's variant_settings")
    train.add_argument("--seed", required=True, type=int)
    train.add_argument("--episodes", type=int, help="instead of the config's budget")
    train.add_argument(
        "--config",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="YAML files read over the project's config.yaml, one after the other",
    )
    train.add_argument(
        "--engine",
        choices=["compiled", "torch"],
        help="of every network: compiled (default) or plain PyTorch, slower, to check it by",
    )
    train.add_argument("--out", required=True, type=Path, help="folder for the results")
    evaluate = commands.add_parser(
        "evaluate",
        allow_abbrev=False,
        help="play episodes with a trained agent",
        description="Play episodes with a trained agent and print its returns.",
        epilog="example: mace-rl evaluate cartpole_run --episodes 20 --deterministic",
    )
    _play(evaluate, episodes=100)
    watch = commands.add_parser(
        "watch",
        allow_abbrev=False,
        help="film a trained agent, as a GIF",
        description="Write an animated GIF of the first episodes that `mace-rl evaluate` plays.",
        epilog="example: mace-rl watch cartpole_run --out cartpole.gif",
    )
    _play(watch, episodes=1)
    watch.add_argument(
        "--untrained", action="store_true", help="film the agent as it was before training"
    )
    watch.add_argument(
        "--seconds", type=float, default=10.0, help="of each episode at most (default: 10)"
    )
    watch.add_argument("--width", type=int, default=300, help="in pixels (default: 300)")
    watch.add_argument(
        "--out",
        type=Path,
        help="a GIF file (default: watch.gif or watch_untrained.gif in the folder)",
    )
    tensorboard = commands.add_parser(
        "tensorboard",
        allow_abbrev=False,
        help="write what runs recorded as TensorBoard's events",
        description="Write what runs recorded, finished or not, as event files for TensorBoard; "
        "again later, to bring them up to date.",
        epilog="example: mace-rl tensorboard cartpole_run --out events",
    )
    tensorboard.add_argument("folder", type=Path, help="of a run, or with runs below it")
    tensorboard.add_argument(
        "--out", type=Path, help="folder for the event files (default: beside the records)"
    )
    verify = commands.add_parser(
        "verify",
        allow_abbrev=False,
        help="repeat kept runs and compare to the bit",
        description="Repeat runs that were kept and say whether they come out the same.",
        epilog="example: mace-rl verify reference --sample 1",
    )
    verify.add_argument("folder", type=Path, help="with runs/ENV/VARIANT/seedN in it")
    verify.add_argument("--sample", type=int, help="how many, chosen at random (default: all)")
    verify.add_argument("--sample-seed", type=int, default=0, help="which ones (default: 0)")
    return top


def run_config(arguments: argparse.Namespace) -> RunConfig:
    """The run that the command line asks for; raises `ConfigError`."""
    study = read_study([CONFIG, *arguments.config])
    try:
        config = study.run_config(arguments.env, arguments.variant, arguments.seed)
    except ConfigError as error:
        if arguments.variant in study.variant_settings:
            raise
        raise ConfigError(f"{error}; variants of further studies need --config FILE") from None
    changes: dict[str, object] = {}
    if arguments.episodes is not None:
        _require(arguments.episodes >= 1, "--episodes", arguments.episodes, "be at least 1")
        changes["episodes"] = arguments.episodes
    if arguments.engine is not None:
        changes["engine"] = arguments.engine
    return config.model_copy(update=changes)


def _require(fits: bool, option: str, value: object, right: str) -> None:
    """Raise a `ConfigError` that says what an option is and what is right, unless it `fits`."""
    if not fits:
        raise ConfigError(f"{option} is {value!r}, but should {right}")


def finished(config: RunConfig, directory: Path) -> bool:
    """Whether `directory` holds the results of this run, whole and as it would come out now.

    Raises `ConfigError` if they are damaged, of another run, or of other code, versions or
    arithmetic, as a checkpoint of those is not continued.
    """
    record = directory / files.RECORD
    if not record.exists():
        return False
    way_out = "choose another --out, or remove the folder"
    content = read_record(record)
    found = check(RunConfig, content["config"], str(record)).settings()
    wanted = config.settings()
    different = [key for key in wanted | found if found.get(key) != wanted.get(key)]
    if different:
        key = different[0]
        raise ConfigError(
            f"{directory} holds a finished run whose {key} is {found.get(key)!r}, "
            f"not {wanted.get(key)!r}; {way_out}"
        )
    for path in (directory / name for name in files.RESULTS):
        if not path.exists() or file_digest(path) != content["outputs"].get(path.name):
            raise ConfigError(
                f"{path}: missing, cut off or altered (SHA-256 not as in run.json); {way_out}"
            )
    # Imported here: PyTorch takes seconds, and a mistake in the command should not.
    from mace_rl.runs.checkpoint import difference
    from mace_rl.runs.run import run_identity

    now = run_identity(config)
    other = [
        f"other {key} ({difference(content[key], now[key])})"
        for key in ("versions", "arithmetic")
        if content[key] != now[key]
    ]
    if content["sources"] != now["sources"]:
        code = " or ".join([*config.references().values(), "mace_rl"])
        other.insert(0, f"other code, in {code}")
    if other:
        raise ConfigError(f"{directory} holds a finished run of {', '.join(other)}; {way_out}")
    return True


def train(arguments: argparse.Namespace) -> None:
    """`mace-rl train`."""
    config = run_config(arguments)
    if finished(config, arguments.out):
        (arguments.out / files.CHECKPOINT).unlink(missing_ok=True)  # killed between the two
        logger.info("%s holds this run already, finished", arguments.out)
        return
    from mace_rl.runs import progress, run  # not above: see `finished`

    with progress.line(sys.stderr) as observe:
        run.run(config, arguments.out, observe)
    logger.info("finished: %s", arguments.out / files.EPISODES)


def _play(parser: argparse.ArgumentParser, episodes: int) -> None:
    """The arguments of what plays episodes with a trained agent, `episodes` by default."""
    parser.add_argument("folder", type=Path, help="of a finished run")
    parser.add_argument(
        "--episodes", type=int, default=episodes, help=f"how many (default: {episodes})"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    parser.add_argument(
        "--deterministic",
        action="store_true",
        help="take the most probable action, or the mean, instead of a sample",
    )


def _require_playable(arguments: argparse.Namespace) -> None:
    _require(arguments.episodes >= 1, "--episodes", arguments.episodes, "be at least 1")
    _require(arguments.seed >= 0, "--seed", arguments.seed, "be at least 0")
    if not (arguments.folder / files.RECORD).exists():
        raise ConfigError(f"no finished run in {arguments.folder}: it has no {files.RECORD}")


def evaluate(arguments: argparse.Namespace) -> None:
    """`mace-rl evaluate`."""
    _require_playable(arguments)
    from mace_rl.runs import evaluate

    returns = evaluate.evaluate(
        arguments.folder, arguments.episodes, arguments.seed, arguments.deterministic
    )
    print(
        f"{len(returns)} episodes: mean return {returns.mean():.2f}, standard deviation "
        f"{returns.std():.2f}, from {returns.min():.2f} to {returns.max():.2f}"
    )


def watch(arguments: argparse.Namespace) -> None:
    """`mace-rl watch`."""
    _require(arguments.seconds > 0, "--seconds", arguments.seconds, "be greater than 0")
    _require(50 <= arguments.width <= 2000, "--width", arguments.width, "be from 50 to 2000")
    name = "watch_untrained.gif" if arguments.untrained else "watch.gif"
    out: Path = arguments.out or arguments.folder / name
    _require(out.suffix == ".gif", "--out", str(out), "end in .gif")
    _require_playable(arguments)
    from mace_rl.runs import watch

    film = watch.film(
        arguments.folder,
        arguments.episodes,
        arguments.seed,
        deterministic=arguments.deterministic,
        untrained=arguments.untrained,
        width=arguments.width,
        seconds=arguments.seconds,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    files.write_atomically(out, watch.gif(film))
    returns = ", ".join(f"{value:.2f}" for value in film.returns)
    logger.info("return %s: %s", returns, out)


def tensorboard(arguments: argparse.Namespace) -> None:
    """`mace-rl tensorboard`."""
    from mace_rl.runs import events

    out = arguments.out or arguments.folder
    count = events.write_all(arguments.folder, out)
    logger.info("runs: %d; look at them with: tensorboard --logdir %s", count, out)


def verify(arguments: argparse.Namespace) -> None:
    """`mace-rl verify`."""
    sample, seed = arguments.sample, arguments.sample_seed
    _require(sample is None or sample >= 1, "--sample", sample, "be at least 1")
    _require(seed >= 0, "--sample-seed", seed, "be at least 0")
    from mace_rl.runs import verify

    confidence = read_study([CONFIG]).metrics.confidence
    for line in verify.verify(arguments.folder, sample, seed, confidence):
        print(line, flush=True)


def main() -> None:
    """Entry point; exits with 1 and one line on standard error for what cannot be done."""
    arguments = parser().parse_args()
    commands = {
        "train": train,
        "evaluate": evaluate,
        "watch": watch,
        "tensorboard": tensorboard,
        "verify": verify,
    }
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        commands[arguments.command](arguments)
    except (Refusal, OSError) as error:
        sys.exit(f"mace-rl: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        resumes = arguments.command == "train"
        logger.info("interrupted%s", "; the same command resumes it" if resumes else "")
        sys.exit(130)


if __name__ == "__main__":
    main()
