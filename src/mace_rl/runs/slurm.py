"""How long a run may take on a slow machine, and how many runs share an entry of a cluster's queue.

The estimate is a few times the usual time (docs/performance.md). A run that is ended for exceeding
it resumes, with twice the time.
"""

import math
from collections.abc import Mapping

from mace_rl.config.run import RunConfig

START_SECONDS = 120.0  # Snakemake's start on the node; imports from a shared disk
# Steps of plain PPO a second: a third to an eighth of docs/performance.md's, for older processors.
STEPS_PER_SECOND = 3_000.0
IN_COMPILED_CODE = {"CartPole-v1": 30_000.0, "Acrobot-v1": 30_000.0}
IN_TORCH = 300.0
ENTRY_MINUTES = 120


def minutes(config: RunConfig, work: float) -> int:
    """The time to ask for; work: the run's environment steps, in units of plain PPO's."""
    ours = IN_COMPILED_CODE.get(config.environment, STEPS_PER_SECOND)
    speed = IN_TORCH if config.engine == "torch" else ours
    return math.ceil((START_SECONDS + work / speed) / 60)


def entry(run_minutes: int, sizes: Mapping[str, int]) -> str | None:
    """The group, of `sizes` runs, that fills an entry best; None: each run has its own."""
    fitting = [name for name, runs in sizes.items() if runs * run_minutes <= ENTRY_MINUTES]
    return max(fitting, key=sizes.__getitem__, default=None)
