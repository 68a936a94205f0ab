"""Actions as policies choose them, and as environments get them."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from mace_rl.config.section import ConfigError

# From 0; int64 [parts], from 0; or float32 [actions] before clipping to the bounds.
Action = int | np.ndarray


class Actions:
    """What a policy needs to know of an action space; raises `ConfigError` for one of no such kind.

    Chosen are an int from 0 for Discrete ones, int64 [parts] from 0 for MultiDiscrete and
    MultiBinary ones, and float32 [outputs] for Box ones, whatever their shape.
    """

    def __init__(self, name: str, space: gymnasium.Space[Any]) -> None:
        """name: of the environment, for messages."""
        self.space = space
        self.discrete, self.continuous = isinstance(space, Discrete), isinstance(space, Box)
        self.parts = np.empty(0, np.int64)  # choices in each part, where there are several
        match space:
            case Discrete():
                self.outputs = int(space.n)  # of the policy's network
            case MultiDiscrete():
                self.parts = np.array(space.nvec, np.int64).ravel()
            case MultiBinary():
                self.parts = np.full(int(np.prod(space.shape)), 2, np.int64)
            case Box():
                self.outputs = int(np.prod(space.shape))
            case _:
                raise ConfigError(
                    f"environment {name!r} has actions {space}; Discrete, MultiDiscrete, "
                    "MultiBinary and Box work, of which a gymnasium.ActionWrapper of yours makes "
                    "others"
                )
        if len(self.parts):
            self.outputs = int(self.parts.sum())
        self.width = len(self.parts) or self.outputs  # numbers in one, as a row to read

    def noise(self, steps: int, generator: np.random.Generator) -> np.ndarray:
        """Random numbers that make so many network outputs actions.

        Uniform, [steps] or [steps, parts]; for Box actions standard normal, [steps, outputs].
        """
        if self.continuous:
            return generator.standard_normal((steps, self.outputs))
        return generator.random((steps, len(self.parts)) if len(self.parts) else steps)

    def given(self, action: Action, clips: bool) -> Any:
        """A new value of the space; clips: Box ones to their bounds."""
        space: Any = self.space
        if self.discrete:
            return action + int(space.start)
        assert isinstance(action, np.ndarray)
        if isinstance(space, MultiDiscrete):
            return (action.reshape(space.shape) + space.start).astype(space.dtype)
        if self.continuous:
            action = action.reshape(space.shape)
            given = action.clip(space.low, space.high) if clips else action.copy()
            same = given.dtype == space.dtype or np.can_cast(given.dtype, space.dtype)
            return given if same else given.astype(space.dtype)
        return action.reshape(space.shape).astype(space.dtype)

    def chosen(self, given: Any) -> Action:
        """The other way: what a policy would have chosen; a copy."""
        space: Any = self.space
        if self.discrete:
            return int(given) - int(space.start)
        start = space.start if isinstance(space, MultiDiscrete) else 0
        kind = np.float32 if self.continuous else np.int64
        return np.array(np.asarray(given) - start, kind).ravel()
