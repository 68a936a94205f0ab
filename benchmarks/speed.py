"""Steps per second of everything in `settings.LABELS`, in turn: results.csv.

What is timed are iterators that work while they are iterated over and yield the environment steps
done so far, whenever that is known. What happens before the first `next` is not timed.
"""

import platform
import time
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0)

from benchmarks.process import in_fresh_process, memory_mb, write_rows
from benchmarks.settings import ENVIRONMENTS, FIRST_SEED, OURS, ROOT, Scale, contestants

if TYPE_CHECKING:  # imported where it is used: the others' memory should not hold it
    from mace_rl.config.run import RunConfig

# Steps of training before the clock starts: imports, compilation and the first updates are over.
WARM_UP_STEPS = 2048
ENDLESS = 10**9  # episodes
PACKAGES = "torch numpy numba gymnasium pybullet pybullet-envs-gymnasium stable-baselines3"


def measure_all(scale: Scale) -> None:
    """Carry out all measurements and write results.csv, anew after each."""
    from mace_rl.runs.provenance import cpu_model

    rows = []
    everybody = {environment: contestants(environment) for environment in ENVIRONMENTS}
    for repeat, environment, contestant in schedule(scale.repeats, everybody):
        stops = marks(scale, environment, contestant)
        seed = FIRST_SEED + repeat
        for reading in in_fresh_process(measure, contestant, environment, seed, stops):
            identity = {"env": environment, "contestant": contestant, "repeat": repeat}
            rows.append(identity | reading | {"cpu": cpu_model(), "versions": versions()})
        write_rows(scale.data / "results.csv", rows)
        rate = rows[-1]["steps_per_second"]
        print(f"repeat {repeat + 1}: {environment} {contestant}: {rate:.0f} steps/s", flush=True)


def versions() -> str:
    """Of Python and of what everybody computes with."""
    found = [f"{name} {metadata.version(name)}" for name in PACKAGES.split()]
    return ", ".join([f"python {platform.python_version()}", *found])


def schedule(repeats: int, everybody: Mapping[str, list[str]]) -> Iterator[tuple[int, str, str]]:
    """(repeat, environment, contestant), in turn; every repeat begins with another contestant.

    So whatever slows the machine down for a while, or warms it up, hits everybody.
    """
    for repeat in range(repeats):
        for environment, names in everybody.items():
            first = repeat % len(names)
            for contestant in names[first:] + names[:first]:
                yield repeat, environment, contestant


def marks(scale: Scale, environment: str, contestant: str) -> list[int]:
    """The numbers of steps at which the clock is read."""
    if contestant.startswith("environment"):
        return [scale.environment_steps[environment]]
    later = [scale.later_steps[environment]] if contestant in OURS else []
    return [scale.steps[environment], *later]


def measure(contestant: str, environment: str, seed: int, stops: list[int]) -> list[dict[str, Any]]:
    """The readings of one training, after another one as a warm-up."""
    warm_up(contestant, environment, seed)
    return read_clock(start(contestant, environment, seed, stops[-1]), stops)


def warm_up(contestant: str, environment: str, seed: int) -> None:
    """A short training with another seed."""
    read_clock(start(contestant, environment, seed + 10**6, WARM_UP_STEPS), [WARM_UP_STEPS])


def read_clock(progress: Iterable[int], stops: list[int]) -> list[dict[str, Any]]:
    """Iterate until the last of `stops` steps is reached, reading the clock at each of them.

    `steps`, those actually done, can be a little more: updates follow whole episodes.
    """
    readings: list[dict[str, Any]] = []
    seconds, cpu_seconds = time.perf_counter(), time.process_time()
    for steps in progress:
        while steps >= stops[len(readings)]:
            elapsed = time.perf_counter() - seconds
            readings.append(
                {
                    "target_steps": stops[len(readings)],
                    "steps": steps,
                    "seconds": elapsed,
                    "cpu_seconds": time.process_time() - cpu_seconds,
                    "steps_per_second": steps / elapsed,
                    "peak_memory_mb": memory_mb("VmHWM"),
                }
            )
            if len(readings) == len(stops):
                return readings
    raise RuntimeError(f"ended after {steps} steps, before {stops[-1]}")


def start(contestant: str, environment: str, seed: int, steps: int) -> Iterator[int]:
    """Prepare `contestant` for at least `steps` steps in `environment`."""
    match contestant:
        case "environment":
            return alone(gymnasium.make(environment, disable_env_checker=True), seed, steps)
        case "environment_fast":
            from mace_rl.environments.environment import Environment
            from mace_rl.streams import Streams

            ours = Environment(environment, Streams(seed).sequence("environment"))
            return alone(ours.env, seed, steps)
        case "sb3_default":
            return stable_baselines3(environment, seed, steps)
        case "sb3_2048x4":
            full_batch = {"n_steps": 2048, "batch_size": 2048, "n_epochs": 4}
            return stable_baselines3(environment, seed, steps, **full_batch)
        case _:
            from mace_rl.train import Trainer

            trainer = Trainer(our_config(contestant, environment, seed))
            return (records[-1].env_steps for records in trainer.run())


def our_config(contestant: str, environment: str, seed: int) -> "RunConfig":
    """The study's settings of one of `OURS`, but without an end."""
    from mace_rl.config.study import read_study

    config = read_study([ROOT / "config.yaml"]).run_config(environment, OURS[contestant], seed)
    whole = {"rollout_steps": 2048, "minibatch_size": None} if contestant == "ppo_2048" else {}
    ppo = config.ppo.model_copy(update=whole)
    return config.model_copy(update={"ppo": ppo, "episodes": ENDLESS})


def alone(env: gymnasium.Env, seed: int, steps: int) -> Iterator[int]:
    """Random actions, drawn beforehand; resets are part of the work."""
    rng = np.random.default_rng(seed)
    if isinstance(env.action_space, gymnasium.spaces.Discrete):
        actions = rng.integers(env.action_space.n, size=steps).tolist()
    else:
        size = (steps, *env.action_space.shape)
        actions = list(rng.uniform(-1, 1, size).astype(np.float32))
    env.reset(seed=seed)

    def play() -> Iterator[int]:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        yield steps

    return play()


def stable_baselines3(environment: str, seed: int, steps: int, **settings: int) -> Iterator[int]:
    """stable-baselines3's PPO; `settings` are its own, all others its defaults."""
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", environment, seed=seed, device="cpu", **settings)

    def learn() -> Iterator[int]:
        model.learn(steps)
        yield model.num_timesteps

    return learn()
