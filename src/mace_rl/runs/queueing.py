"""How long a run may take on a slow machine, and how many runs make one entry of a cluster's queue.

A queue ends what exceeds its time, and lets wait longer what asks for more: the estimate is a few
times what runs take (docs/scaling.md). One that was too short costs little, since a run that was
ended resumes from its checkpoint, in twice the time.
"""

import math
from collections.abc import Mapping

from mace_rl.config.run import RunConfig

START_SECONDS = 120.0  # Snakemake, which starts again on the node; imports from a shared disk
# Steps of plain PPO a second: a third to a sixth of docs/performance.md's, for older processors.
STEPS_PER_SECOND = 3_000.0
IN_COMPILED_CODE = {"CartPole-v1": 30_000.0, "Acrobot-v1": 30_000.0}  # the environment, too
IN_TORCH = 300.0
ENTRY_MINUTES = 120


def minutes(config: RunConfig, work: float) -> int:
    """The time to ask for, for a run of `work`: environment steps, counted as PPO's are worth."""
    ours = IN_COMPILED_CODE.get(config.environment, STEPS_PER_SECOND)
    speed = IN_TORCH if "torch" in (config.engine, config.ppo.network.kind) else ours
    return math.ceil((START_SECONDS + work / speed) / 60)


def entry(run_minutes: int, sizes: Mapping[str, int]) -> str | None:
    """Which of the groups of `sizes` runs fills an entry best; None: such a run has its own."""
    fitting = [name for name, runs in sizes.items() if runs * run_minutes <= ENTRY_MINUTES]
    return max(fitting, key=sizes.__getitem__, default=None)
