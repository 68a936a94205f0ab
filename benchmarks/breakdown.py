"""Where a training's time goes, by section and in µs per step: breakdown.csv.

`python -m benchmarks.breakdown CONTESTANT ENVIRONMENT SEED STEPS` profiles one training.
"""

import sys
import time
from typing import Any

import numpy as np
from numba import njit

from benchmarks.process import measured, one_thread, report, write_rows
from benchmarks.settings import CARTPOLE, ENVIRONMENTS, FIRST_SEED, HOPPER, OURS, Scale
from benchmarks.stopwatch import Stopwatch
from mace_rl import compiled

# In the order of the stacked bars. What no function below is booked on is bookkeeping.
SECTIONS = (
    "environment",
    "acting",
    "bookkeeping",
    "critics' values, advantages",
    "update: actor",
    "update: critics",
    "novelty: k-NN",
    "novelty: density",
    "memory",
    "meta network",
)
# (section, what of a Trainer holds the function, its name)
METHODS = (
    ("environment", "environment.env", "reset"),
    ("environment", "environment.env", "step"),
    ("critics' values, advantages", "ppo", "advantages_and_returns"),
    ("update: actor", "ppo", "actor_gradient"),
    ("update: actor", "ppo.learners.actor", "descend"),
    ("update: critics", "ppo", "critic_gradient"),
    ("update: critics", "ppo.learners.extrinsic", "descend"),
)
METHODS_WITH_BONUS = (
    ("update: critics", "ppo.learners.intrinsic", "descend"),
    ("novelty: k-NN", "curiosity.novelty", "knn_novelty"),
    ("novelty: density", "curiosity.novelty", "density_novelty"),
    ("novelty: density", "curiosity.novelty", "observe"),
    ("memory", "curiosity.memory", "lookup"),
    ("memory", "curiosity.memory", "write"),
    ("meta network", "controller", "next_episode"),
    ("meta network", "", "adapt"),
)
# (section, module, function)
FUNCTIONS = (
    ("acting", "train", "draw_noise"),
    ("acting", "compiled", "act_box"),
    ("memory", "curiosity", "relevance"),
)


def measure_all(scale: Scale) -> None:
    """Profile all our trainings and write breakdown.csv."""
    rows = []
    for environment in ENVIRONMENTS:
        for contestant in OURS:
            steps = scale.later_steps[environment]
            found = measured("breakdown", contestant, environment, FIRST_SEED, steps)
            rows += [
                {
                    "env": environment,
                    "contestant": contestant,
                    "section": section,
                    "microseconds_per_step": found.get(section, 0.0),
                }
                for section in SECTIONS
            ]
            write_rows(scale.data / "breakdown.csv", rows)
            print(f"profile: {environment} {contestant}: {sum(found.values()):.1f} µs a step")


def instrument(trainer: Any, watch: Stopwatch) -> None:
    """Book the work of `trainer` on the sections of `watch`; what it does stays the same."""

    for section, path, name in METHODS + (METHODS_WITH_BONUS if trainer.curiosity else ()):
        owner = trainer
        for part in filter(None, path.split(".")):
            owner = owner[part] if isinstance(owner, dict) else getattr(owner, part)
        watch.wrap(section, owner, name)
    for section, module, name in FUNCTIONS:
        watch.wrap(section, sys.modules[f"mace_rl.{module}"], name)
    if trainer.environment.name != HOPPER:
        # One compiled loop, of environment and acting; `profile` tells them apart.
        watch.wrap("acting", trainer, "rollout")


def profile(contestant: str, environment: str, seed: int, steps: int) -> dict[str, float]:
    """µs per step by section, over at least `steps` steps from scratch."""
    from benchmarks.contestants import our_config
    from mace_rl.train import Trainer

    trainer = Trainer(our_config(contestant, environment, seed))
    watch = Stopwatch("bookkeeping")
    instrument(trainer, watch)
    for records in trainer.run():
        if records[-1].env_steps >= steps:
            break
    seconds, done = watch.stop(), records[-1].env_steps
    if environment != HOPPER:
        stepping = done * compiled_step_seconds(environment)
        seconds["environment"] += stepping
        seconds["acting"] -= stepping
    return {section: 1e6 * value / done for section, value in seconds.items()}


def compiled_step_seconds(environment: str) -> float:
    """Duration of one compiled step of CartPole or Acrobot, the environment alone."""
    which = compiled.CARTPOLE if environment == CARTPOLE else compiled.ACROBOT
    actions = np.random.default_rng(0).integers(2, size=200_000)
    _steps(which, actions[:10], 2.0)
    start = time.perf_counter()
    _steps(which, actions, 2.0)
    return (time.perf_counter() - start) / len(actions)


@njit
def _steps(which, actions, two):
    state = np.full(4, 0.01)
    observation = np.empty(4 if which == compiled.CARTPOLE else 6, np.float32)
    for action in actions:
        if which == compiled.CARTPOLE:
            _, terminated = compiled.step_cartpole(state, action)
        else:
            _, terminated = compiled.step_acrobot(state, action, two)
        compiled._observe(which, state, observation)
        if terminated:
            state[:] = 0.01


def main() -> None:
    """One profile."""
    contestant, environment, seed, steps = sys.argv[1:]
    from benchmarks.contestants import start
    from benchmarks.settings import WARM_UP_STEPS
    from benchmarks.speed import read_clock

    one_thread()
    warm_up = start(contestant, environment, int(seed) + 10**6, WARM_UP_STEPS)
    read_clock(warm_up, [WARM_UP_STEPS])
    report(profile(contestant, environment, int(seed), int(steps)))


if __name__ == "__main__":
    main()
