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
        self.action_size = int(actions.n) if isinstance(actions, Discrete) else actions.shape[0]

    def encode(self, observation: Any) -> np.ndarray:
        """`observation` as a float32 vector, [observation_size]; may be the same memory.

        Raises `ConfigError` for what is not of the space.
        """
        space = self.observation_space
        if isinstance(space, Discrete):
            number, found = int(observation) - int(space.start), f"number {observation}"
            if 0 <= number < self.observation_size:
                vector = np.zeros(self.observation_size, np.float32)
                vector[number] = 1.0
                return vector
        else:
            vector = np.asarray(observation, np.float32)
            if vector.size == self.observation_size:
                return vector.ravel()
            found = f"shape {vector.shape}"
        raise ConfigError(
            f"environment {self.name!r} gave an observation of {found}, but its "
            f"observation_space is {space}"
        )


def _is_image(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, Box) and len(space.shape) >= 2 and space.dtype == np.uint8


def _kind(space: gymnasium.Space[Any]) -> str:
    """What a space that does not work is called."""
    return "image" if _is_image(space) else type(space).__name__.lower()
