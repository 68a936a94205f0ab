"""Fixtures of several test files: configurations, environments for a test, interrupted runs.

What takes seconds to import (torch, numba) is imported where it is used.
"""

import itertools
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

# As in training, here and in the processes that tests start; numpy and torch read it once.
os.environ["OMP_NUM_THREADS"] = "1"

import mace_rl.base.cpu_features  # noqa: F401  isort: skip  (pins NumPy before it is imported)

import gymnasium
import pytest

from mace_rl.config.run import RunConfig
from mace_rl.environments import registered
from mace_study.config.study import Study, read_study

CONFIG = Path(__file__).parents[1] / "config.yaml"

# Where the tests run in the background SIGINT is ignored, and would be in what they start, too.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """What shares a finished study stays in one process: pytest-xdist's own marks do nothing."""
    from xdist.scheduler import LoadScopeScheduling

    class ByStudy(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return file if Path(file).name == "test_workflow.py" else nodeid

    return ByStudy(config, log)


@pytest.fixture(scope="session")
def study() -> Study:
    """The paper's study, as `config.yaml` has it."""
    return read_study([CONFIG])


@pytest.fixture(scope="session")
def run_config(study: Study) -> Callable[..., RunConfig]:
    """`run_config(environment, variant, seed, **changes)`: the study's settings, some changed.

    Sections merge: `ppo={"epochs": 1}` leaves the rest of that section as it is.
    """

    def make(environment="CartPole-v1", variant="ppo", seed=0, **changes: Any) -> RunConfig:
        return study.run_config(environment, variant, seed, changes)

    return make


@pytest.fixture(scope="session")
def trained(run_config, tmp_path_factory) -> Callable[..., Path]:
    """`trained(environment, variant, seed, **changes)`: the folder of a finished run.

    Each is made once and shared: copy it before changing anything in it.
    """
    from mace_rl.runs import run

    folder, made = tmp_path_factory.mktemp("trained"), {}

    def make(*names: Any, **changes: Any) -> Path:
        config = run_config(*names, **changes)
        key = config.model_dump_json()
        if key not in made:
            made[key] = folder / str(len(made)) / config.environment / config.variant
            run.run(config, made[key])
        return made[key]

    return make


@pytest.fixture
def make_ppo(run_config):
    """`make_ppo(environment, seed, intrinsic, engine, **settings of ppo)`."""
    from shared import environment_of

    from mace_rl.base.rng import Streams
    from mace_rl.training import factories

    def make(environment="CartPole-v1", seed=0, intrinsic=False, engine="compiled", **settings):
        config = run_config(environment, "ppo", seed, ppo=settings, engine=engine)
        return factories.ppo(config, environment_of(environment, seed), intrinsic, Streams(seed))

    return make


@pytest.fixture
def register() -> Iterator[Callable[..., str]]:
    """`register(name, entry_point, max_episode_steps, **kwargs)`: an environment for one test."""
    before = dict(registered())  # with Bullet's, which are registered once in a process

    def make(name: str, entry_point: Any, max_episode_steps: int | None = 10, **kwargs: Any) -> str:
        gymnasium.registry.pop(name, None)
        gymnasium.register(
            name, entry_point=entry_point, max_episode_steps=max_episode_steps, kwargs=kwargs
        )
        return name

    yield make
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


@pytest.fixture
def kill(monkeypatch):
    """`kill(update, config, directory)`: carry out a run that dies in this update."""
    from shared import Killed

    from mace_rl.runs import run
    from mace_rl.training.trainer import Trainer

    update = Trainer.ppo_update

    def start(number: int, config: RunConfig, directory: Path) -> None:
        def update_or_die(self, rollout):
            if len(self.diagnostics) == number - 1:
                raise Killed
            return update(self, rollout)

        with monkeypatch.context() as patched:
            patched.setattr(Trainer, "ppo_update", update_or_die)
            with pytest.raises(Killed):
                run.run(config, directory)

    return start


@pytest.fixture
def checkpoint_every(monkeypatch):
    """`checkpoint_every(n)`: a checkpoint after every n-th round instead of by time."""
    from mace_rl.runs import run

    def arrange(rounds: int) -> None:
        asked = itertools.count(1)
        monkeypatch.setattr(run.Clock, "checkpoint_due", lambda self: next(asked) % rounds == 0)

    return arrange


@pytest.fixture
def completes(tmp_path):
    """`completes(config, directory)`: carry it to its end, which is that of a run never disturbed.

    Bytes are compared of all that must not depend on interruptions. Returns what run.json tells.
    """
    from shared import OUTCOME, RESULTS, files, provenance_of

    from mace_rl.runs import run

    def carry_on(config: RunConfig, directory: Path) -> dict:
        outcomes = []
        for folder in (directory, tmp_path / "whole"):
            run.run(config, folder)
            assert files(folder) == RESULTS
            outcomes.append([(folder / name).read_bytes() for name in OUTCOME])
        assert outcomes[0] == outcomes[1]
        return provenance_of(directory)

    return carry_on


@pytest.fixture
def interrupted(run_config, tmp_path, kill, checkpoint_every, monkeypatch):
    """A run of CartPole-v1, killed after a checkpoint: its configuration and folder."""
    from mace_rl.runs import run

    monkeypatch.setattr(run, "PROGRESS_SECONDS", 1e9)  # told once, after the first episode
    config = run_config("CartPole-v1", "mace_full", 0, episodes=6)
    checkpoint_every(1)
    kill(5, config, tmp_path / "run")
    return SimpleNamespace(config=config, directory=tmp_path / "run")
