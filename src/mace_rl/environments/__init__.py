"""Environments, and acting in them; importing this registers our own with Gymnasium.

Planning the workflow needs the ids, and neither PyBullet nor numba nor torch: classes are named.
"""

from contextlib import suppress

import gymnasium
from gymnasium.envs.registration import EnvSpec

gymnasium.register(
    "SparseMountainCar-v0", "mace_rl.environments.tasks:SparseMountainCar", max_episode_steps=200
)
gymnasium.register(
    "NoisyMountainCar-v0", "mace_rl.environments.tasks:NoisyMountainCar", max_episode_steps=200
)
for size, pages in ((6, 500), (7, 1000), (10, 1000)):
    gymnasium.register(
        f"NoisyDeepSea{size}-v0",
        "mace_rl.environments.tasks:NoisyDeepSea",
        max_episode_steps=size,
        kwargs={"size": size, "pages": pages},
    )
gymnasium.register(
    "LateDeepSea7-v0",
    "mace_rl.environments.tasks:LateDeepSea",
    max_episode_steps=12,
    kwargs={"size": 7, "pages": 1000},
)
for size in (10, 20):
    gymnasium.register(
        f"DeepSea{size}-v0",
        "mace_rl.environments.tasks:DeepSea",
        max_episode_steps=size,
        kwargs={"size": size},
    )
gymnasium.register(
    "FrozenLake8x8Deterministic-v0",
    "gymnasium.envs.toy_text.frozen_lake:FrozenLakeEnv",
    max_episode_steps=200,
    kwargs={"map_name": "8x8", "is_slippery": False},
)
gymnasium.register(
    "CliffWalking200-v0",
    "gymnasium.envs.toy_text.cliffwalking:CliffWalkingEnv",
    max_episode_steps=200,
)
gymnasium.register(
    "BarrenRegion-v0", "mace_rl.environments.tasks:BarrenRegion", max_episode_steps=60
)
for name, flag in {"Help": "right", "Harm": "wrong", "Nothing": "random"}.items():
    gymnasium.register(
        f"Planted{name}-v0",
        "mace_rl.environments.planted:Planted",
        max_episode_steps=32,
        kwargs={"flag": flag},
    )


def registered() -> dict[str, EnvSpec]:
    """Gymnasium's registry, with Bullet's environments if they are installed."""
    with suppress(ImportError):
        import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0 and its siblings)
    return gymnasium.registry
