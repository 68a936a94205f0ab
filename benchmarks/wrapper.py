"""What curiosity costs per step, in the trainer and by the wrappers for other agents: wrapper.csv.

Always the same episodes for both, in CPU time. Those of a training of mace_fixed: the trainer's
bonus and remembering, and what its critic of the bonus takes; and what `CuriosityReward` adds to
the environment when the same actions are taken once more. And random play in 8 environments: what
`VectorCuriosityReward` adds, and the trainer's bonus and remembering of the episodes of it.
"""

import time
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pandas as pd

from benchmarks.process import in_fresh_process, write_rows
from benchmarks.settings import ACROBOT, CARTPOLE, FIRST_SEED, ROOT, Scale

if TYPE_CHECKING:
    from mace_rl.config.run import RunConfig

NAMES = (CARTPOLE, ACROBOT, "FrozenLake8x8Deterministic-v0", "DeepSea10-v0")
WHERE = {
    "trainer": "trainer: bonus, memory",
    "critic": "… with its critic",
    "wrapper": "`CuriosityReward`",
    "trainer_random": "random play: bonus, memory",
    "vector": "`VectorCuriosityReward` of 8",
}
TIME = "microseconds_per_step"
SIDE_BY_SIDE = 8  # environments


def measure_all(scale: Scale) -> None:
    """Measure every environment in turn, and write wrapper.csv anew after each."""
    rows = []
    for repeat in range(scale.repeats):
        for environment in NAMES:
            steps = scale.steps[CARTPOLE]
            found = in_fresh_process(measure, environment, FIRST_SEED + repeat, steps)
            rows += [
                {"env": environment, "repeat": repeat, "where": where, TIME: found[where]}
                for where in WHERE
            ]
            write_rows(scale.data / "wrapper.csv", rows)
    print(table(pd.DataFrame(rows)))


def table(rows: pd.DataFrame) -> str:
    """µs per step, medians and ranges over the repeats, in Markdown."""
    times = rows.groupby(["env", "where"])[TIME]
    low, middle, high = times.min(), times.median(), times.max()
    lines = [["µs per step", *WHERE.values()], ["---", *["--:"] * len(WHERE)]]
    for env in rows["env"].unique():
        places = [(env, where) for where in WHERE]
        cells = [f"{middle[at]:.1f} ({low[at]:.1f} to {high[at]:.1f})" for at in places]
        lines.append([env, *cells])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def measure(environment: str, seed: int, steps: int) -> dict[str, float]:
    """µs per step by `WHERE`, over at least `steps` steps from scratch."""
    from mace_rl.config.study import read_study

    study = read_study([ROOT / "config.yaml", ROOT / "config" / "exploration.yaml"])
    steps = max(steps, SIDE_BY_SIDE * 1024)  # longer than an episode, 500 steps, in each of these
    for one in (seed + 10**6, seed):  # the first loads and compiles everything
        config = study.run_config(environment, "mace_fixed", one)
        found = same_training(config, steps) | random_play(config, steps)
    return found


def same_training(config: "RunConfig", steps: int) -> dict[str, float]:
    """The trainer, and the wrapper on the trainer's episodes."""
    from mace_rl.train import Trainer
    from mace_rl.wrappers import CuriosityReward

    trainer = Trainer(config.model_copy(update={"episodes": steps}))
    bonus, critic = Clock(), Clock()
    for name in ("bonus", "remember"):
        bonus.time(trainer.curiosity, name)
    for name in ("values", "learn"):
        critic.time(trainer.ppo.critics["intrinsic"], name)
    episodes = kept(trainer, "appraise")
    for records in trainer.run():
        if records[-1].env_steps >= steps:
            break
    alone, wrapped = again(config), CuriosityReward(again(config), seed=config.seed)
    added = 0.0
    for (episode,) in episodes:  # in turn, so that whatever else the machine does hits both
        actions = episode.actions.tolist()
        added += replay(wrapped, actions) - replay(alone, actions)
    unit = 1e6 / records[-1].env_steps
    return {
        "trainer": unit * bonus.seconds,
        "critic": unit * (bonus.seconds + critic.seconds),
        "wrapper": unit * added,
    }


def random_play(config: "RunConfig", steps: int) -> dict[str, float]:
    """The vector wrapper, and the trainer's curiosity on the episodes that it remembered."""
    from gymnasium.vector import SyncVectorEnv

    from mace_rl.wrappers import CuriosityReward, VectorCuriosityReward

    makers = [lambda: gymnasium.make(config.environment)] * SIDE_BY_SIDE
    alone, inner = SyncVectorEnv(makers), SyncVectorEnv(makers)
    wrapped = VectorCuriosityReward(inner, seed=config.seed)
    episodes = kept(wrapped.appraisal.curiosity, "remember")
    played, added = 0, 0.0
    rng = np.random.default_rng(config.seed)
    for env in (alone, wrapped):
        env.reset(seed=config.seed)
    while played < steps:
        actions = rng.integers(alone.single_action_space.n, size=(50, SIDE_BY_SIDE))
        times = []
        for env in (alone, wrapped):
            start = time.process_time()
            for action in actions:
                env.step(action)
            times.append(time.process_time() - start)
        added += times[1] - times[0]
        played += actions.size
    bonus = Clock()
    curiosity = CuriosityReward(again(config), seed=config.seed).appraisal.curiosity
    for name in ("bonus", "remember"):
        bonus.time(curiosity, name)
    for episode, returns in episodes:
        curiosity.bonus(episode)
        curiosity.remember(episode, returns)
    remembered = sum(len(episode) for episode, _ in episodes)
    paid = remembered + sum(len(one) for one in wrapped.appraisal.recordings if one is not None)
    return {"trainer_random": 1e6 * bonus.seconds / remembered, "vector": 1e6 * added / paid}


class Clock:
    """The CPU time that some functions took."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def time(self, owner: Any, name: str) -> None:
        """Add the time of `owner.name` from now on."""
        function = getattr(owner, name)

        def timed(*arguments: Any) -> Any:
            start = time.process_time()
            result = function(*arguments)
            self.seconds += time.process_time() - start
            return result

        setattr(owner, name, timed)


def kept(owner: Any, name: str) -> list[tuple[Any, ...]]:
    """The arguments of every call of `owner.name` from now on."""
    function, found = getattr(owner, name), []

    def keeping(*arguments: Any) -> Any:
        found.append(arguments)
        return function(*arguments)

    setattr(owner, name, keeping)
    return found


def again(config: "RunConfig") -> gymnasium.Env:
    """The environment of a run as it was before its first episode."""
    from mace_rl.environments.environment import Environment
    from mace_rl.streams import Streams

    seed = Streams(config.seed).sequence("environment")
    return Environment(config.environment, seed, config.max_episode_steps).env


def replay(env: gymnasium.Env, actions: list[int]) -> float:
    """The CPU time of an episode with these actions, reset included."""
    start = time.process_time()
    env.reset()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
    assert terminated or truncated
    return time.process_time() - start
