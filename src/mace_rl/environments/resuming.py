"""What an environment draws from and remembers: saved for resuming, and checked by a replay."""

import copy
import hashlib
import random
from typing import Any

import numpy as np
import torch

from mace_rl.environments.environment import Environment
from mace_rl.environments.rollout import Episode, roll_out

EPISODES, STEPS = 10, 1000  # at most that are played again, one however long
OFFERED = "load_state_dict"  # by an environment, beside `state_dict`


def state_of(environment: Environment) -> dict[str, Any]:
    """All that can be known of what the next episode depends on: generators, those of the process
    too, and what the environment's own `state_dict()` says, if it has one.
    """
    inner: Any = environment.env.unwrapped
    return {
        "np_random": _plain(environment.generator.bit_generator.state),
        "own": copy.deepcopy(inner.state_dict()) if hasattr(inner, OFFERED) else None,
        "random": random.getstate(),
        "numpy": _plain(np.random.get_state(legacy=False)),  # noqa: NPY002
        "torch": torch.get_rng_state(),
    }


def set_state(environment: Environment, state: dict[str, Any]) -> None:
    """Let environment and process go on from what `state_of` returned."""
    inner: Any = environment.env.unwrapped
    if state["own"] is not None:
        inner.load_state_dict(copy.deepcopy(state["own"]))
    environment.generator.bit_generator.state = state["np_random"]
    random.setstate(state["random"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])


def remember(
    earlier: list[dict[str, Any]], start: dict[str, Any], episode: Episode
) -> list[dict[str, Any]]:
    """The last episodes, this one too, for `replay_differs`: state at the start, actions, outcome.

    start: what `state_of` returned before it. A few episodes, of `STEPS` together: they are small.
    """
    actions = torch.from_numpy(episode.actions)
    kept = [*earlier, {"start": start, "actions": actions, "outcome": _digest(episode)}]
    while len(kept) > EPISODES or sum(len(one["actions"]) for one in kept[:-1]) > STEPS:
        del kept[0]
    return kept


def replay_differs(environment: Environment, last: list[dict[str, Any]]) -> str:
    """How a fresh environment, given their actions again, plays episodes otherwise; "" if not.

    What it kept from them for later it then has kept again.
    """
    for one in last:
        set_state(environment, one["start"])
        try:
            episode = roll_out(environment, _Again(), one["actions"].numpy())
        except Exception as error:  # noqa: BLE001  (whatever it raises, in a state it never had)
            return " ".join(f"{type(error).__name__}: {error}".split())
        if _digest(episode) != one["outcome"]:
            return "other observations or rewards"
    return ""


class _Again:
    """A policy whose noise are the actions to take."""

    def act(self, observation: np.ndarray, noise: Any) -> tuple[Any, np.float32]:
        return (noise if isinstance(noise, np.ndarray) else int(noise)), np.float32(0)


def _digest(episode: Episode) -> str:
    parts = (episode.observations, episode.rewards, np.array(float(episode.terminated)))
    # + 0: compiled code may have -0.0 where the environment has 0.0, which is no difference.
    return hashlib.sha256(b"".join((part + 0).tobytes() for part in parts)).hexdigest()


def _plain(state: Any) -> Any:
    """A NumPy generator's state with lists for its arrays."""
    if isinstance(state, dict):
        return {key: _plain(value) for key, value in state.items()}
    return state.tolist() if isinstance(state, np.ndarray) else state
