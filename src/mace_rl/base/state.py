"""Objects whose state is in checkpoints: the attributes that they name."""

import copy
from abc import ABC, abstractmethod
from collections import deque
from typing import Any

import numpy as np


class SavedArray(np.ndarray):
    """An array of a state: in a file it is a tensor, and either gives its numbers by `numpy`.

    Without it, every training would need torch, which takes it seconds and 200 MB to import.
    """

    def numpy(self) -> np.ndarray:
        """The same memory as an ordinary array."""
        return self.view(np.ndarray)

    def __reduce_ex__(self, protocol: Any) -> Any:  # for torch.save
        import torch

        return torch.from_numpy(self.numpy()).__reduce_ex__(protocol)


class HasState(ABC):
    """An interface of parts whose state is in checkpoints."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs: tensors, numbers, strings, lists, dicts."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""


class Stateful(HasState):
    """`STATE` names the attributes that the rest of a run depends on.

    They are arrays, numbers, None, NumPy's generators, objects with a `state_dict`, and lists,
    deques and dictionaries of these.
    """

    STATE: tuple[str, ...] = ()

    def state_dict(self) -> dict[str, Any]:
        return {name: saved(getattr(self, name)) for name in self.STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned; arrays of the same shape in place."""
        for name in self.STATE:
            setattr(self, name, restored(getattr(self, name), state[name]))


def saved(value: Any) -> Any:
    """A copy of `value` for a checkpoint."""
    match value:
        case np.ndarray():
            return value.copy().view(SavedArray)
        case np.random.Generator():
            return value.bit_generator.state
        case Stateful():
            return value.state_dict()
        case dict():
            return {name: saved(item) for name, item in value.items()}
        case list() | tuple() | deque():
            return [saved(item) for item in value]
    return copy.deepcopy(value.state_dict()) if hasattr(value, "state_dict") else value


def restored(current: Any, state: Any) -> Any:
    """Rebuild a value from a checkpoint, reusing `current`'s memory where shapes match."""
    if isinstance(current, np.random.Generator):
        current.bit_generator.state = state
        return current
    if hasattr(current, "load_state_dict"):
        current.load_state_dict(state)
        return current
    if hasattr(state, "numpy"):  # a tensor, or a `SavedArray`
        if not isinstance(current, np.ndarray) or current.shape != tuple(state.shape):
            return state.numpy().copy()
        current[...] = state.numpy()
        return current
    match state:
        case dict():
            before = current or {}
            items = {name: restored(before.get(name), item) for name, item in state.items()}
            return items if current is None else type(current)(items)
        case list():
            several = [restored(None, item) for item in state]
            return deque(several, current.maxlen) if isinstance(current, deque) else several
    return state
