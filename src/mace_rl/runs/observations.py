"""Observations as an environment gives them, one or many, to the vectors that agents train on.

Discrete: an integer; integers [N]; one-hot vectors [..., n], one alone only of floats. Box,
MultiDiscrete, MultiBinary: an array of its shape; [N, *shape]; flat vectors [..., size]. Tuple,
Dict: one with each part as above, with arrays [N, ...] in it for a batch; a list of such; flat
vectors. Arrays, lists and torch tensors do.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple
from torch import Tensor

from mace_rl.base.errors import Refusal
from mace_rl.config.section import short_repr


class ObservationError(Refusal, ValueError):
    """Not an observation of the environment that the agent was trained in."""


def encoded(given: Any, space: Space[Any], size: int) -> Tensor:
    """Observations of `space`, or vectors as `Spaces.encode` makes them, as float32 [..., size].

    Bounds are not checked: environments exceed them in training, too. Raises `ObservationError`.
    """
    for read in (_as_given, _flat):
        # Gymnasium, numpy, torch and these functions raise for another form.
        with suppress(TypeError, ValueError, LookupError, RuntimeError):
            found = read(given, space)
            if found.shape[-1:] == (size,) and found.numel() and found.isfinite().all():
                return found
    shape = f" of shape {tuple(given.shape)}" if hasattr(given, "shape") else ""
    what = f"{short_repr(given)}{shape}, which is no finite observation of {space}"
    if isinstance(given, tuple) and any(isinstance(one, Mapping) for one in given[-1:]):
        what += "; of what reset and step return, only the first is one"
    raise ObservationError(" ".join(f"the policy was given {what}".split()))


def _as_given(given: Any, space: Space[Any]) -> Tensor:
    """From an observation, arrays of observations with one more dimension, or a list of them."""
    match space, given:
        case Dict() | Tuple(), [tuple() | Mapping(), *_] if isinstance(given, list):
            return torch.stack([_as_given(one, space) for one in given])
        case Dict(), Mapping() if given.keys() >= space.keys():
            return torch.cat([_as_given(given[name], part) for name, part in space.items()], -1)
        case Tuple(), tuple() | list() | np.ndarray(ndim=1):
            return torch.cat([_as_given(*pair) for pair in zip(given, space, strict=True)], -1)
        case Box() | MultiBinary(), _:
            numbers = _numbers(given)
            lead = numbers.shape[: numbers.ndim - len(space.shape)]
            if numbers.shape == (*lead, *space.shape):
                return numbers.reshape(*lead, -1).float()
        case Discrete(), _:
            numbers = _numbers(given)
            states = torch.arange(int(space.n), device=numbers.device) + int(space.start)
            one_hot = numbers[..., None].double() == states
            if _are_states(numbers) and one_hot.any(-1).all():
                return one_hot.float()
        case MultiDiscrete(), _:
            each = zip(space.nvec.ravel(), space.start.ravel(), strict=True)
            parts = _numbers(given).flatten(-space.nvec.ndim).unbind(-1)
            return _as_given(parts, Tuple([Discrete(n, start=start) for n, start in each]))
    raise ValueError


def _flat(given: Any, space: Space[Any]) -> Tensor:
    numbers = _numbers(given)
    if isinstance(space, Discrete):
        ones = (numbers == 1).sum(-1)
        if _are_states(numbers) or (ones != 1).any() or (ones != (numbers != 0).sum(-1)).any():
            raise ValueError
    return numbers.float()


def _are_states(numbers: Tensor) -> bool:
    """Whether these are numbers of Discrete states, [] or [N], rather than one-hot vectors."""
    return numbers.ndim < 2 and not numbers.is_floating_point()


def _numbers(given: Any) -> Tensor:
    numbers = given if isinstance(given, Tensor) else torch.from_numpy(np.array(given))
    if numbers.is_complex():
        raise TypeError
    return numbers
