"""What is measured, how often and for how long; where the results go."""

from dataclasses import dataclass
from pathlib import Path

from mace_rl.results.paper import ACROBOT, CARTPOLE, HOPPER, VARIANTS

ROOT = Path(__file__).parents[1]

ENVIRONMENTS = (CARTPOLE, ACROBOT, HOPPER)

# Everything that is timed, and its name in tables and plots.
LABELS = {
    "environment": "environment alone, the library's",
    "environment_fast": "environment alone, ours",
    "sb3_default": "stable-baselines3 PPO, defaults",
    "sb3_2048x4": "stable-baselines3 PPO, 2048 steps, 4 full-batch epochs",
    "ppo_2048": "our PPO, 2048 steps, 4 full-batch epochs",
    "ppo": "our PPO, an update per episode (default)",
    "mace_fixed": "mace_fixed",
    "mace_full": "mace_full",
}
REFERENCE = "sb3_2048x4"  # the faster of the two peers: speed-ups are relative to it
# And their variants, with the study's settings but for the first.
OURS = {"ppo_2048": "ppo"} | {variant: variant for variant in VARIANTS}

FIRST_SEED = 1000  # of the measurements; the study reports others
CORES = 2  # of the workflow


def contestants(environment: str) -> list[str]:
    """Everything that is timed in `environment`."""
    return [name for name in LABELS if name != "environment_fast" or environment == HOPPER]


@dataclass(frozen=True)
class Scale:
    """How long everything takes. Dictionaries are by environment, numbers of steps."""

    data: Path  # folder of the CSV files
    pictures: Path
    document: Path  # the generated parts of docs/performance.md go into this copy of it
    repeats: int
    steps: dict[str, int]  # of one training, the same for everybody; multiples of 2048
    later_steps: dict[str, int]  # our own trainings go on until here
    environment_steps: dict[str, int]  # without an agent
    growth_episodes: int
    workflow_episodes: int  # of each run of the small workflow ...
    workflow_seeds: int  # ... and how many of them, 3 environments × 3 variants
    start_repeats: int
    start_jobs: int  # of the workflow whose jobs do nothing but start and end
    planned_seeds: int  # of the workflow that is only planned, with every variant there is
    purejaxrl_repeats: int


FULL = Scale(
    data=ROOT / "benchmarks",
    pictures=ROOT / "docs",
    document=ROOT / "docs" / "performance.md",
    repeats=5,
    steps={CARTPOLE: 30720, ACROBOT: 30720, HOPPER: 16384},
    later_steps={CARTPOLE: 204800, ACROBOT: 204800, HOPPER: 65536},
    environment_steps={CARTPOLE: 204800, ACROBOT: 102400, HOPPER: 16384},
    growth_episodes=400,
    workflow_episodes=200,
    workflow_seeds=2,
    start_repeats=5,
    start_jobs=4,
    planned_seeds=200,
    purejaxrl_repeats=3,
)
_QUICK = ROOT / "benchmarks" / "quick"
QUICK = Scale(
    data=_QUICK,
    pictures=_QUICK,
    document=_QUICK / "performance.md",
    repeats=1,
    steps=dict.fromkeys(ENVIRONMENTS, 2048),
    later_steps=dict.fromkeys(ENVIRONMENTS, 6144),
    environment_steps=dict.fromkeys(ENVIRONMENTS, 2048),
    growth_episodes=50,
    workflow_episodes=5,
    workflow_seeds=1,
    start_repeats=1,
    start_jobs=2,
    planned_seeds=20,
    purejaxrl_repeats=1,
)
