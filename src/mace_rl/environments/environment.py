"""Making environments: Gymnasium's registry, observations as vectors, generators that resume."""

import copy
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0 and its siblings)
from gymnasium.spaces import Box, Discrete

from mace_rl.config.plugins import import_module
from mace_rl.config.section import ConfigError

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


class Environment:
    """A Gymnasium environment with its observation size, time limit and random generator.

    Observations are flat float32 vectors; a Discrete observation becomes a one-hot vector.
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
        self.name = name
        self.max_steps: int = spec.max_episode_steps
        with nothing_printed():
            try:
                self.env = gymnasium.make(spec, disable_env_checker=True, **(arguments or {}))
            except (TypeError, ValueError, LookupError, AssertionError) as error:
                if not arguments:  # a mistake of its own, whose place the traceback tells
                    raise
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                raise ConfigError(f"environment {name!r} with {arguments}: {reason}") from None
        observations, actions = self.env.observation_space, self.env.action_space
        if not isinstance(observations, Box | Discrete) or _is_image(observations):
            raise ConfigError(
                f"environment {name!r} has {_kind(observations)} observations, {observations}; "
                "Box (vectors) and Discrete ones work"
            )
        if not (
            isinstance(actions, Discrete) or (isinstance(actions, Box) and actions.shape[1:] == ())
        ):
            raise ConfigError(
                f"environment {name!r} has actions {actions}; Discrete and one-dimensional Box work"
            )
        self.observation_space, self.action_space = observations, actions
        self.discrete_observations = isinstance(observations, Discrete)
        self.observation_size = (
            int(observations.n)
            if isinstance(observations, Discrete)
            else int(np.prod(observations.shape))
        )
        # A Bullet environment's first reset averages the robot's position over one part fewer than
        # later ones, which makes the first reward unlike any other. A throw-away reset lets a fresh
        # environment with the same generator state replay an aged one to the bit.
        with nothing_printed():
            self.env.reset(seed=int(seed.generate_state(1)[0]))

    def encode(self, observation: Any) -> np.ndarray:
        """`observation` as a float32 vector, [observation_size]; may be the same memory."""
        if isinstance(self.observation_space, Discrete):
            vector = np.zeros(self.observation_size, np.float32)
            vector[int(observation) - int(self.observation_space.start)] = 1.0
            return vector
        return np.asarray(observation, np.float32).ravel()

    @property
    def generator(self) -> np.random.Generator:
        """The environment's own generator."""
        return self.env.unwrapped.np_random


def _is_image(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and len(space.shape) >= 2 and space.dtype == np.uint8


def _kind(space: gymnasium.Space[Any]) -> str:
    """What a space that does not work is called."""
    return "image" if _is_image(space) else type(space).__name__.lower()
