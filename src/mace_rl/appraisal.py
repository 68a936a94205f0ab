"""Curiosity while an episode is played: what `mace_rl.wrappers` ask of it, step by step."""

import copy
import math
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Discrete

from mace_rl.agent.advantages import generalised_advantages
from mace_rl.agent.ppo import TINY
from mace_rl.agent.scale import RewardScale
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.bonus.stepwise import StepwiseCuriosity
from mace_rl.config.beta import BanditBeta, CustomBeta
from mace_rl.config.section import ConfigError, short
from mace_rl.config.wrappers import CuriosityConfig
from mace_rl.environments.rollout import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.factories import beta_rule
from mace_rl.finite import require_finite, require_share
from mace_rl.streams import Streams

# What a step's `info` gets, float.
PARTS = ("reward_extrinsic", "reward_curiosity", "curiosity", "novelty", "relevance", "beta")


class Appraisal:
    """Appraises episodes of several environments while they go on."""

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
        if isinstance(config.beta, BanditBeta) and environments > 1:
            raise ConfigError(
                "beta.kind is 'bandit', which learns from each episode before the next begins, but "
                f"here {environments} go on at once: wrap each environment in a CuriosityReward"
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
        described["observation_size"] = self.spaces.observation_size
        described["observation_space"] = type(self.spaces.observation_space).__name__
        return {**described, "environments": len(self.recordings)}

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
        if missing := mine.keys() - state["settings"]:
            raise ConfigError(
                f"the state to load has no setting {min(missing)}: another version saved it"
            )
        for name, value in state["settings"].items():
            if name not in mine:
                raise ConfigError(
                    f"the state to load was made with {name} {short(value)}, which is no setting "
                    "here"
                )
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
