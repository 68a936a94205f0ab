"""Curiosity while an episode is played: what `mace_rl.wrappers` ask of it, step by step."""

import copy
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Discrete

from mace_rl.agent.advantages import paid_returns
from mace_rl.agent.ppo import TINY
from mace_rl.agent.scale import RewardScale
from mace_rl.beta.controller import BetaController
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.config.beta import CustomBeta
from mace_rl.config.section import ConfigError, short_repr
from mace_rl.config.wrappers import CuriosityConfig
from mace_rl.environments.rollout import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.factories import beta_rule
from mace_rl.numerics.finite import require_within
from mace_rl.streams import Streams

# What a step's `info` gets, float.
PARTS = ("reward_extrinsic", "reward_curiosity", "curiosity", "novelty", "relevance", "beta")


LISTS = ("observations", "actions", "rewards", "bonus")  # of a `Recording`, in this order


@dataclass
class Recording:
    """An episode that goes on: what was played, what it was worth, and at which rates."""

    beta: float
    unit: float  # see `CuriosityTracker.unit`
    visits: np.ndarray  # to each Discrete state so far, [observation]; of Box ones 0
    observations: list[np.ndarray]  # the first, and what each step led to, float32 [observation]
    actions: list[Any] = field(default_factory=list)  # as an `Episode` has them
    rewards: list[float] = field(default_factory=list)  # extrinsic
    bonus: list[float] = field(default_factory=list)  # R_curiosity

    def episode(self, terminated: bool) -> Episode:
        """The episode as it was played; how likely its actions were is not known here."""
        unknown = np.full(len(self.rewards), np.nan, np.float32)
        states, actions = np.stack(self.observations), np.array(self.actions)
        return Episode(states, actions, unknown, np.array(self.rewards), terminated)

    def state_dict(self) -> dict[str, Any]:
        """Each part as a tensor."""
        return {name: torch.from_numpy(np.array(part)) for name, part in vars(self).items()}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> "Recording":
        """The recording that `state_dict` was of."""
        parts: dict[str, Any] = {name: part.numpy() for name, part in state.items()}
        numbers = parts["beta"].item(), parts["unit"].item(), parts["visits"]
        return cls(*numbers, *(list(parts[name]) for name in LISTS))


