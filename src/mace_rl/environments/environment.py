"""Provenance environments: Gymnasium's registry, generators that resume."""

import copy
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Dict, Tuple
from gymnasium.wrappers import FlattenObservation

from mace_rl.config.plugins import import_module
from mace_rl.config.section import ConfigError
from mace_rl.environments import registered
from mace_rl.environments.spaces import Spaces

# Environments for which we have a faster class that behaves the same to the bit.
FASTER = {"HopperBulletEnv-v0": "mace_rl.environments.hopper:FastHopperBulletEnv"}


@contextmanager
def nothing_printed() -> Iterator[None]:
    """Keep off the terminal what pybullet prints, from C, when it is loaded and connected."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(descriptor, os.dup(descriptor)) for descriptor in (1, 2)]
    with open(os.devnull, "w") as nowhere:
        for descriptor, _ in kept:
            os.dup2(nowhere.fileno(), descriptor)
    try:
        yield
    finally:
        for descriptor, copy_ in kept:
            os.dup2(copy_, descriptor)
            os.close(copy_)


class Environment(Spaces):
    """A Gymnasium environment with its observation size, time limit and random generator.

    `name` may be "package.module:Id", as in Gymnasium. Raises `ConfigError` for an unknown id,
    arguments it does not take, a missing time limit and unsupported spaces.
    """

    def __init__(
        self,
        name: str,
        seed: np.random.SeedSequence,
        max_episode_steps: int | None = None,
        arguments: Mapping[str, Any] | None = None,
    ) -> None:
        if ":" in name:
            import_module(name, "environment")
        registered()
        try:
            spec = copy.deepcopy(gymnasium.spec(name.rpartition(":")[2]))
        except gymnasium.error.Error as error:
            raise ConfigError(f"environment {name!r}: {error}") from None
        spec.entry_point = FASTER.get(name, spec.entry_point)
        spec.max_episode_steps = max_episode_steps or spec.max_episode_steps
        if spec.max_episode_steps is None:
            raise ConfigError(
                f"environment {name!r} has no time limit (max_episode_steps), so its episodes "
                "need not end; set one"
            )
        self.max_steps: int = spec.max_episode_steps
        with nothing_printed():
            try:
                self.env = gymnasium.make(spec, disable_env_checker=True, **(arguments or {}))
            except (TypeError, ValueError, LookupError, AssertionError) as error:
                if not arguments:  # a mistake of its own, whose place the traceback tells
                    raise
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                raise ConfigError(f"environment {name!r} with {arguments}: {reason}") from None
            except (ModuleNotFoundError, gymnasium.error.DependencyNotInstalled) as error:
                reason = " ".join(str(error).split())
                raise ConfigError(
                    f"environment {name!r} needs a package that should be installed: {reason}"
                ) from None
        self.given_space = self.env.observation_space  # that of what it gives, before `encode`
        if isinstance(self.env.observation_space, Tuple | Dict):
            self.env = FlattenObservation(self.env)
        super().__init__(name, self.env.observation_space, self.env.action_space)
        # A Bullet environment's first reset averages the robot's position over one part fewer than
        # later ones, which makes the first reward unlike any other. A throw-away reset lets a fresh
        # environment with the same generator state replay an aged one to the bit.
        with nothing_printed():
            self.env.reset(seed=int(seed.generate_state(1)[0]))

    @property
    def generator(self) -> np.random.Generator:
        """The environment's own generator."""
        return self.env.unwrapped.np_random
