"""Environments, and acting in them; importing this registers our own with Gymnasium.

Classes are given by name: planning the workflow needs the ids without PyBullet, numba and torch.
"""

from contextlib import suppress
from importlib import import_module

import gymnasium
from gymnasium.envs.registration import EnvSpec

TASKS, PLANTED = "mace_rl.environments.tasks", "mace_rl.environments.planted:Planted"
TEXT, EASY = "gymnasium.envs.toy_text", {"map_name": "8x8", "is_slippery": False}
for name, entry_point, steps, arguments in (
    ("SparseMountainCar", f"{TASKS}:SparseMountainCar", 200, {}),
    ("NoisyMountainCar", f"{TASKS}:NoisyMountainCar", 200, {}),
    ("BarrenRegion", f"{TASKS}:BarrenRegion", 60, {}),
    ("DeepSea10", f"{TASKS}:DeepSea", 10, {"size": 10}),
    ("DeepSea20", f"{TASKS}:DeepSea", 20, {"size": 20}),
    ("NoisyDeepSea6", f"{TASKS}:NoisyDeepSea", 6, {"size": 6, "pages": 500}),
    ("NoisyDeepSea7", f"{TASKS}:NoisyDeepSea", 7, {"size": 7, "pages": 1000}),
    ("NoisyDeepSea10", f"{TASKS}:NoisyDeepSea", 10, {"size": 10, "pages": 1000}),
    ("LateDeepSea7", f"{TASKS}:LateDeepSea", 12, {"size": 7, "pages": 1000}),
    ("FrozenLake8x8Deterministic", f"{TEXT}.frozen_lake:FrozenLakeEnv", 200, EASY),
    ("CliffWalking200", f"{TEXT}.cliffwalking:CliffWalkingEnv", 200, {}),
    ("PlantedHelp", PLANTED, 32, {"flag": "right"}),
    ("PlantedHarm", PLANTED, 32, {"flag": "wrong"}),
    ("PlantedNothing", PLANTED, 32, {"flag": "random"}),
    ("PlantedMixed", f"{PLANTED}Mixed", 32, {}),
):
    gymnasium.register(f"{name}-v0", entry_point, max_episode_steps=steps, kwargs=arguments)


def registered() -> dict[str, EnvSpec]:
    """Gymnasium's registry, with Bullet's and MiniGrid's environments if they are installed."""
    for package in ("pybullet_envs_gymnasium", "minigrid"):  # which register them
        with suppress(ImportError):
            import_module(package)
    return gymnasium.registry


def spec_of(environment: str) -> EnvSpec | None:
    """The entry of an environment, "module:Id" once the module is imported; None if there is none.

    Packages that take long to import are only when it is not Gymnasium's own or ours.
    """
    name = environment.rpartition(":")[2]
    return gymnasium.registry.get(name) or registered().get(name)