class CuriosityTracker:
    """Appraises episodes of several environments while they go on."""

    def __init__(self, config: CuriosityConfig, spaces: Spaces, environments: int) -> None:
        self.config, self.spaces = config, spaces
        streams = Streams(config.seed)
        space, size = spaces.observation_space, spaces.observation_size
        memory = config.memory if config.relevance else None
        self.curiosity = Curiosity(memory, config.novelty, space, size, streams)
        self.controller = beta_rule(config.beta, streams["beta"])
        if isinstance(config.beta, CustomBeta):
            require_usable(config.beta.rule, self.controller, environments)
        # Of the extrinsic rewards and of the curiosity bonus.
        self.scales = RewardScale(config.discount, 1.0), RewardScale(config.discount, TINY)
        self.recordings: list[Recording | None] = [None] * environments
        self.steps = 0  # since the agent's last update, of whole episodes

    @property
    def unit(self) -> float:
        """What 1 of R_curiosity is worth in extrinsic reward; 0 before any episode has ended."""
        extrinsic, curiosity = self.scales
        return extrinsic.value / curiosity.value if extrinsic.sums.count else 0.0

    def begin(self, environment: int, observation: Any) -> None:
        """An episode begins; what was played of another is forgotten."""
        first, beta = np.array(self.spaces.encode(observation, 0)), self.controller.beta
        require_within("β", beta)
        self.recordings[environment] = Recording(beta, self.unit, np.zeros(len(first)), [first])

    def reward_parts(
        self, environment: int, action: Any, reward: Any, observation: Any
    ) -> dict[str, float]:
        """`PARTS` of the reward for a step; reward: the extrinsic one; then what it led to."""
        recording, space = self.recordings[environment], self.spaces.action_space
        if recording is None:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset before step")
        step = len(recording.rewards) + 1
        reward = self.spaces.paid(reward, step)
        state = np.array(self.spaces.encode(observation, step))  # a copy
        found = self.curiosity.appraise(state[None], recording.visits)
        bonus, novelty, relevance = (float(part[0]) for part in found[:3] if part is not None)
        if not 0 <= bonus <= 1:
            require_within("the curiosity bonus", bonus, 1e-6)  # beyond that it is rounding
            bonus = max(bonus, 0.0)
        if self.spaces.discrete_observations:
            recording.visits += state
        if isinstance(space, Discrete):
            recording.actions.append(int(action) - int(space.start))
        else:
            recording.actions.append(np.array(action, np.float32))  # a copy
        recording.observations.append(state)
        recording.rewards.append(reward)
        recording.bonus.append(bonus)
        paid = recording.beta * recording.unit * bonus
        values = (reward, paid, bonus, novelty, relevance, recording.beta)
        return dict(zip(PARTS, values, strict=True))

    def end(self, environment: int, terminated: bool) -> None:
        """The episode becomes memory, and β is set anew."""
        recording = self.recordings[environment]
        assert recording is not None
        self.recordings[environment] = None
        episode, bonus = recording.episode(terminated), np.array(recording.bonus)
        for scale, rewards in zip(self.scales, (episode.rewards, bonus), strict=True):
            scale.update(rewards)
        self.curiosity.remember(episode, paid_returns(episode.rewards, self.config.discount))
        self.controller.next_episode(episode, bonus)
        self.steps += len(episode)
        if self.steps >= self.config.rollout_steps:
            self.controller.end_rollout()
            self.steps = 0

    def described(self) -> dict[str, Any]:
        """What a state has to agree in with the one who loads it."""
        return {
            **self.config.model_dump(exclude={"seed"}),  # drawn already
            "observation_size": self.spaces.observation_size,
            "observation_space": type(self.spaces.observation_space).__name__,
            "environments": len(self.recordings),
            "form": 4,  # of the state itself
        }

    def state_dict(self) -> dict[str, Any]:
        """See `CuriosityReward`."""
        state = {
            "settings": self.described(),
            "curiosity": self.curiosity.state_dict(),
            "controller": self.controller.state_dict(),
            "scales": [scale.state_dict() for scale in self.scales],
            "recordings": [None if one is None else one.state_dict() for one in self.recordings],
            "steps": self.steps,
        }
        return copy.deepcopy(state)  # the training may go on before this is saved

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `CuriosityReward`."""
        theirs, mine = state["settings"], self.described()
        for name in sorted(theirs.keys() | mine.keys()):
            if name not in theirs or name not in mine or theirs[name] != mine[name]:
                then, now = (
                    short_repr(x[name]) if name in x else "unknown" for x in (theirs, mine)
                )
                raise ConfigError(
                    f"the state to load was made with {name} {then}, but here it is {now}"
                )
        state = copy.deepcopy(state)
        self.curiosity.load_state_dict(state["curiosity"])
        self.controller.load_state_dict(state["controller"])
        self.steps = state["steps"]
        for scale, saved in zip(self.scales, state["scales"], strict=True):
            scale.load_state_dict(saved)
        self.recordings = [
            None if saved is None else Recording.from_state(saved) for saved in state["recordings"]
        ]


def require_usable(rule: str, controller: BetaController, environments: int) -> None:
    """Raise `ConfigError` for a rule of the user's own that asks for what a wrapper has not."""
    if controller.learns:
        raise ConfigError(
            f"beta.rule has {rule!r}, which learns from policy gradients, but only our trainer has "
            "these"
        )
    if controller.one_at_a_time and environments > 1:
        raise ConfigError(
            f"beta.rule has {rule!r}, which learns from each episode before the next begins, but "
            f"here {environments} go on at once: wrap each environment in a CuriosityReward"
        )
