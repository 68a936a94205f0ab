"""Spaces as agents see them: observations are vectors. All that environments return is checked."""

from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

from mace_rl.config.section import ConfigError, short_repr
from mace_rl.environments.actions import Actions
from mace_rl.numerics.finite import TOO_LARGE, all_below, require_finite

MOST_NUMBERS = 10**4  # in an observation or an action: each is a row of networks and memory
FLAT = (Box, Discrete, MultiBinary, MultiDiscrete)  # spaces that are vectors, or become some
COMPOSITE = (Dict, Tuple, MultiDiscrete)  # spaces that `flatten` makes vectors of
NUMBERS = "biuf"  # NumPy's kinds of numbers


class Spaces:
    """The spaces of an environment; `name` is for messages. `ConfigError` for unsupported ones.

    Observations become flat float32 vectors, as Gymnasium's `flatten` makes them: a state of a
    Discrete or MultiDiscrete space is one-hot, an image is a row of numbers.
    """

    clips_actions = True  # Box ones to their bounds

    def __init__(
        self,
        name: str,
        observations: gymnasium.Space[Any],
        actions: gymnasium.Space[Any],
        in_part: bool = False,
    ) -> None:
        """in_part: entries of a Dict that have no flat form are left out, where others have one."""
        observations = flat_part(observations) if in_part else observations
        require_flat(name, observations)
        require_size(name, observations)
        self.given_space = observations  # of what `encode` gets
        self.composite = observations if isinstance(observations, COMPOSITE) else None
        if not isinstance(observations, Box | Discrete):
            observations = gymnasium.spaces.flatten_space(observations)
        self.actions = Actions(name, actions)
        require_size(name, actions)
        assert isinstance(observations, Box | Discrete)
        self.name = name
        self.observation_space: Box | Discrete = observations
        self.action_space: Any = actions
        self.discrete_observations = isinstance(observations, Discrete)
        self.whole = is_discrete(self.given_space)
        self.observation_size = int(gymnasium.spaces.flatdim(observations))
        self.action_size = self.actions.outputs

    def encode(self, observation: Any, step: int | None = None) -> np.ndarray:
        """`observation` as a float32 vector, [observation_size]; may share its memory.

        step: the step that returned it, for messages; 0 is the reset. Raises `ConfigError` unless
        it is of the space, and `NonFiniteError` for numbers that are not finite or too large.
        """
        space, given = self.observation_space, _array(observation, self.composite)
        if isinstance(space, Discrete):
            number = _only(given)
            place = -1 if number is None or number % 1 else int(number) - int(space.start)
            if 0 <= place < self.observation_size:
                vector = np.zeros(self.observation_size, np.float32)
                vector[place] = 1.0
                return vector
        elif self._is_vector(given):
            vector = given.ravel()
            if vector.dtype.kind != "f":
                vector = vector.astype(np.float32)
            elif vector.dtype != np.float32:
                with np.errstate(over="ignore"):  # what becomes infinite is found in the next line
                    vector = vector.astype(np.float32)
            if not all_below(vector, TOO_LARGE):
                require_finite("the observation", given.astype(float), _after(step), TOO_LARGE)
            return vector
        shape = "" if self.composite else f" of shape {given.shape}"
        raise ConfigError(
            f"environment {self.name!r} gave the observation {short_repr(observation)}{shape}"
            f"{_after(step)}, but its observation_space is {self.given_space}"
        )

    def _is_vector(self, given: np.ndarray) -> bool:
        """Whether it has as many numbers as it should, whole ones where the space has these."""
        fits = given.size == self.observation_size and given.dtype.kind in NUMBERS
        return fits and not (self.whole and has_fractions(given))

    def number(self, what: str, value: Any, step: int) -> float:
        """A reward or flag of a step, counted from 1; `ConfigError` unless it is one number."""
        if type(value) in (float, bool, int) and abs(value) < TOO_LARGE:
            return value
        if (found := _only(_array(value))) is None:
            raise ConfigError(
                f"environment {self.name!r} gave {short_repr(value)} as {what}{_after(step)}, but "
                "it should be one number, or True or False"
            )
        return found

    def checked_reward(self, reward: Any, step: int) -> float:
        """The reward of a step, checked."""
        number = float(self.number("reward", reward, step))
        require_finite("the reward", number, _after(step), TOO_LARGE)
        return number


