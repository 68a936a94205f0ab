"""What the spaces of an environment mean here: observations are vectors."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete

from mace_rl.config.section import ConfigError


class Spaces:
    """Observations and actions of an environment.

    Observations are flat float32 vectors; a Discrete observation becomes a one-hot vector. `name`
    is for messages. Raises `ConfigError` for unsupported spaces.
    """

    def __init__(
        self, name: str, observations: gymnasium.Space[Any], actions: gymnasium.Space[Any]
    ) -> None:
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
        self.name = name
        self.observation_space, self.action_space = observations, actions
        self.discrete_observations = isinstance(observations, Discrete)
        self.observation_size = (
            int(observations.n)
            if isinstance(observations, Discrete)
            else int(np.prod(observations.shape))
        )

    def encode(self, observation: Any) -> np.ndarray:
        """`observation` as a float32 vector, [observation_size]; may be the same memory."""
        if isinstance(self.observation_space, Discrete):
            vector = np.zeros(self.observation_size, np.float32)
            vector[int(observation) - int(self.observation_space.start)] = 1.0
            return vector
        return np.asarray(observation, np.float32).ravel()


def _is_image(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and len(space.shape) >= 2 and space.dtype == np.uint8


def _kind(space: gymnasium.Space[Any]) -> str:
    """What a space that does not work is called."""
    return "image" if _is_image(space) else type(space).__name__.lower()
