"""MACE-RL: PPO with episodic memory, curiosity and a meta-learnt curiosity weight β.

    from mace_rl import CuriosityReward, VectorCuriosityReward, load_agent, settings, train

Each is imported when it is asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mace_rl.library import settings, train
    from mace_rl.runs.agent import load_agent
    from mace_rl.wrapping.wrappers import CuriosityReward, VectorCuriosityReward

__all__ = ["CuriosityReward", "VectorCuriosityReward", "load_agent", "settings", "train"]

_PLACES = {"load_agent": "runs.agent", "settings": "library", "train": "library"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'mace_rl' has no attribute {name!r}")
    return getattr(import_module(f"mace_rl.{_PLACES.get(name, 'wrapping.wrappers')}"), name)