def require_flat(name: str, space: gymnasium.Space[Any], entry: str = "") -> None:
    """Raise `ConfigError` unless observations are vectors, or become some; entry: of a Dict."""
    if isinstance(space, Dict | Tuple) and len(space):
        for key, part in space.items() if isinstance(space, Dict) else enumerate(space):
            require_flat(name, part, f"{entry}[{key!r}]")
    elif not isinstance(space, FLAT):
        what = f"the observation{entry} is of {type(space).__name__}"
        leaves_out = (
            "leaves it out ('gymnasium.wrappers:FilterObservation(filter_keys=[...])') or "
            if entry
            else ""
        )
        raise ConfigError(
            f"environment {name!r}: {what}, and not so many numbers at every step; it needs a "
            f"wrapper that {leaves_out}makes numbers of it, by --wrapper or environment_wrappers"
        )


def flat_part(space: gymnasium.Space[Any]) -> gymnasium.Space[Any]:
    """A Dict without the entries that have no flat form, if any other has one; else the same."""
    if not isinstance(space, Dict):
        return space
    parts = {key: flat_part(part) for key, part in space.items()}
    flat: dict[str, Any] = {key: part for key, part in parts.items() if has_flat_form(part)}
    return Dict(flat) if flat else space


def has_flat_form(space: gymnasium.Space[Any]) -> bool:
    """Whether observations are vectors, or become some."""
    if isinstance(space, Dict | Tuple) and len(space):
        return all(map(has_flat_form, space.values() if isinstance(space, Dict) else space))
    return isinstance(space, FLAT)


def is_discrete(space: gymnasium.Space[Any]) -> bool:
    """Whether its elements are whole numbers, so that the same state comes again."""
    match space:
        case Dict() | Tuple():
            return all(map(is_discrete, space.values() if isinstance(space, Dict) else space))
        case Box():
            return space.dtype.kind in "biu"
    return isinstance(space, Discrete | MultiBinary | MultiDiscrete)


def require_size(name: str, space: gymnasium.Space[Any]) -> None:
    """Raise `ConfigError` for vectors with no or too many numbers."""
    size = int(gymnasium.spaces.flatdim(space))
    if not 1 <= size <= MOST_NUMBERS:
        image = isinstance(space, Box) and len(space.shape) in (2, 3) and size
        smaller = "gymnasium.wrappers:ResizeObservation(shape=(64, 64))"
        raise ConfigError(
            f"environment {name!r} has {size} numbers in {short_repr(space)}; 1 to"
            f" {MOST_NUMBERS} work"
            + f": an image gets smaller by --wrapper '{smaller}' and --wrapper "
            "gymnasium.wrappers:GrayscaleObservation" * bool(image)
        )


def _array(given: Any, composite: gymnasium.Space[Any] | None = None) -> np.ndarray:
    """As an array, a vector for a composite space; without numbers if it is none."""
    if type(given) is np.ndarray and composite is None:
        return given
    # NumPy, PyTorch and Gymnasium raise these if it is.
    with suppress(AttributeError, LookupError, TypeError, ValueError, RuntimeError):
        if composite is None:
            return np.asarray(given)
        if _has_parts(given, composite):
            return np.asarray(gymnasium.spaces.flatten(composite, given))
    return np.empty((), object)


def _has_parts(given: Any, space: gymnasium.Space[Any]) -> bool:
    """Whether each part has its size and whole numbers, and each state exists.

    `flatten` takes the state -1 for the last.
    """
    match space:
        case Dict():
            return all(_has_parts(given[name], part) for name, part in space.items())
        case Tuple():
            return len(given) == len(space) and all(map(_has_parts, given, space))
        case Discrete():
            return bool(space.start <= given < space.start + space.n)
        case MultiDiscrete():
            return given in space
    numbers = np.asarray(given)
    if is_discrete(space):
        with np.errstate(invalid="ignore"):  # of NaN
            if not np.array_equal(numbers, numbers.astype(space.dtype)):
                return False  # `flatten` would make other numbers of them
    return numbers.size == gymnasium.spaces.flatdim(space)


def has_fractions(numbers: np.ndarray) -> bool:
    """Whether any of them is finite and not whole."""
    if numbers.dtype.kind != "f":
        return False
    return bool((np.isfinite(numbers) & (numbers != np.trunc(numbers))).any())


def _only(values: np.ndarray) -> Any:
    """The number in an array of one; None for other arrays."""
    return values.item() if values.size == 1 and values.dtype.kind in NUMBERS else None


def _after(step: int | None) -> str:
    return "" if step is None else f" after step {step}" if step else " after the reset"
