"""What an environment and its wrappers learned in a training, as plain data to keep and restore.

A resumed training needs it, and so does whoever plays with the agent later. It is the `state_dict`
of an environment that has one, and the running statistics of Gymnasium's wrappers.
"""

import copy
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import NormalizeReward
from gymnasium.wrappers.utils import RunningMeanStd

from mace_rl.base.state import saved

OFFERED = ("state_dict", "load_state_dict")  # by an environment, or the outermost of its wrappers
OWN = "own"  # the key of what these give
GYMNASIUMS = ("gymnasium.", "mace_rl.")  # wrappers whose numbers are known
Env = gymnasium.Env[Any, Any]


def remembered(env: Env) -> dict[str, Any]:
    """It, without what `restore` cannot give back; empty if there is nothing."""
    found: dict[str, Any] = {}
    if all(map(env.has_wrapper_attr, OFFERED)):
        found[OWN] = copy.deepcopy(env.get_wrapper_attr("state_dict")())
    for key, holder, name in _statistics(env):
        found[key] = saved(np.array(getattr(holder, name), np.float64))
    return found


def restore(env: Env, state: dict[str, Any]) -> None:
    """Give an environment back what `remembered` returned of one like it."""
    if OWN in state:
        env.get_wrapper_attr("load_state_dict")(copy.deepcopy(state[OWN]))
    for key, holder, name in _statistics(env):
        kept = np.asarray(getattr(holder, name))
        setattr(holder, name, state[key].numpy().reshape(kept.shape).astype(kept.dtype)[()])


def hold_still(env: Env) -> None:
    """Let Gymnasium's normalising wrappers learn no more."""
    for layer in layers(env):
        if hasattr(type(layer), "update_running_mean"):
            layer.update_running_mean = False


def fractions(env: Env) -> dict[str, bytes]:
    """The fractions that wrappers of others hold, by attribute: no `remembered` has them."""
    found = {}
    for number, layer in enumerate(layers(env)):
        known = type(layer).__module__.startswith(GYMNASIUMS) or hasattr(type(layer), OFFERED[0])
        for name, value in {} if known else vars(layer).items():
            inside = vars(value).items() if hasattr(value, "__dict__") and name != "env" else ()
            for key, part in ((name, value), *((f"{name}.{key}", part) for key, part in inside)):
                if (
                    isinstance(part, float | np.floating | np.ndarray)
                    and np.array(part).dtype.kind == "f"
                ):
                    place = f"{type(layer).__module__}:{type(layer).__name__}.{key}"
                    found[f"{number} {place}"] = np.array(part).tobytes()
    return found


def layers(env: Env) -> Iterator[Any]:
    """The wrappers, the outermost first."""
    layer: Any = env
    while layer is not layer.unwrapped:
        yield layer
        layer = layer.env


def _statistics(env: Env) -> Iterator[tuple[str, Any, str]]:
    """Key, holder and name of each number or array that Gymnasium's wrappers learn."""
    for number, layer in enumerate(layers(env)):
        for name, value in vars(layer).items():
            if isinstance(value, RunningMeanStd):
                for part in ("mean", "var", "count"):
                    yield f"{number}.{name}.{part}", value, part
        if isinstance(layer, NormalizeReward):
            yield f"{number}.discounted_reward", layer, "discounted_reward"
