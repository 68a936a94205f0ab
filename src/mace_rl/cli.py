"""The command `mace-rl`: train one run, evaluate or film its agent, export records, repeat runs."""

import mace_rl.base.cpu_features  # noqa: F401  isort: skip  (before NumPy: equal bits on every processor)

import argparse
import logging
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mace_rl.base import files, stdio
from mace_rl.base.errors import Refusal
from mace_rl.config.plugins import call_of
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError, short_repr
from mace_rl.library import settings
from mace_rl.runs.finished import FinishedRun, finished

logger = logging.getLogger(__name__)


def path(text: str) -> Path:
    """A path; of a shell's variable that is not set it would be the folder one is in."""
    if not text:
        raise argparse.ArgumentTypeError("it is empty")
    return Path(text)


def parser() -> argparse.ArgumentParser:
    """The command line of `mace-rl`."""
    plain: dict[str, Any] = {"allow_abbrev": False}
    epilog = "example: mace-rl train --help"
    top = argparse.ArgumentParser(prog="mace-rl", description=__doc__, epilog=epilog, **plain)
    commands = top.add_subparsers(dest="command", required=True)

    def command(
        name: str, run: Callable[..., None], does: str, example: str, folder: str = ""
    ) -> Callable[..., Any]:
        epilog = f"example: mace-rl {name} {example}"
        added = commands.add_parser(name, help=does, description=does, epilog=epilog, **plain)
        added.set_defaults(run=run)
        if folder:
            added.add_argument("folder", type=path, help=folder)
        return added.add_argument

    flag = {"action": "store_true"}
    trust = {**flag, "help": "import code that run.json names"}
    below = "of a run, or with runs below it"
    does = "carry out one training run; the same command resumes it if interrupted"
    run = "--env CartPole-v1 --variant mace_full --seed 0 --episodes 100 --out cartpole_run"
    add = command("train", train, does, run)
    which = "a Gymnasium id, [module:][Namespace/]Id, or 'Id(key=literal, ...)' with arguments"
    add("--env", required=True, help=which)
    add("--variant", required=True, help="one of the config's variant_settings")
    add("--seed", default=0, type=int, help="(default: 0)")
    more = "instead of the config's budget; above that of a finished run, it goes on"
    add("--episodes", type=int, help=more)
    add("--max-episode-steps", type=int, help="instead of the environment's own time limit")
    several = {"nargs": "+", "action": "extend", "default": [], "metavar": "FILE"}
    over = "YAML files read over the default settings, one after the other"
    add("--config", type=path, **several, help=over)
    around = "a wrapper around the environment, module:Class or 'module:Class(key=literal, ...)'"
    around += "; several: the innermost first"
    add("--wrapper", action="append", metavar="NAME", help=around)
    slower = "of policy and critics: compiled (default) or plain PyTorch, slower, to check it by"
    add("--engine", choices=["compiled", "torch"], help=slower)
    add("--out", type=path, help="folder for the results (default: runs/ENV/VARIANT/seedN)")
    anew = "move a run that is in the folder into a folder below it, and train from the start"
    add("--restart", **flag, help=anew)
    does = "print how far runs are, and about when they will be done"
    where = "a workflow's results folder, or any with runs in or below it"
    command("status", status, does, "results/reduced", folder=where)
    play = "play episodes with a trained agent and print its returns"
    film = "write an animated GIF of the first episodes that evaluate plays"
    for name, function, does, example, episodes in (
        ("evaluate", evaluate, play, "cartpole_run --episodes 20 --deterministic", 100),
        ("watch", watch, film, "cartpole_run --out cartpole.gif", 1),
    ):
        add = command(name, function, does, example, folder="of a finished run")
        add("--episodes", type=int, default=episodes, help=f"how many (default: {episodes})")
        add("--seed", type=int, default=0, help="of the episodes (default: 0)")
        most = "take the most probable action, or the mean, instead of a sample"
        add("--deterministic", **flag, help=most)
        add("--trust", **trust)
    add("--untrained", **flag, help="film the agent as it was before training")
    add("--seconds", type=float, default=10.0, help="of each episode at most (default: 10)")
    add("--width", type=int, default=300, help="in pixels (default: 300)")
    out = "a GIF file (default: watch.gif or watch_untrained.gif in the folder)"
    add("--out", type=path, help=out)
    does = "write what runs recorded, finished or not, as event files for TensorBoard"
    add = command("tensorboard", tensorboard, does, "cartpole_run --out events", below)
    add("--out", type=path, help="folder for the event files (default: beside the records)")
    does = (
        "write the episodes of finished runs as one table: task, algorithm, seed, step, return ..."
    )
    add = command("export", export, does, "cartpole_run --out runs.csv", below)
    add("--out", type=path, required=True, help="a file that ends in .csv or .parquet")
    does = "repeat kept runs and compare to the bit"
    add = command("verify", verify, does, "reference --sample 1", below)
    add("--sample", type=int, help="how many, always the same ones (default: all)")
    add("--trust", **trust)
    return top


