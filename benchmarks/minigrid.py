"""What a step of MiniGrid costs beside the environment alone, in the same wrappers."""

from typing import Any

from benchmarks import speed
from benchmarks.measuring import MINIGRID, Scale

CONTESTANTS = ("environment", "sb3", speed.REFERENCE, "ppo", "mace_full")


def measure(scale: Scale) -> list[dict[str, Any]]:
    """A row for each reading."""
    return speed.in_turn(scale, {MINIGRID: [*CONTESTANTS]}, speed.reading)
