"""The curiosity bonus for any agent: wrappers that add β · R_curiosity to an environment's reward.

    env = CuriosityReward(gymnasium.make("FrozenLake-v1"))  # and everything else as without

    reward = R_extrinsic + β · u · (R_curiosity - m),      u = s_E / s_I

R_curiosity, in [0, 1], and β are the trainer's. The trainer weighs advantages in units of their
scale; a wrapper sees rewards only, and leaves the extrinsic one as it is. So u brings the bonus to
its unit: s_E is the standard deviation of the discounted sums of the extrinsic reward in all
episodes so far (`RewardScale`), at least 1, and s_I the size of those of R_curiosity - m
(`CuriosityScale`). With β = 0.4 the bonus is 0.4 times as large as the extrinsic reward, or 0.4 if
that varies by less than 1.

m is the mean of R_curiosity over the last twenty steps or so. Without it every step would pay, and
an agent with one critic would rather not end an episode; with the mean of all steps so far every
step would cost, since novelty falls: docs/wrappers.md has what was measured. The trainer has a
critic for each reward. `centred=False` leaves m out, as in the paper.

β and u are constant during an episode. At its end the episode becomes memory, novelty is updated,
and both are set for the next. In the first episode u is 0: no bonus is paid yet. An episode that is
reset before it ends, as by a time limit around this wrapper, ends there; where `reset` gets a seed,
so that all begins afresh, it is forgotten.
"""

from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import iterate

from mace_rl.config.section import ConfigError, check
from mace_rl.config.wrappers import CuriosityConfig
from mace_rl.environments.environment import stepped
from mace_rl.environments.remembered import layers
from mace_rl.environments.spaces import Spaces
from mace_rl.runs.checkpoint import require_plain
from mace_rl.wrapping.curiosity_tracker import PARTS, CuriosityTracker

Settings = Mapping[str, Any]


class CuriosityMixin(RecordConstructorArgs):
    """What both wrappers have; `CuriosityReward` says what the arguments mean."""

    def __init__(
        self,
        env: Any,
        beta: float | str | Settings = 0.4,
        *,
        relevance: bool = True,
        centred: bool = True,
        memory: Settings | None = None,
        novelty: Settings | None = None,
        meta: Settings | None = None,
        discount: float = 0.99,
        rollout_steps: int = 1,
        seed: int = 0,
    ) -> None:
        settings = given(locals())
        RecordConstructorArgs.__init__(self, **settings)  # for `spec`, from which it can be remade
        super(RecordConstructorArgs, self).__init__(env)  # type: ignore[call-arg]  # Gymnasium's
        config = check(CuriosityConfig, settings, type(self).__name__)
        count, spaces = 1, (env.observation_space, env.action_space)
        if any(isinstance(layer, gymnasium.wrappers.Autoreset) for layer in layers(env)):
            raise ConfigError("Autoreset belongs outside: Autoreset(CuriosityReward(env))")
        if isinstance(env, VectorEnv):
            count, spaces = env.num_envs, (env.single_observation_space, env.single_action_space)
            self.mode = env.metadata.get("autoreset_mode")
            if not isinstance(self.mode, AutoresetMode):
                raise ConfigError(
                    f"environment {name_of(env)!r} has {self.mode!r} as metadata['autoreset_mode'],"
                    " but it should be one of gymnasium.vector.AutoresetMode"
                )
        self.tracker = CuriosityTracker(config, Spaces(name_of(env), *spaces, in_part=True), count)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the bonus depends on, the unfinished episode included.

        Numbers, texts, lists, dictionaries and tensors, which `torch.load` reads with
        `weights_only`; `CheckpointError` if a rule for β has others. The states of the environment
        and the agent are not in it. From dozens of processes of a SubprocVecEnv each tensor takes
        an open file, unless these call `torch.multiprocessing.set_sharing_strategy("file_system")`.
        """
        state = self.tracker.state_dict()
        require_plain(state, "the state")
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned; `ConfigError` if other settings made it."""
        self.tracker.load_state_dict(state)