def _require(fits: bool, option: str, value: object, right: str) -> None:
    if not fits:
        raise ConfigError(f"{option} is {value!r}, but should {right}")


def _require_at_least(smallest: int, arguments: argparse.Namespace, *names: str) -> None:
    for name in names:
        option, value = f"--{name.replace('_', '-')}", getattr(arguments, name)
        _require(value is None or value >= smallest, option, value, f"be at least {smallest}")


def _require_playable(arguments: argparse.Namespace) -> None:
    _require_at_least(1, arguments, "episodes")
    seed = arguments.seed
    _require(0 <= seed < 2**32, "--seed", seed, "be from 0 to 4294967295")
    # Before PyTorch, which takes seconds.
    _ = FinishedRun(arguments.folder, arguments.trust).agent_config


def run_config(arguments: argparse.Namespace) -> RunConfig:
    """The run that the command line asks for; raises `ConfigError`."""
    _require_at_least(1, arguments, "episodes", "max_episode_steps")
    changes = {key: getattr(arguments, key) for key in ("episodes", "max_episode_steps", "engine")}
    changes["environment_wrappers"] = arguments.wrapper
    changes = {key: value for key, value in changes.items() if value is not None}
    changes |= {"seed": arguments.seed, "config": arguments.config}
    try:
        name, own = call_of(arguments.env)
    except ValueError as error:
        raise ConfigError(f"--env is {short_repr(arguments.env)}, but {error}") from None
    changes |= {"environment_arguments": own} if own else {}
    return settings(name, arguments.variant, **changes)


def train(arguments: argparse.Namespace) -> None:
    config = run_config(arguments)
    default = Path(
        "runs", files.folder_of(config.environment), config.variant, f"seed{config.seed}"
    )
    out: Path = arguments.out or default
    if not arguments.restart and finished(config, out):
        logger.info("%s holds this run already, finished", out)
        return
    from mace_rl.runs import progress, run  # PyTorch takes seconds, a mistake should not

    with progress.line(sys.stderr) as observe:
        run.run(config, out, observe, True, aside="all" if arguments.restart else "nothing")
    logger.info("finished: %s", out / files.EPISODES)


def status(arguments: argparse.Namespace) -> None:
    from mace_rl.runs import progress

    for line in progress.status(arguments.folder):
        print(line)


def evaluate(arguments: argparse.Namespace) -> None:
    _require_playable(arguments)
    from mace_rl.runs import evaluate

    names = ("episodes", "seed", "deterministic", "trust")
    returns = evaluate.evaluate(
        arguments.folder, **{name: getattr(arguments, name) for name in names}
    )
    print(
        f"{len(returns)} episodes: mean return {returns.mean():.2f}, standard deviation "
        f"{returns.std():.2f}, from {returns.min():.2f} to {returns.max():.2f}"
    )


