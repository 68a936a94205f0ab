"""What several test files share: configurations of runs, environments for a test."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# As in training, here and in the processes that tests start; numpy and torch read it once.
os.environ["OMP_NUM_THREADS"] = "1"

import mace_rl  # noqa: F401  isort: skip  (arithmetic is chosen before NumPy is imported)

import gymnasium
import pytest

from mace_rl.config.reading import merge_layers
from mace_rl.config.run import RunConfig
from mace_rl.config.section import check
from mace_rl.config.study import Study, read_study

CONFIG = Path(__file__).parents[1] / "config.yaml"

# Where the tests run in the background SIGINT is ignored, and would be in what they start, too.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def study() -> Study:
    """The paper's study, as `config.yaml` has it."""
    return read_study([CONFIG])


@pytest.fixture(scope="session")
def run_config(study: Study) -> Callable[..., RunConfig]:
    """`run_config(environment, variant, seed, **changes)`: the study's settings, some changed.

    Sections merge: `ppo={"epochs": 1}` leaves the rest of that section as it is.
    """

    def make(
        environment: str = "CartPole-v1", variant: str = "ppo", seed: int = 0, **changes: Any
    ) -> RunConfig:
        settings = study.run_config(environment, variant, seed).settings()
        return check(RunConfig, merge_layers(settings, changes), "the test")

    return make


@pytest.fixture
def register() -> Iterator[Callable[..., str]]:
    """`register(name, entry_point, max_episode_steps, **kwargs)`: an environment for one test."""
    before = dict(gymnasium.registry)

    def make(name: str, entry_point: Any, max_episode_steps: int | None = 10, **kwargs: Any) -> str:
        gymnasium.registry.pop(name, None)
        gymnasium.register(
            name, entry_point=entry_point, max_episode_steps=max_episode_steps, kwargs=kwargs
        )
        return name

    yield make
    gymnasium.registry.clear()
    gymnasium.registry.update(before)
