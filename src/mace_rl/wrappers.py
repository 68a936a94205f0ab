"""The curiosity bonus for any agent: wrappers that add β · R_curiosity to an environment's reward.

    env = CuriosityReward(gymnasium.make("FrozenLake-v1"))  # and everything else as without

    reward = R_extrinsic + β · u · R_curiosity,      u = s_E / s_I

R_curiosity, in [0, 1], and β are the trainer's. The trainer weighs advantages, each in units of
their scale; a wrapper sees rewards only. So u brings the bonus to the unit of the extrinsic reward,
which is left as it is: s_E and s_I are the standard deviations of the discounted sums of either
reward in all episodes so far (`RewardScale`), s_E at least 1. β = 0.4 hence means that what the
bonus adds up to varies 0.4 times as much as what the environment pays, or as 1 if that varies less.

β and u belong to an episode and hold from its beginning to its end. With it the episode becomes
memory, all novelty is updated, and β is set anew. Before the first end u is not known: it is 0, and
nothing is paid yet. From an episode that is reset before it ends nothing is learnt.
"""

import copy
import math
from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Discrete
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv

from mace_rl.agent.advantages import generalised_advantages
from mace_rl.agent.ppo import TINY
from mace_rl.agent.scale import RewardScale
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.bonus.stepwise import StepwiseCuriosity
from mace_rl.config.run import CustomBeta
from mace_rl.config.section import ConfigError, check, short
from mace_rl.config.wrappers import CuriosityConfig
from mace_rl.environments.rollout import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.factories import beta_rule
from mace_rl.finite import require_finite, require_share
from mace_rl.streams import Streams

Settings = Mapping[str, Any]
# What a step's `info` gets, float.
PARTS = ("reward_extrinsic", "reward_curiosity", "curiosity", "novelty", "relevance", "beta")