class CuriosityReward(CuriosityMixin, gymnasium.Wrapper[Any, Any, Any, Any]):
    """Adds β · R_curiosity to the reward of an environment; see the module for what that means.

    env: observations are of any space that has a flat form, and the agent gets them unchanged;
        actions are Discrete, MultiDiscrete, MultiBinary or Box. Episodes have to end, by a time
        limit or a reset: nothing is learned from one that does not.
    beta: a number in [0, 10], "learned" for the paper's network as in config.yaml's mace_full, or a
        rule as there: {"kind": "exponential", …}, "custom", or "meta" with an `objective` that asks
        for returns alone. The network learns from returns as the agent's episodes end.
    centred: False to pay R_curiosity itself, not what it is beyond its present mean.
    relevance: False for novelty alone, without memory; `memory` is then refused.
    memory, novelty, meta: settings that differ from config.yaml's (`mace_rl.config.wrappers`), by
        name; meta is the network that learns β.
    discount: γ of the agent (gamma in stable-baselines3), per step.
    rollout_steps: steps between the agent's updates (n_steps there), for rules that ask.
    seed: of the bonus's random numbers; `reset(seed=…)` is the environment's.

    `info` of a step gets `PARTS`, each a float: `reward_extrinsic` and `reward_curiosity`, whose
    sum is the reward, in the environment's unit; R_curiosity in [0, 1], as `curiosity`, with its
    factors `novelty` and `relevance`; and `beta`.

    Memory holds the discounted return-to-go of each state to the end of its episode. There is no
    critic as in the trainer: nothing is added beyond a time limit.

    Raises `ConfigError`, one line, for settings and spaces that do not work and observations of
    another size, and `NonFiniteError` for rewards, observations or bonuses that are not numbers.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self.tracker.begin(0, observation, afresh=seed is not None)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step, with another reward and more in `info`."""
        recorded = self.tracker.as_recorded(action)
        taken = stepped(self.env, action, self.tracker.spaces.name, self.tracker.steps_of(0) + 1)
        observation, reward, terminated, truncated, info = taken
        parts = self.tracker.reward_parts(0, recorded, reward, observation)
        if terminated or truncated:
            self.tracker.end(0, bool(terminated))
        total = parts["reward_extrinsic"] + parts["reward_curiosity"]
        return observation, total, terminated, truncated, {**(info or {}), **parts}


# Gymnasium's class takes no types as arguments before its version 1.3.
class VectorCuriosityReward(CuriosityMixin, gymnasium.vector.VectorWrapper):
    """`CuriosityReward` for environments that are stepped together and share memory and novelty.

    An episode in one of them is known in all as soon as it has ended. Arguments are those of
    `CuriosityReward`. Its entries of `info` are arrays, float64 [environments], with Gymnasium's
    masks: an environment that was only reset gets no bonus. All modes of autoreset work. The
    entries for the last step of an episode are in `infos`, not in `final_info`.
    """

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """The environments' reset; of those in `options["reset_mask"]` if that is there."""
        chosen = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        observations, infos = self.env.reset(seed=seed, options=options)
        seen = self._apart(observations)
        for i in np.flatnonzero(chosen).tolist():
            self.tracker.begin(i, seen[i], afresh=seed is not None)
        return observations, infos

    def _apart(self, observations: Any) -> Any:
        """By environment; of a Dict or Tuple space there are arrays of the parts."""
        if isinstance(observations, np.ndarray):
            return observations
        return list(iterate(self.env.observation_space, observations))

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """The environments' step, with other rewards, float64, and more in `infos`."""
        recorded = [self.tracker.as_recorded(action) for action in actions]
        name = self.tracker.spaces.name
        number = 1 + max(map(self.tracker.steps_of, range(self.num_envs)))
        observations, rewards, terminated, truncated, infos = stepped(
            self.env, actions, name, number
        )
        if not isinstance(infos, Mapping):
            raise ConfigError(
                f"environment {name!r} gave {type(infos).__name__} as infos of its step, but they "
                "should be a mapping from names to arrays"
            )
        ended = terminated | truncated
        reached = seen = self._apart(observations)
        if self.mode is AutoresetMode.SAME_STEP and ended.any():
            if "final_obs" not in infos:
                raise ConfigError(
                    f"environment {name!r} declares AutoresetMode.SAME_STEP, but the infos of a "
                    "step that ends an episode have no 'final_obs'"
                )
            final = self._apart(infos["final_obs"])
            reached = [final[i] if ended[i] else seen[i] for i in range(self.num_envs)]
        over = np.array([recording is None for recording in self.tracker.recordings])
        fresh = over & (self.mode is AutoresetMode.NEXT_STEP)  # only reset
        values = np.zeros((len(PARTS), self.num_envs))
        for i in np.flatnonzero(~fresh).tolist():
            parts = self.tracker.reward_parts(i, recorded[i], rewards[i], reached[i])
            values[:, i] = list(parts.values())
        for i in np.flatnonzero(ended).tolist():
            self.tracker.end(i, bool(terminated[i]))
        for i in np.flatnonzero(ended if self.mode is AutoresetMode.SAME_STEP else fresh).tolist():
            self.tracker.begin(i, seen[i])
        total = np.where(fresh, rewards, values[0] + values[1])  # extrinsic and curiosity
        added = dict(zip(PARTS, values, strict=True))
        masks = dict.fromkeys((f"_{name}" for name in PARTS), ~fresh)
        return observations, total, terminated, truncated, {**infos, **added, **masks}


def given(arguments: dict[str, Any]) -> dict[str, Any]:
    """The settings among a constructor's arguments, without sections that are None."""
    found = {name: arguments[name] for name in CuriosityConfig.model_fields}
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in found.items()
        if value is not None or name not in ("memory", "novelty", "meta")
    }


def name_of(env: Any) -> str:
    """What an environment is called in messages."""
    return str(env) if env.spec is None else env.spec.id
