"""The state of an environment: saved for resuming, checked by playing the last episodes again."""

import hashlib
import itertools
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from mace_rl.base.state import saved
from mace_rl.environments.environment import Environment
from mace_rl.environments.episode import Episode
from mace_rl.environments.remembered import layers, remembered, restore
from mace_rl.training.rollout import roll_out

EPISODES, STEPS = 10, 1000  # after either of which a block of episodes is full
# Environments of these modules remember nothing from one episode to the next but their generator,
# nor do Gymnasium's plain wrappers around them.
FORGETFUL = ("gymnasium.envs.classic_control.", "gymnasium.envs.toy_text.", "mace_rl.environments.")
PLAIN_WRAPPERS = "gymnasium.wrappers.common"


def state_of(environment: Environment, of_process: bool = True) -> dict[str, Any]:
    """What the next episode depends on, as far as it can be known.

    The environment's generator, what is `remembered` of it, and, which takes longer, the global
    generators if `of_process`.
    """
    generator = _plain(environment.generator.bit_generator.state)
    state = {"np_random": generator, "remembered": remembered(environment.env)}
    return state | global_state() if of_process else state


def set_state(environment: Environment, state: dict[str, Any]) -> None:
    """Restore what `state_of` returned."""
    restore(environment.env, state["remembered"])
    environment.generator.bit_generator.state = state["np_random"]
    if "random" in state:
        set_global_state(state)


def global_state() -> dict[str, Any]:
    """That of Python's, NumPy's and, if the process has imported it, PyTorch's generators."""
    state = {
        "random": random.getstate(),
        "numpy": _plain(np.random.get_state(legacy=False)),  # noqa: NPY002
    }
    torch = sys.modules.get("torch")
    return state | {"torch": torch.get_rng_state()} if torch else state


def set_global_state(state: dict[str, Any]) -> None:
    """Restore what `global_state` returned."""
    random.setstate(state["random"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    if "torch" in state:
        import torch

        torch.set_rng_state(state["torch"])


@contextmanager
def seeded(seed: np.random.SeedSequence) -> Iterator[None]:
    """Code that draws from the global generators repeats itself; afterwards they are as before."""
    before = global_state()
    first, *others = seed.generate_state(6).tolist()
    random.seed(first)
    np.random.seed(others[:4])  # noqa: NPY002
    if torch := sys.modules.get("torch"):
        torch.manual_seed(others[4])
    try:
        yield
    finally:
        set_global_state(before)


def is_forgetful(environment: Environment) -> bool:
    """Whether the generator is known to be all that its next episode depends on."""
    env = environment.env
    plain = all(type(layer).__module__ == PLAIN_WRAPPERS for layer in layers(env))
    return plain and type(env.unwrapped).__module__.startswith(FORGETFUL)


class LastEpisodes:
    """The last episodes, and the state before each; of those in a checkpoint actions and a digest.

    They are in two blocks. The global generators are saved before the first episode of a block.
    Nothing is kept of an environment that `is_forgetful`.
    """

    def __init__(self, environment: Environment) -> None:
        self.blocks: list[list[dict[str, Any]]] = [[]]
        self.kept = not is_forgetful(environment)

    def begin(self, environment: Environment) -> None:
        """Before an episode."""
        if not self.kept:
            return
        block = self.blocks[-1]
        if len(block) >= EPISODES or sum(len(played["actions"]) for played in block) >= STEPS:
            self.blocks = [block, []]
        self.blocks[-1].append({"start": state_of(environment, of_process=not self.blocks[-1])})

    def end(self, episode: Episode) -> None:
        """After an episode."""
        if self.kept:
            self.blocks[-1][-1] |= {"actions": episode.actions, "outcome": episode}

    def saved(self) -> list[list[dict[str, Any]]]:
        """For a checkpoint."""
        for played in itertools.chain.from_iterable(self.blocks):
            if isinstance(episode := played["outcome"], Episode):
                played |= {"actions": saved(episode.actions), "outcome": _digest(episode)}
        return self.blocks


def replay_differs(environment: Environment, blocks: list[list[dict[str, Any]]]) -> str:
    """What is different if a new environment plays `LastEpisodes.blocks` again; "" if nothing."""
    for played in itertools.chain.from_iterable(blocks):
        set_state(environment, played["start"])
        try:
            episode = roll_out(environment, _Again(), played["actions"].numpy())
        except Exception as error:  # noqa: BLE001  (whatever it raises, in a state it never had)
            return " ".join(f"{type(error).__name__}: {error}".split())
        if _digest(episode) != played["outcome"]:
            return "other observations or rewards"
    return ""


class _Again:  # an `ActingPolicy` whose noise are the actions to take
    def act(self, observation: np.ndarray, noise: Any) -> tuple[Any, np.float32]:
        return (noise if isinstance(noise, np.ndarray) else int(noise)), np.float32(0)


def _digest(episode: Episode) -> str:
    parts = (episode.observations, episode.rewards, np.array(float(episode.terminated)))
    # + 0: compiled code may have -0.0 where the environment has 0.0, which is no difference.
    return hashlib.sha256(b"".join((part + 0).tobytes() for part in parts)).hexdigest()


def _plain(state: Any) -> Any:  # a NumPy generator's state with lists for its arrays
    if isinstance(state, dict):
        return {key: _plain(value) for key, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state
