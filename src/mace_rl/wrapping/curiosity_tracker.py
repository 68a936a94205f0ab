"""Curiosity while an episode is played: what the wrappers ask of it, step by step."""

import copy
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import gymnasium
import numpy as np
import torch

from mace_rl.agent.advantages import discounted_returns
from mace_rl.agent.scale import RewardScale, discounted_sums
from mace_rl.base.rng import Streams
from mace_rl.base.state import Stateful, saved
from mace_rl.beta.controller import BetaController
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.config.beta import CustomBeta, MetaBeta
from mace_rl.config.section import ConfigError, short_repr
from mace_rl.config.wrappers import CuriosityConfig
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces
from mace_rl.numerics.finite import require_within
from mace_rl.numerics.matmul import dot
from mace_rl.training.checks import checked_beta
from mace_rl.training.factories import beta_rule, meta_adaptation

USUAL_STEPS = 20  # whose R_curiosity is usual
PRIOR = 100  # sums of R_curiosity of size 1 that are taken for granted

# What a step's `info` gets, float.
PARTS = ("reward_extrinsic", "reward_curiosity", "curiosity", "novelty", "relevance", "beta")


class Usual(Stateful):
    """m: the mean R_curiosity of the last steps, later ones weighing more.

    What is beyond it adds up to `USUAL_STEPS` times what m has changed by: next to nothing over
    many steps, whether R_curiosity falls or rises.
    """

    STATE = ("mean", "steps")

    def __init__(self) -> None:
        self.mean, self.steps = 0.0, 0  # m; the steps that it has seen, at most `USUAL_STEPS`

    def beyond(self, bonus: float) -> float:
        """The part of a step's R_curiosity that is beyond m; then m takes it in."""
        result = bonus - self.mean
        self.steps = min(self.steps + 1, USUAL_STEPS)
        self.mean += (bonus - self.mean) / self.steps
        return result


@dataclass
class Recording:
    """An unfinished episode."""

    beta: float
    unit: float  # see `CuriosityTracker.unit`
    asked: Any  # see `BetaController`; as the controller has it
    observations: list[np.ndarray]  # the first, and that after each step, float32 [observation]
    actions: list[Any] = field(default_factory=list)  # as an `Episode` has them
    rewards: list[float] = field(default_factory=list)  # extrinsic
    bonus: list[float] = field(default_factory=list)  # R_curiosity
    beyond: list[float] = field(default_factory=list)  # the part of it that is paid

    def __post_init__(self) -> None:
        self.visits = Counter(state.tobytes() for state in self.observations[1:])

    def episode(self, terminated: bool) -> Episode:
        """The finished episode; the log-probabilities of its actions are unknown, NaN."""
        unknown = np.full(len(self.rewards), np.nan, np.float32)
        states, actions = np.stack(self.observations), np.array(self.actions)
        return Episode(states, actions, unknown, np.array(self.rewards), terminated)

    def state_dict(self) -> dict[str, Any]:
        """Each part as one tensor, but for `asked`."""
        parts = {one.name: getattr(self, one.name) for one in fields(self)}
        asked = {"asked": saved(parts.pop("asked"))}
        return asked | {name: torch.from_numpy(np.array(part)) for name, part in parts.items()}

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray]) -> "Recording":
        """From the tensors of `state_dict` as arrays."""
        asked, beta, unit, *lists = state.values()
        return cls(beta.item(), unit.item(), asked and tuple(asked), *map(list, lists))


class CuriosityScale(Stateful):
    """s_I: the size of what is paid, by the discounted sums of it in ended episodes.

    It is their root mean square, as if `PRIOR` sums of 1 had come before, so that a few small ones
    do not make it tiny.
    """

    STATE = ("squares", "count")

    def __init__(self, discount: float) -> None:
        self.discount = discount
        self.squares, self.count = 0.0, 0  # of discounted sums

    def update(self, beyond: np.ndarray) -> None:
        """Take in what an ended episode paid, before β and u, [T]."""
        sums = discounted_sums(beyond, self.discount)
        self.squares, self.count = self.squares + dot(sums, sums), self.count + len(sums)

    @property
    def value(self) -> float:
        """s_I."""
        return math.sqrt((self.squares + PRIOR) / (self.count + PRIOR))


