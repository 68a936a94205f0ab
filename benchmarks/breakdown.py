"""Where a training's time goes, by part of the program.

The program has no timers of its own: its functions are wrapped here from outside.
"""

import time
from collections import defaultdict
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numba import njit

from benchmarks.measuring import (
    CARTPOLE,
    ENVIRONMENTS,
    FIRST_SEED,
    HOPPER,
    Scale,
    in_fresh_process,
)
from benchmarks.speed import OURS, our_config, warm_up
from mace_rl.environments import classic_control

# Each part with its functions as they hang on a Trainer. What no function here accounts for is
# bookkeeping.
SECTIONS = {
    "environment": "environment.env.unwrapped.reset environment.env.step",
    "acting": "",  # see `instrument` and `FUNCTIONS`, as for the updates
    "bookkeeping": "",
    "critics' values, advantages": "ppo.advantages",
    "update: actor": "",
    "update: critics": "",
}
BONUS = {
    "novelty: k-NN": "curiosity.novelty.knn_novelty curiosity.novelty._replace_redundant",
    "novelty: density": "curiosity.novelty.density_novelty curiosity.novelty.refresh",
    "memory": "curiosity.memory.recall curiosity.memory.write",
    "meta network": "controller.next_episode meta_update",
}
ALL_SECTIONS = list(SECTIONS | BONUS)
# Functions of modules: section, module, name.
FUNCTIONS = (
    ("acting", "mace_rl.training.trainer", "draw_noise"),
    ("acting", "mace_rl.agent.policy", "act_box"),
    ("update: actor", "mace_rl.agent.compiled_learner", "update_policy"),
    ("update: critics", "mace_rl.agent.compiled_learner", "update_critic"),
    ("memory", "mace_rl.bonus.curiosity", "relevance"),
)


class Stopwatch:
    """CPU seconds by section. Sections nest: the inner one's time is not the outer one's."""

    def __init__(self, section: str) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._sections = [section]  # the innermost last
        self._since = time.process_time()

    def wrap(self, section: str, owner: Any, name: str) -> None:
        """Replace the function `owner.name` by itself with its time booked on `section`."""
        function: Callable[..., Any] = getattr(owner, name)

        def timed(*arguments: Any, **keywords: Any) -> Any:
            self._book()
            self._sections.append(section)
            try:
                return function(*arguments, **keywords)
            finally:
                self._book()
                self._sections.pop()

        setattr(owner, name, timed)

    def stop(self) -> dict[str, float]:
        """Seconds by section until now."""
        self._book()
        return dict(self.seconds)

    def _book(self) -> None:
        now = time.process_time()
        self.seconds[self._sections[-1]] += now - self._since
        self._since = now


def measure(scale: Scale) -> list[dict[str, Any]]:
    """A row for each part of each of our trainings."""
    rows: list[dict[str, Any]] = []
    for environment in ENVIRONMENTS:
        for contestant in OURS:
            what = contestant, environment, FIRST_SEED, scale.steps[environment]
            steps, found = in_fresh_process(profile, *what)
            identity = {"env": environment, "contestant": contestant, "steps": steps}
            rows += [
                identity | {"part": part, "seconds": found.get(part, 0.0)} for part in ALL_SECTIONS
            ]
    return rows


def profile(
    contestant: str, environment: str, seed: int, steps: int
) -> tuple[int, dict[str, float]]:
    """How many steps were done, at least `steps` from scratch, and seconds by part."""
    from mace_rl.training.trainer import Trainer

    warm_up(contestant, environment, seed)
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
    return done, seconds


def instrument(trainer: Any, watch: Stopwatch) -> None:
    """Book the work of `trainer` on the sections of `watch`; what it does stays the same."""
    for section, functions in [*SECTIONS.items(), *(BONUS.items() if trainer.curiosity else ())]:
        for function in functions.split():
            *path, name = function.split(".")
            owner = trainer
            for part in path:
                owner = owner[part] if isinstance(owner, dict) else getattr(owner, part)
            watch.wrap(section, owner, name)
    for section, module, name in FUNCTIONS:
        watch.wrap(section, import_module(module), name)
    if trainer.environment.name != HOPPER:
        # One compiled loop, of environment and acting; `profile` tells them apart.
        watch.wrap("acting", trainer, "play")


def compiled_step_seconds(environment: str) -> float:
    """Duration of one compiled step of CartPole or Acrobot, the environment alone."""
    cartpole = environment == CARTPOLE
    actions = np.random.default_rng(0).integers(2, size=200_000)
    _steps(cartpole, actions[:10], 2.0)
    start = time.process_time()
    _steps(cartpole, actions, 2.0)
    return (time.process_time() - start) / len(actions)


@njit
def _steps(cartpole, actions, two):
    state = np.full(4, 0.01)
    which = classic_control.CARTPOLE if cartpole else classic_control.ACROBOT
    observation = np.empty(4 if cartpole else 6, np.float32)
    for action in actions:
        if cartpole:
            _, terminated = classic_control.step_cartpole(state, action)
        else:
            _, terminated = classic_control.step_acrobot(state, action, two)
        classic_control.observe(which, state, observation)
        if terminated:
            state[:] = 0.01