class CuriosityReward(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Adds β · R_curiosity to the reward of an environment; see the module for what that means.

    env: observations are arrays of one shape (Box; they are flattened) or Discrete, actions are
        Discrete or one-dimensional; Gymnasium's `FlattenObservation` makes vectors of others. Its
        episodes have to end, if need be by a time limit: nothing is learnt from one that does not.
    beta: a number in [0, 1], or a rule that sets β for each episode, as in config.yaml: {"kind":
        "exponential", …}, "random", "bandit", "custom". Not "meta", which learns from policy
        gradients.
    relevance: False for novelty alone, without the memory.
    memory, novelty: what differs from the study's settings (`mace_rl.config.wrappers`), by name.
    discount: γ of the agent (gamma in stable-baselines3), per step.
    rollout_steps: steps between the agent's updates (n_steps there); only a bandit asks for it.
    seed: of what is drawn here; `reset(seed=…)` is the environment's.

    `info` of a step gets `PARTS`, each a float: `reward_extrinsic` and `reward_curiosity`, whose
    sum is the reward, in the environment's unit; R_curiosity in [0, 1], as `curiosity`, with its
    factors `novelty` and `relevance`; and `beta`.

    Memory holds the discounted return-to-go of each state until the episode ended. The trainer's
    λ-returns take a critic: here what a time limit cut off counts as nothing.

    Raises `ConfigError`, one line, for settings and spaces that do not work and observations that
    are not of their space's size, and `NonFiniteError` for a reward, an observation or a bonus that
    is not a number.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        beta: float | Settings = 0.4,
        *,
        relevance: bool = True,
        memory: Settings | None = None,
        novelty: Settings | None = None,
        discount: float = 0.99,
        rollout_steps: int = 1,
        seed: int = 0,
    ) -> None:
        settings = given(
            beta=beta,
            relevance=relevance,
            memory=memory,
            novelty=novelty,
            discount=discount,
            rollout_steps=rollout_steps,
            seed=seed,
        )
        RecordConstructorArgs.__init__(self, **settings)  # for `spec`, from which it can be remade
        gymnasium.Wrapper.__init__(self, env)
        config = check(CuriosityConfig, settings, type(self).__name__)
        spaces = Spaces(name_of(env), env.observation_space, env.action_space)
        self.appraisal = Appraisal(config, spaces, 1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """The environment's reset."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.appraisal.begin(0, observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """The environment's step, with another reward and more in `info`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        parts = self.appraisal.pay(0, action, float(reward), observation)
        if terminated or truncated:
            self.appraisal.end(0, bool(terminated))
        total = parts["reward_extrinsic"] + parts["reward_curiosity"]
        return observation, total, terminated, truncated, {**info, **parts}

    def state_dict(self) -> dict[str, Any]:
        """All that the rest of a training depends on here, unfinished episode included.

        Numbers, texts, lists, dictionaries and tensors, which `torch.load` reads with
        `weights_only`. The environment's and the agent's state are not in it.
        """
        return self.appraisal.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned; `ConfigError` if other settings made it."""
        self.appraisal.load_state_dict(state)


class VectorCuriosityReward(gymnasium.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    """`CuriosityReward` for environments that are stepped together and share what is known.

    What was seen in one of them is known in all as soon as its episode has ended. Arguments are
    those of `CuriosityReward`; what it adds to `info` are arrays here, float64 [environments], with
    Gymnasium's masks: nothing is paid where an environment was only reset. All modes of autoreset
    work. Of a step that ended an episode, what was paid stands in `infos`, not in `final_info`.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        beta: float | Settings = 0.4,
        *,
        relevance: bool = True,
        memory: Settings | None = None,
        novelty: Settings | None = None,
        discount: float = 0.99,
        rollout_steps: int = 1,
        seed: int = 0,
    ) -> None:
        settings = given(
            beta=beta,
            relevance=relevance,
            memory=memory,
            novelty=novelty,
            discount=discount,
            rollout_steps=rollout_steps,
            seed=seed,
        )
        super().__init__(env)
        self.mode = env.metadata.get("autoreset_mode")
        if not isinstance(self.mode, AutoresetMode):
            raise ConfigError(
                f"environment {name_of(env)!r} has {self.mode!r} as metadata['autoreset_mode'], "
                "but it should be one of gymnasium.vector.AutoresetMode"
            )
        config = check(CuriosityConfig, settings, type(self).__name__)
        spaces = Spaces(name_of(env), env.single_observation_space, env.single_action_space)
        self.appraisal = Appraisal(config, spaces, self.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """The environments' reset; of those in `options["reset_mask"]` if that is there."""
        chosen = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        observations, infos = self.env.reset(seed=seed, options=options)
        for i in np.flatnonzero(chosen).tolist():
            self.appraisal.begin(i, observations[i])
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """The environments' step, with other rewards, float64, and more in `infos`."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = terminated | truncated
        reached = observations
        if self.mode is AutoresetMode.SAME_STEP and ended.any():
            final = infos["final_obs"]
            reached = [final[i] if ended[i] else observations[i] for i in range(self.num_envs)]
        fresh = np.zeros(self.num_envs, np.bool_)
        if self.mode is AutoresetMode.NEXT_STEP:
            fresh = ~self.appraisal.going_on()
        played = [i for i, new in enumerate(fresh.tolist()) if not new]
        paid = [self.appraisal.pay(i, actions[i], float(rewards[i]), reached[i]) for i in played]
        for i in np.flatnonzero(ended).tolist():
            self.appraisal.end(i, bool(terminated[i]))
        for i in np.flatnonzero(ended if self.mode is AutoresetMode.SAME_STEP else fresh).tolist():
            self.appraisal.begin(i, observations[i])
        values = np.zeros((len(PARTS), self.num_envs))
        for i, parts in zip(played, paid, strict=True):
            values[:, i] = [parts[name] for name in PARTS]
        total = np.where(fresh, rewards, values[0] + values[1])  # extrinsic and curiosity
        told = dict(zip(PARTS, values, strict=True))
        masks = dict.fromkeys((f"_{name}" for name in PARTS), ~fresh)
        return observations, total, terminated, truncated, {**infos, **told, **masks}

    def state_dict(self) -> dict[str, Any]:
        """See `CuriosityReward`."""
        return self.appraisal.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `CuriosityReward`."""
        self.appraisal.load_state_dict(state)


class Appraisal:
    """What both wrappers do: appraise episodes of several environments while they go on."""

    def __init__(self, config: CuriosityConfig, spaces: Spaces, environments: int) -> None:
        self.config, self.spaces = config, spaces
        streams = Streams(config.seed)
        space, size = spaces.observation_space, spaces.observation_size
        memory = config.memory if config.relevance else None
        curiosity = Curiosity(memory, config.novelty, "compiled", space, size, streams)
        self.curiosity = StepwiseCuriosity(curiosity, environments)
        self.controller = beta_rule(config.beta, config.rollout_steps, streams["beta"])
        if isinstance(config.beta, CustomBeta) and self.controller.learns:
            raise ConfigError(
                f"beta.rule has {config.beta.rule!r}, which learns from policy gradients, but only "
                "our trainer has these"
            )
        self.extrinsic_scale = RewardScale(config.discount, 1.0)
        self.curiosity_scale = RewardScale(config.discount, TINY)
        self.recordings: list[Recording | None] = [None] * environments
        self.first_observation, self.first_action = (
            int(space.start) if isinstance(space, Discrete) else None  # of the numbers
            for space in (spaces.observation_space, spaces.action_space)
        )

    @property
    def unit(self) -> float:
        """What 1 of R_curiosity is worth in extrinsic reward; 0 before any episode has ended."""
        if self.extrinsic_scale.sums.count == 0:
            return 0.0
        return self.extrinsic_scale.value / self.curiosity_scale.value

    def going_on(self) -> np.ndarray:
        """Whether there is an unfinished episode, for each environment, bool [environments]."""
        return np.array([recording is not None for recording in self.recordings])

    def begin(self, environment: int, observation: Any) -> None:
        """An episode begins; what was played of another is forgotten."""
        first = self.encode(observation)
        beta = self.controller.beta
        require_share("β", beta)
        self.recordings[environment] = Recording(first, beta, self.unit)
        self.curiosity.begin(environment)

    def pay(
        self, environment: int, action: Any, reward: float, observation: Any
    ) -> dict[str, float]:
        """`PARTS` of the reward for a step; reward: the extrinsic one; then what it led to."""
        recording = self.recordings[environment]
        if recording is None:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset before step")
        if not math.isfinite(reward):
            require_finite("the reward", reward, f" after step {len(recording) + 1}")
        state = recording.add(self.action(action), reward, self.encode(observation))
        bonus, novelty, relevance = self.curiosity.bonus(state, environment)
        if not 0 <= bonus <= 1:
            require_share("the curiosity bonus", bonus, 1e-6)  # beyond that it is rounding
            bonus = max(bonus, 0.0)
        recording.bonus.append(bonus)
        return {
            "reward_extrinsic": reward,
            "reward_curiosity": recording.beta * recording.unit * bonus,
            "curiosity": bonus,
            "novelty": novelty,
            "relevance": relevance,
            "beta": recording.beta,
        }

    def encode(self, observation: Any) -> np.ndarray:
        """A float32 vector, [observation_size]; `ConfigError` for what is not of the space."""
        spaces = self.spaces
        if self.first_observation is None:
            vector = np.asarray(observation, np.float32)
            if vector.size == spaces.observation_size:
                return vector.ravel()
            found = f"shape {vector.shape}"
        else:
            if 0 <= int(observation) - self.first_observation < spaces.observation_size:
                return spaces.encode(observation)
            found = f"number {observation}"
        raise ConfigError(
            f"environment {spaces.name!r} gave an observation of {found}, but its "
            f"observation_space is {spaces.observation_space}"
        )

    def action(self, action: Any) -> Any:
        """As an `Episode` has it: an int from 0, or float32 [actions], a copy."""
        if self.first_action is None:
            return np.array(action, np.float32)
        return int(action) - self.first_action

    def end(self, environment: int, terminated: bool) -> None:
        """The episode becomes memory, and β is set anew."""
        recording = self.recordings[environment]
        assert recording is not None
        self.recordings[environment] = None
        episode, bonus = recording.episode(terminated), np.array(recording.bonus)
        require_finite("an observation", episode.observations)
        self.extrinsic_scale.update(episode.rewards)
        self.curiosity_scale.update(bonus)
        values = np.zeros(len(episode) + 1)  # with λ = 1 only rewards are left: no critic
        returns = generalised_advantages(episode.rewards, values, self.config.discount, 1.0)
        self.curiosity.remember(episode, returns)
        self.controller.next_episode(episode, bonus)

    def described(self) -> dict[str, Any]:
        """What a state has to agree in with the one who loads it."""
        described = self.config.model_dump(exclude={"seed"})  # drawn already
        size = self.spaces.observation_size
        return {**described, "observation_size": size, "environments": len(self.recordings)}

    def state_dict(self) -> dict[str, Any]:
        """See `CuriosityReward`."""
        state = {
            "settings": self.described(),
            "curiosity": self.curiosity.state_dict(),
            "controller": self.controller.state_dict(),
            "scales": [self.extrinsic_scale.state_dict(), self.curiosity_scale.state_dict()],
            "recordings": [
                None if recording is None else recording.state_dict()
                for recording in self.recordings
            ],
        }
        return copy.deepcopy(state)  # the training may go on before this is saved

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `CuriosityReward`."""
        state, mine = copy.deepcopy(state), self.described()
        for name, value in state["settings"].items():
            if value != mine[name]:
                raise ConfigError(
                    f"the state to load was made with {name} {short(value)}, but here it is "
                    f"{short(mine[name])}"
                )
        self.curiosity.load_state_dict(state["curiosity"])
        self.controller.load_state_dict(state["controller"])
        for scale, saved in zip(
            (self.extrinsic_scale, self.curiosity_scale), state["scales"], strict=True
        ):
            scale.load_state_dict(saved)
        self.recordings = [
            None if saved is None else Recording.from_state(saved) for saved in state["recordings"]
        ]


class Recording:
    """An episode that goes on: what was played, what it was worth, and at which rates."""

    def __init__(self, first: np.ndarray, beta: float, unit: float) -> None:
        self.beta, self.unit = beta, unit
        self.observations = np.zeros((64, len(first)), np.float32)  # doubled as it gets full
        self.observations[0] = first
        self.actions: list[Any] = []
        self.rewards: list[float] = []  # extrinsic
        self.bonus: list[float] = []  # R_curiosity

    def __len__(self) -> int:
        return len(self.rewards)

    def add(self, action: Any, reward: float, observation: np.ndarray) -> np.ndarray:
        """One step and what it led to, all as in an `Episode`; returns the latter, as kept here."""
        self.actions.append(action)
        self.rewards.append(reward)
        if len(self.rewards) == len(self.observations):
            more = np.zeros_like(self.observations)
            self.observations = np.concatenate([self.observations, more])
        kept = self.observations[len(self.rewards)]
        kept[:] = observation
        return kept

    def episode(self, terminated: bool) -> Episode:
        """The episode as it was played; how likely its actions were is not known here."""
        actions = np.array(self.actions)  # int64 or float32, as `Appraisal.action` has it
        unknown = np.full(len(self), np.nan, np.float32)
        observations = self.observations[: len(self) + 1]
        return Episode(observations, actions, unknown, np.array(self.rewards), terminated)

    def state_dict(self) -> dict[str, Any]:
        """Everything that `from_state` needs."""
        episode = self.episode(terminated=False)
        return {
            "observations": torch.from_numpy(episode.observations),
            "actions": torch.from_numpy(episode.actions),
            "rewards": list(self.rewards),
            "bonus": list(self.bonus),
            "beta": self.beta,
            "unit": self.unit,
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Recording":
        """The recording that `state_dict` was of."""
        observations, actions = state["observations"].numpy(), state["actions"].numpy()
        recording = cls(observations[0], state["beta"], state["unit"])
        steps = zip(actions, state["rewards"], observations[1:], strict=True)
        for action, reward, observation in steps:
            recording.add(action, reward, observation)
        recording.bonus = list(state["bonus"])
        return recording


def given(**settings: Any) -> dict[str, Any]:
    """Those that are not None."""
    return {name: value for name, value in settings.items() if value is not None}


def name_of(env: Any) -> str:
    """What an environment is called in messages."""
    return str(env) if env.spec is None else env.spec.id