class CuriosityTracker(Stateful):
    """The curiosity bonus for unfinished episodes of several environments."""

    STATE = (
        *("curiosity", "controller", "extrinsic", "scale", "usual", "usual_of_ended"),
        *("recordings", "steps"),
    )

    def __init__(self, config: CuriosityConfig, spaces: Spaces, environments: int) -> None:
        self.config, self.spaces = config, spaces
        streams = Streams(config.seed)
        space, size = spaces.given_space, spaces.observation_size
        memory = config.memory if config.relevance else None
        self.curiosity = Curiosity(memory, config.novelty, space, size, streams)
        self.controller: BetaController
        if isinstance(config.beta, MetaBeta):
            self.controller = meta_adaptation(config.beta, config.meta, spaces, "compiled", streams)
        else:
            self.controller = beta_rule(config.beta, streams["beta"])
        if isinstance(config.beta, CustomBeta):
            require_usable(config.beta.rule, self.controller, environments)
        self.extrinsic = RewardScale(config.discount, 1.0)
        self.scale = CuriosityScale(config.discount)
        self.usual, self.usual_of_ended = Usual(), Usual()  # of all steps, of ended episodes
        self.recordings: list[Recording | None] = [None] * environments
        self.steps = 0  # of whole episodes since the agent's last update

    @property
    def unit(self) -> float:
        """The extrinsic reward that 1 of R_curiosity is worth; 0 before any episode has ended."""
        return self.extrinsic.value / self.scale.value if self.extrinsic.sums.count else 0.0

    def begin(self, environment: int, observation: Any, afresh: bool = False) -> None:
        """Start an episode; one that is not over ends here, or, if all is afresh, is forgotten."""
        unfinished = self.recordings[environment]
        if unfinished is not None and unfinished.rewards and not afresh:
            self.end(environment, terminated=False)
        if afresh:
            self.usual = copy.copy(self.usual_of_ended)
        first, beta = np.array(self.spaces.encode(observation, 0)), checked_beta(self.controller)
        asked = self.controller.asked
        self.recordings[environment] = Recording(beta, self.unit, asked, [first])

    def steps_of(self, environment: int) -> int:
        """Steps of its unfinished episode."""
        recording = self.recordings[environment]
        return len(recording.rewards) if recording else 0

    def as_recorded(self, action: Any) -> Any:
        """An action as an `Episode` has it; a copy."""
        return self.spaces.actions.chosen(action)

    def reward_parts(
        self, environment: int, action: Any, reward: Any, observation: Any
    ) -> dict[str, float]:
        """`PARTS` of the reward for a step, from its extrinsic reward and next observation.

        action: from `as_recorded`, before the step, since an environment may write into its own.
        """
        recording = self.recordings[environment]
        if recording is None:
            raise gymnasium.error.ResetNeeded("the episode is over: call reset before step")
        step = len(recording.rewards) + 1
        reward = self.spaces.checked_reward(reward, step)
        state = np.array(self.spaces.encode(observation, step))  # a copy
        found = self.curiosity.of_states(state[None], recording.visits)
        bonus, novelty, relevance = (float(part[0]) for part in found[:3] if part is not None)
        if not 0 <= bonus <= 1:
            require_within("the curiosity bonus", bonus, rounding=1e-6)
            bonus = max(bonus, 0.0)
        recording.visits[state.tobytes()] += 1
        recording.actions.append(action)
        recording.observations.append(state)
        recording.rewards.append(reward)
        recording.bonus.append(bonus)
        beyond = self.usual.beyond(bonus)
        recording.beyond.append(beyond if self.config.centred else bonus)
        paid = recording.beta * recording.unit * recording.beyond[-1]
        values = (reward, paid, bonus, novelty, relevance, recording.beta)
        return dict(zip(PARTS, values, strict=True))

    def end(self, environment: int, terminated: bool) -> None:
        """Finish an episode: it becomes memory, and β is set for the next."""
        recording = self.recordings[environment]
        assert recording is not None
        self.recordings[environment] = None
        episode, bonus = recording.episode(terminated), np.array(recording.bonus)
        self.extrinsic.update(episode.rewards)
        self.scale.update(np.array(recording.beyond))
        for one in recording.bonus:
            self.usual_of_ended.beyond(float(one))
        self.curiosity.remember(episode, discounted_returns(episode.rewards, self.config.discount))
        self.controller.asked = recording.asked  # several episodes may go on at once
        self.controller.next_episode(episode, bonus)
        self.steps += len(episode)
        if self.steps >= self.config.rollout_steps:
            self.controller.end_rollout()
            self.steps = 0

    def described(self) -> dict[str, Any]:
        """The settings that have to be the same where a state is loaded."""
        unused = set() if isinstance(self.config.beta, MetaBeta) else {"meta"}
        return {
            **self.config.model_dump(exclude={"seed"} | unused),  # the generators are in the state
            "observation_size": self.spaces.observation_size,
            "observation_space": repr(self.spaces.given_space),
            "environments": len(self.recordings),
            "form": 12,  # of the state itself
        }

    def state_dict(self) -> dict[str, Any]:
        """As `CuriosityReward.state_dict` says."""
        return super().state_dict() | {"settings": self.described()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As `CuriosityReward.load_state_dict` says."""
        if not isinstance(state, Mapping) or state.keys() != {*self.STATE, "settings"}:
            raise ConfigError(f"the state to load is {short_repr(state)}, not one of `state_dict`")
        theirs, mine = state["settings"], self.described()
        for name in sorted(theirs.keys() | mine.keys()):
            if name not in theirs or name not in mine or theirs[name] != mine[name]:
                states = (theirs, mine)
                then, now = (short_repr(x[name]) if name in x else "unknown" for x in states)
                raise ConfigError(
                    f"the state to load was made with {name} {then}, but here it is {now}"
                )
        super().load_state_dict(copy.deepcopy(state))
        found: list[Any] = self.recordings
        self.recordings = [None if one is None else Recording.from_state(one) for one in found]


def require_usable(rule: str, controller: BetaController, environments: int) -> None:
    """Raise `ConfigError` for a user's own rule that needs what a wrapper lacks."""
    why = ""
    if controller.learns:
        why = "from policy gradients, but only our trainer has these"
    elif controller.one_at_a_time and environments > 1:
        why = f"from each episode before the next begins, but here {environments} go on at once: "
        why += "wrap each environment in a CuriosityReward"
    if why:
        raise ConfigError(f"beta.rule has {rule!r}, which learns {why}")
