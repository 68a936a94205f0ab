"""Environment steps per CPU second of ours and stable-baselines3's PPO, in turn.

What is timed are iterators that work while they are iterated over and yield the environment steps
done so far. What happens before the first `next` is not timed.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pybullet_envs_gymnasium  # noqa: F401  (registers HopperBulletEnv-v0)

from benchmarks.measuring import (
    ENVIRONMENTS,
    FIRST_SEED,
    HOPPER,
    Scale,
    in_fresh_process,
    memory_mb,
)

if TYPE_CHECKING:  # imported where it is used: the others' memory should not hold it
    from mace_rl.config.run import RunConfig

REFERENCE = "sb3_2048x4"  # the faster of the two peers: ratios are to it
# Ours, and their variants, with the study's settings but for the first.
OURS = {"ppo_2048": "ppo", "ppo": "ppo", "mace_full": "mace_full"}
# Everything that is timed, and its name in tables.
LABELS = {
    "environment": "environment alone, the library's",
    "environment_ours": "environment alone, ours",
    "sb3": "stable-baselines3 PPO, defaults",
    REFERENCE: "stable-baselines3 PPO, 2048 steps, 4 full-batch epochs",
    "ppo_2048": "our PPO, 2048 steps, 4 full-batch epochs",
    "ppo": "our PPO, an update per episode (default)",
    "mace_full": "our mace_full",
}
# Steps of training before the clock starts: imports, compilation and the first updates are over.
WARM_UP_STEPS = 20_480  # with 6,144 three kernels of the paper's network were still to be compiled
PEER_WARM_UP_STEPS = 2048
ENDLESS = 10**9  # episodes


def measure(scale: Scale) -> list[dict[str, Any]]:
    """A row for each reading."""
    everybody = {
        environment: [who for who in LABELS if who != "environment_ours" or environment == HOPPER]
        for environment in ENVIRONMENTS
    }
    return in_turn(scale, everybody, reading)


def in_turn(
    scale: Scale, everybody: Mapping[str, list[str]], read: Callable[..., dict[str, Any]]
) -> list[dict[str, Any]]:
    """`read(contestant, environment, seed, steps)` of each, a row for each.

    Every repeat begins with another contestant: whatever slows the machine down for a while hits
    everybody.
    """
    rows: list[dict[str, Any]] = []
    for repeat in range(scale.repeats):
        for environment, names in everybody.items():
            first = repeat % len(names)
            for contestant in names[first:] + names[:first]:
                peer = contestant.startswith(("environment", "sb3"))
                steps = (scale.peer_steps if peer else scale.steps)[environment]
                found = read(contestant, environment, FIRST_SEED + repeat, steps)
                identity = {"env": environment, "contestant": contestant, "repeat": repeat}
                rows.append(identity | found)
                rate = found["steps"] / found["cpu_seconds"]
                print(f"{repeat + 1}: {environment} {contestant}: {rate:.0f} steps/s", flush=True)
    return rows


def reading(contestant: str, environment: str, seed: int, steps: int) -> dict[str, Any]:
    """Of one training of at least `steps` steps, in a process of its own."""
    return in_fresh_process(warm_reading, contestant, environment, seed, steps)


def warm_reading(contestant: str, environment: str, seed: int, steps: int) -> dict[str, Any]:
    """The same, in this process, after a short training with another seed."""
    warm_up(contestant, environment, seed)
    return read_clock(start(contestant, environment, seed, steps), steps)


def warm_up(contestant: str, environment: str, seed: int) -> None:
    """A short training with another seed."""
    steps = WARM_UP_STEPS if contestant in OURS else PEER_WARM_UP_STEPS
    read_clock(start(contestant, environment, seed + 10**6, steps), steps)


def read_clock(progress: Iterable[int], stop: int) -> dict[str, Any]:
    """Time until `stop` steps are reached; `steps` can be a little more: whole episodes."""
    seconds, cpu_seconds = time.perf_counter(), time.process_time()
    for steps in progress:
        if steps >= stop:
            times = {"seconds": time.perf_counter() - seconds}
            times |= {"cpu_seconds": time.process_time() - cpu_seconds}
            return {"steps": steps} | times | {"memory_mb": memory_mb("VmHWM")}
    raise RuntimeError(f"ended before {stop} steps")


def start(contestant: str, environment: str, seed: int, steps: int) -> Iterator[int]:
    """Prepare `contestant` for at least `steps` steps in `environment`."""
    match contestant:
        case "environment":
            return alone(made(environment), seed, steps)
        case "environment_ours":
            from mace_rl.base.rng import Streams
            from mace_rl.environments.environment import Environment

            ours = Environment(environment, Streams(seed).sequence("environment"))
            return alone(ours.env, seed, steps)
        case "sb3":
            return stable_baselines3(environment, seed, steps)
        case "sb3_2048x4":
            full_batch = {"n_steps": 2048, "batch_size": 2048, "n_epochs": 4}
            return stable_baselines3(environment, seed, steps, **full_batch)
        case _:
            from mace_rl.training.trainer import Trainer

            trainer = Trainer(our_config(contestant, environment, seed))
            return (records[-1].env_steps for records in trainer.run())


def our_config(contestant: str, environment: str, seed: int) -> "RunConfig":
    """The study's settings of one of `OURS`, but without an end."""
    from mace_rl.library import settings

    config = settings(environment, OURS[contestant], seed=seed)
    whole = {"rollout_steps": 2048, "minibatch_size": None} if contestant == "ppo_2048" else {}
    ppo = config.ppo.model_copy(update=whole)
    return config.model_copy(update={"ppo": ppo, "episodes": ENDLESS})


def made(environment: str) -> gymnasium.Env:
    """The library's."""
    return gymnasium.make(environment, disable_env_checker=True)


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

    model = PPO("MlpPolicy", made(environment), seed=seed, device="cpu", **settings)

    def learn() -> Iterator[int]:
        model.learn(steps)
        yield model.num_timesteps

    return learn()
