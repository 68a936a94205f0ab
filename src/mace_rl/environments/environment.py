"""Making environments: Gymnasium's registry, generators that resume."""

import copy
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from mace_rl.base.errors import in_one_line, raised_in
from mace_rl.base.stdio import keep_open
from mace_rl.config.plugins import import_module, make
from mace_rl.config.section import ConfigError, short_repr
from mace_rl.environments import spec_of
from mace_rl.environments.remembered import OWN, fractions, hold_still, remembered, restore
from mace_rl.environments.spaces import Spaces

LOST = "lost"  # a key of `Environment.memory`

# Faster classes that behave the same to the bit.
FASTER = {"HopperBulletEnv-v0": "mace_rl.environments.hopper:FastHopperBulletEnv"}
# Where what a step returned is taken apart.
UNPACKS = (__name__, "gymnasium.core", "gymnasium.wrappers")
UNLIMITED = 10**5  # steps of an episode that has no time limit, and should end by itself
MOST_STEPS = 10**6  # of an episode; its noise is drawn before it ...
MOST_NOISE = 10**8  # ... with so many numbers at most


@contextmanager
def nothing_printed() -> Iterator[None]:
    """Hide what pybullet prints, from C, when it is loaded and connected."""
    for descriptor, stream in enumerate((sys.stdout, sys.stderr), 1):
        keep_open(descriptor)
        with suppress(AttributeError, OSError):  # it is None, or its reader is gone
            stream.flush()
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


@contextmanager
def trying_out(what: str) -> Iterator[None]:
    """Print nothing, and turn any error of an environment into a `ConfigError`, one line."""
    try:
        with nothing_printed():
            yield
    except ConfigError:
        raise
    except (ModuleNotFoundError, gymnasium.error.DependencyNotInstalled) as error:
        reason = f"{what} needs a package that should be installed: {error}"
        raise ConfigError(" ".join(reason.split())) from None
    except (Exception, SystemExit) as error:
        raise ConfigError(f"{what}: {in_one_line(error)}") from error


class Environment(Spaces):
    """A Gymnasium environment with its observation size, time limit and random generator.

    `name` may be "package.module:Id", as in Gymnasium. Raises `ConfigError` for an unknown id, an
    error in making or resetting it, and unsupported spaces.
    """

    env: gymnasium.Env[Any, Any]
    fresh: dict[str, bytes]  # the `fractions` of its wrappers at first

    def __init__(
        self,
        name: str,
        seed: np.random.SeedSequence,
        max_episode_steps: int | None = None,
        arguments: Mapping[str, Any] | None = None,
        wrappers: Sequence[tuple[str, Mapping[str, Any]]] = (),
    ) -> None:
        """wrappers: around the environment, the innermost first, "module:Class" and arguments."""
        if ":" in name:
            import_module(name, "environment")
        spec_of(name)  # imports the package that registers it
        try:
            spec = copy.deepcopy(gymnasium.spec(name.rpartition(":")[2]))
        except gymnasium.error.Error as error:
            raise ConfigError(f"environment {name!r}: {error}") from None
        spec.entry_point = FASTER.get(name, spec.entry_point)
        spec.max_episode_steps = max_episode_steps or spec.max_episode_steps
        self.ends_by_itself = spec.max_episode_steps is None
        self.max_steps: int = spec.max_episode_steps or UNLIMITED
        if not 1 <= self.max_steps <= MOST_STEPS:
            raise ConfigError(
                f"environment {name!r} has a time limit of {self.max_steps} (max_episode_steps), "
                f"but whole episodes are kept; set one of 1 to {MOST_STEPS} steps"
            )
        self.wrapped = bool(wrappers)  # by more than Gymnasium's own
        with trying_out(f"environment {name!r}{f' with {arguments}' if arguments else ''}"):
            self.env = gymnasium.make(spec, disable_env_checker=True, **(arguments or {}))
            for place, (reference, own) in enumerate(wrappers):
                key = f"environment_wrappers.{place}"
                self.env = make(reference, key, gymnasium.Wrapper, False, self.env, **own)
            spaces = self.env.observation_space, self.env.action_space
        super().__init__(name, *spaces)
        if isinstance(self.action_space, Box) and self.action_space.dtype.kind != "f":
            raise ConfigError(
                f"environment {name!r} has actions {self.action_space} of integers, but a Gaussian "
                "policy gives fractions; make them Discrete, or a Box of floats"
            )
        width = self.actions.width if not self.actions.discrete else 1
        if self.max_steps * width > MOST_NOISE:
            raise ConfigError(
                f"environment {name!r} has {width} numbers in an action, and its "
                f"time limit is {self.max_steps}, not up to {MOST_NOISE // width}"
            )
        # A Bullet environment's first reset is unlike later ones: it averages over one part fewer.
        with trying_out(f"environment {name!r}"):
            given: Any = self.env.reset(seed=int(seed.generate_state(1)[0]))
            if not (isinstance(given, tuple) and len(given) == 2):
                raise TypeError(f"reset gave {short_repr(given)}, not (observation, info)")
            if not isinstance(kept := self.env.unwrapped.np_random, np.random.Generator):
                raise TypeError(f"np_random is a {type(kept).__name__}, not a Generator of NumPy's")

        self.fresh = fractions(self.env)

    def memory(self) -> dict[str, Any]:
        """What it has learned, to play on with: `remembered`, and the name of what cannot be."""
        now = fractions(self.env)
        lost = [key.split()[1] for key in now if now[key] != self.fresh.get(key)]
        found = remembered(self.env)
        if not self.wrapped and type(self.env.unwrapped).__module__.startswith("mace_rl."):
            found.pop(OWN, None)  # ours learn nothing: it is which episode comes next
        return found | ({LOST: lost[0]} if lost else {})

    def recall(self, memory: dict[str, Any]) -> None:
        """Play on with what `memory` returned of a training, and learn no more."""
        restore(self.env, memory)
        hold_still(self.env)

    def reset(self) -> Any:
        """The first observation of an episode."""
        try:
            return self.env.reset()[0]
        except Exception as error:
            error.add_note(f"in a reset of {self.name}")
            raise

    def step(self, action: Any, number: int) -> tuple[Any, float, bool, bool]:
        """Observation, reward and flags, checked; `action` is the `number`th of an episode."""
        observation, reward, terminated, truncated, _ = stepped(self.env, action, self.name, number)
        terminated = bool(self.number("terminated", terminated, number))
        truncated = bool(self.number("truncated", truncated, number))
        return observation, self.checked_reward(reward, number), terminated, truncated

    @property
    def generator(self) -> np.random.Generator:
        return self.env.unwrapped.np_random


def stepped(env: Any, action: Any, name: str, number: int) -> tuple[Any, Any, Any, Any, Any]:
    """The five parts of an environment's step, the `number`th of an episode; else `ConfigError`."""
    try:
        observation, reward, terminated, truncated, info = env.step(action)
    except Exception as error:
        frame, _ = raised_in(error)
        if "unpack" in str(error) and frame.f_globals["__name__"].startswith(UNPACKS):
            raise ConfigError(
                f"environment {name!r}, step {number}: not (observation, reward, "
                f"terminated, truncated, info): {error}"
            ) from error
        error.add_note(f"in step {number} of an episode of {name}")
        raise
    return observation, reward, terminated, truncated, info
