"""What sets β, the weight of the curiosity bonus, episode by episode.

One interface, `BetaController`; an exponential schedule and the meta-adaptation network stand
behind it.
"""

from collections import deque
from functools import reduce
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.spaces import Discrete

from mace_rl.environments import Environment
from mace_rl.hyperparameters import ExponentialBeta, RunConfig
from mace_rl.learner import Learner
from mace_rl.meta_network import MetaNetwork
from mace_rl.rollout import Episode
from mace_rl.standardise import RunningStandardiser
from mace_rl.streams import numpy_generator


class BetaController(Protocol):
    """Sets β for the next episode from what happened in the last."""

    beta: float  # of the next episode
    learns: bool  # whether `learn` wants policy gradients

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """Take in a finished episode and its curiosity bonus, [T]; set `beta` for the next."""

    def learn(self, extrinsic: np.ndarray, intrinsic: list[np.ndarray]) -> None:
        """After each rollout, before the policy's update on it: the flat policy gradients.

        extrinsic: g_E of the whole rollout; intrinsic: for each of its episodes, in order, the
        derivative dg/dβ of the update's direction.
        """

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load_state_dict` needs."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""


class ExponentialSchedule:
    """β_n = max(floor, initial · decay^(n-1)): the paper's ablation with a fixed schedule."""

    learns = False

    def __init__(self, config: ExponentialBeta) -> None:
        self.config = config
        self.episodes = 0

    @property
    def beta(self) -> float:
        """β of the next episode."""
        return max(self.config.floor, self.config.initial * self.config.decay**self.episodes)

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.episodes += 1

    def learn(self, extrinsic: np.ndarray, intrinsic: list[np.ndarray]) -> None:
        """See `BetaController`; a schedule does not learn."""

    def state_dict(self) -> dict[str, Any]:
        """See `BetaController`."""
        return {"episodes": self.episodes}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `BetaController`."""
        self.episodes = state["episodes"]


class MetaAdaptation:
    """β from an LSTM trained on what helped the extrinsic return (paper; Xu et al. 2018).

    The update on episode n moves the policy along g(β_n), the policy gradient of the total reward.
    How the extrinsic return of the policy that results depends on β_n is therefore

        dJ_E / dβ_n ≈ η ⟨g_E(θ'; episode n+1), dg/dβ_n (θ; episode n)⟩

    and by the chain rule through β_n = LSTM_φ(episode n-1) it trains φ. g_E is scaled to length 1
    and dg/dβ by the length of g, which is what gradient clipping and Adam make of the step.
    """

    learns = True

    def __init__(self, config: RunConfig, environment: Environment) -> None:
        self.config = config.meta
        actions = environment.action_space
        self.action_count = int(actions.n) if isinstance(actions, Discrete) else 0
        action_size = self.action_count or actions.shape[0]
        self.network = MetaNetwork(
            environment.observation_size + action_size + 2,
            self.config,
            config.beta.initial,
            numpy_generator(config.seed, "meta"),
        )
        self.learner = Learner(
            self.network.parameters, self.config.learning_rate, self.config.max_gradient_norm
        )
        self.standardiser = RunningStandardiser(environment.observation_size)
        self.initial = config.beta.initial
        # What the LSTM read for the β of each episode since the last `learn`, and for that of the
        # next; None for the first episode, whose β is given.
        self.sources: deque[np.ndarray | None] = deque([None])
        # The same with dg/dβ for the episodes of the last rollout, whose effect is not yet known.
        self.pending: list[tuple[np.ndarray | None, np.ndarray]] = []

    @property
    def beta(self) -> float:
        """See `BetaController`; from the network as it is now."""
        source = self.sources[-1]
        return self.initial if source is None else self.network(source)

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.standardiser.update(episode.observations[:-1])
        self.sources.append(self.sequence(episode, bonus))

    def sequence(self, episode: Episode, bonus: np.ndarray) -> np.ndarray:
        """What the LSTM reads of an episode: state, action, extrinsic reward and curiosity bonus.

        float32 [min(T, max_sequence), input]. Longer episodes are cut into equal stretches: mean
        state and action, and the sums of reward and bonus, as sign(x) log(1 + |x|), so that the
        return can be read off and rewards of any size fit.
        """
        actions = episode.actions
        if self.action_count:
            actions = np.eye(self.action_count, dtype=np.float32)[actions]
        seen = np.concatenate([self.standardiser(episode.observations[:-1]), actions], axis=1)
        rewards = np.stack([episode.rewards, bonus], axis=1)
        length = self.config.max_sequence
        if length is not None and len(episode) > length:
            starts = np.linspace(0, len(episode), length, endpoint=False).astype(np.int64)
            counts = np.diff(starts, append=len(episode))
            seen = np.add.reduceat(seen, starts) / counts[:, None]
            rewards = np.add.reduceat(rewards, starts)
        rewards = np.sign(rewards) * np.log1p(np.abs(rewards))
        return np.concatenate([seen, rewards], axis=1).astype(np.float32)

    def learn(self, extrinsic: np.ndarray, intrinsic: list[np.ndarray]) -> None:
        """See `BetaController`: credit the βs of the last rollout, then remember this one's."""
        credited = [(sequence, change) for sequence, change in self.pending if sequence is not None]
        if credited:
            # Adam descends, so what it gets is minus the mean.
            gradients = (
                self.network.gradient(sequence, -alignment(extrinsic, change) / len(credited))
                for sequence, change in credited
            )
            self.learner.descend(reduce(np.add, gradients))
        self.pending = [(self.sources.popleft(), change) for change in intrinsic]

    def state_dict(self) -> dict[str, Any]:
        """See `BetaController`."""
        return {
            "learner": self.learner.state_dict(),
            "standardiser": self.standardiser.state_dict(),
            "sources": [as_tensor(source) for source in self.sources],
            "pending": [(as_tensor(source), as_tensor(change)) for source, change in self.pending],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `BetaController`."""
        self.learner.load_state_dict(state["learner"])
        self.standardiser.load_state_dict(state["standardiser"])
        self.sources = deque(as_array(source) for source in state["sources"])
        self.pending = [(as_array(source), as_array(change)) for source, change in state["pending"]]


def as_tensor(array: np.ndarray | None) -> torch.Tensor | None:
    """For a checkpoint."""
    return None if array is None else torch.from_numpy(array)


def as_array(tensor: torch.Tensor | None) -> np.ndarray | None:
    """From a checkpoint."""
    return None if tensor is None else tensor.numpy()


def alignment(extrinsic: np.ndarray, change: np.ndarray) -> float:
    """The part of `change` along the extrinsic gradient: ⟨g_E, change⟩ / |g_E|; 0 if g_E is 0."""
    length = np.linalg.norm(extrinsic)
    return float(extrinsic @ change / length) if length > 0 else 0.0