def watch(arguments: argparse.Namespace) -> None:
    _require(arguments.seconds > 0, "--seconds", arguments.seconds, "be greater than 0")
    _require(50 <= arguments.width <= 2000, "--width", arguments.width, "be from 50 to 2000")
    name = "watch_untrained.gif" if arguments.untrained else "watch.gif"
    out: Path = (arguments.out or arguments.folder / name).absolute()
    _require(out.suffix == ".gif", "--out", str(arguments.out), "end in .gif")
    files.require_ours(out, b"GIF8")
    _require_playable(arguments)
    from mace_rl.runs import watch

    names = ("episodes", "seed", "deterministic", "untrained", "trust", "width", "seconds")
    film = watch.film(arguments.folder, **{name: getattr(arguments, name) for name in names})
    out.parent.mkdir(parents=True, exist_ok=True)
    files.write_atomically(out, watch.gif(film))
    returns = ", ".join(f"{value:.2f}" for value in film.returns)
    logger.info("return %s: %s", returns, out)


def tensorboard(arguments: argparse.Namespace) -> None:
    from mace_rl.runs import events

    out = arguments.out or arguments.folder
    count = events.write_all(arguments.folder, out)
    logger.info("runs: %d; look at them with: tensorboard --logdir %s", count, out)


def export(arguments: argparse.Namespace) -> None:
    out: Path = arguments.out
    _require(out.suffix in (".csv", ".parquet"), "--out", str(out), "end in .csv or .parquet")
    from mace_rl.runs import export

    table = export.columns(arguments.folder)
    export.write(table, out)
    logger.info("%d episodes: %s", len(table["task"]), out)


def verify(arguments: argparse.Namespace) -> None:
    _require_at_least(1, arguments, "sample")
    from mace_rl.runs import verify

    for line in verify.verify(arguments.folder, arguments.sample, arguments.trust):
        print(line, flush=True)


def in_a_file(error: Exception) -> str:
    """An error of somebody else's code in a line, and where its traceback is."""
    with tempfile.NamedTemporaryFile("w", prefix="mace-rl-", suffix=".txt", delete=False) as file:
        file.writelines(traceback.format_exception(error))
    said = " ".join(f"{type(error).__name__}: {error}".split())
    return f"{said} (traceback: {file.name})"


def main() -> None:
    """Entry point; exits with 1 and one line on standard error for what cannot be done."""
    stdio.secure()
    arguments = parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        arguments.run(arguments)
    except Exception as error:
        if not isinstance(error, Refusal) and (where := getattr(error, "__notes__", ())):
            sys.exit(f"mace-rl: {', '.join(reversed(where))}: {in_a_file(error)}")
        if isinstance(error, ModuleNotFoundError):
            extra = "tensorboard" if arguments.command == "tensorboard" else "study"
            sys.exit(f"mace-rl: {error}; mace-rl's extra [{extra}] has it")
        if not isinstance(error, Refusal | OSError | MemoryError):
            raise
        bare = "out of memory" if isinstance(error, MemoryError) else repr(error)
        sys.exit(f"mace-rl: {' '.join(str(error).split()) or bare}")
    except SystemExit as error:  # a module of the user's own, where it is imported or made
        sys.exit(f"mace-rl: code of the environment or of a plugin ended the program: {error!r}")
    except KeyboardInterrupt:
        resumes = "; the same command resumes it" if arguments.command == "train" else ""
        without = ", without --restart" if getattr(arguments, "restart", False) else ""
        logger.info("interrupted%s%s", resumes, without)
        sys.exit(130)
    buffer = getattr(sys.stdout, "buffer", None)
    unseen = getattr(getattr(buffer, "raw", None), "error", None)
    if unseen and arguments.command != "train":  # which shows nothing but how far it is
        sys.exit(f"mace-rl: standard output: {unseen.strerror}")
