"""Training from a program: `settings` of a run, and `train`.

run = settings("CartPole-v1", "mace_full", seed=3, episodes=200, ppo={"clip": 0.1})
agent, episodes = train(run, lambda episode: print(episode.extrinsic_return))
action = agent.policy([0.0, 0.1, 0.0, -0.1]).sample()
"""

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from mace_rl.config.reading import DEFAULTS
from mace_rl.config.run import RunConfig
from mace_rl.config.section import ConfigError, short_repr
from mace_rl.run_settings import read_settings
from mace_rl.runs.finished import FinishedRun, finished
from mace_rl.training.records import EpisodeRecord

if TYPE_CHECKING:
    from mace_rl.runs.agent import Agent


class Trained(NamedTuple):
    """The result of `train`."""

    agent: "Agent"  # as `load_agent` gives it
    episodes: list[EpisodeRecord]


def settings(
    environment: str,
    variant: str = "mace_full",
    *,
    seed: int = 0,
    config: str | Path | Iterable[str | Path] = (),
    **changes: Any,
) -> RunConfig:
    """The settings of one run: the defaults, `config` read over them, then `changes`.

    environment: any id of Gymnasium's; "module:Id" imports the module first.
    variant: what sets β: "ppo" (no bonus), "mace_fixed", "mace_full", or one of `config`.
    config: YAML files like config.yaml. They may have further variants.
    changes: any field of `RunConfig`, such as episodes=200, max_episode_steps=100 or
        beta={"kind": "constant", "value": 0.2}. Sections merge, as in ppo={"clip": 0.1}. One that
        the variant does not use is checked and left out: the same changes fit all variants.

    Raises `ConfigError`, one line, for wrong settings.
    """
    for name, value in {"environment": environment, "variant": variant}.items():
        if not isinstance(value, str):
            raise ConfigError(f"{name} is {short_repr(value)}, but should be a name")
    over = [config] if isinstance(config, str | Path) else config
    known = read_settings([DEFAULTS, *map(Path, over)])
    try:
        return known.run_config(environment, variant, seed, changes)
    except ConfigError as error:
        if variant in known.variant_settings:
            raise
        raise ConfigError(
            f"{error}; variants of further studies need --config FILE, or config=FILE"
        ) from None


def train(
    settings: RunConfig,
    callback: Callable[[EpisodeRecord], object] | None = None,
    folder: str | Path | None = None,
    restart: bool = False,
) -> Trained:
    """Train to the last episode, in this process and on one thread.

    settings: from the function of that name.
    callback: is called with each episode after the update on it.
    folder: keeps the run, as `mace-rl train --out` does. The same call resumes an interrupted run,
        without calling back for its episodes again, goes on from the last checkpoint of a finished
        one of fewer episodes, and only reads one that is finished.
    restart: move a run that is in `folder` into a folder below it, and train from the start.

    Raises `ConfigError` if `folder` has the results of another run, `RunError` if it has another
    unfinished run or other files, and `NonFiniteError` as soon as a number is NaN or infinite.
    """
    from mace_rl.runs.agent import load_agent  # torch takes seconds
    from mace_rl.runs.run import run

    if folder is not None and not str(folder):
        raise ConfigError("folder is empty, but should be a path, or None to keep nothing")
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch if folder is None else folder).absolute()
        aside: Literal["nothing", "all"] = "all" if restart else "nothing"
        if restart or not finished(settings, directory):
            run(settings, directory, None, folder is not None, callback, aside)
        return Trained(load_agent(directory, trust=True), FinishedRun(directory).rows)
