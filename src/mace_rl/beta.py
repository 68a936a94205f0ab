"""What sets β, the weight of the curiosity bonus, episode by episode.

One interface, `BetaController`; an exponential schedule and the meta-adaptation network stand
behind it.
"""

from collections import deque
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.spaces import Discrete
from torch import Tensor, nn

from mace_rl.environments import Environment
from mace_rl.hyperparameters import ExponentialBeta, MetaConfig, RunConfig
from mace_rl.learner import Learner
from mace_rl.rollout import Episode
from mace_rl.standardise import RunningStandardiser
from mace_rl.streams import torch_generator


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


class MetaNetwork(nn.Module):
    """LSTM over one episode, its last state mapped to β in (0, 1)."""

    def __init__(
        self, input_size: int, config: MetaConfig, initial: float, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.lstm = nn.LSTM(input_size, config.hidden_units, batch_first=True)
        self.output = nn.Linear(config.hidden_units, 1)
        bound = config.hidden_units**-0.5
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        # Untrained it answers about `initial` to every episode.
        nn.init.uniform_(self.output.weight, -0.01, 0.01, generator=generator)
        nn.init.constant_(self.output.bias, float(np.log(initial / (1 - initial))))

    def forward(self, sequence: Tensor) -> Tensor:
        """β, [], from one episode, [T, input]."""
        _, (hidden, _) = self.lstm(sequence[None])
        return torch.sigmoid(self.output(hidden[-1, 0]))[0]


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
            torch_generator(config.seed, "meta"),
        )
        self.learners = [
            Learner(parameter.detach().view(-1).numpy(), self.config.learning_rate)
            for parameter in self.network.parameters()
        ]
        self.standardiser = RunningStandardiser(environment.observation_size)
        self.beta: float = config.beta.initial
        # What gave rise to the β of each episode since the last `learn`, and to that of the next;
        # None for the first episode, whose β is given.
        self.sources: deque[Tensor | None] = deque([None])
        # The same with dg/dβ for the episodes of the last rollout, whose effect is not yet known.
        self.pending: list[tuple[Tensor | None, np.ndarray]] = []

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.standardiser.update(episode.observations[:-1])
        sequence = self.sequence(episode, bonus)
        self.sources.append(sequence)
        with torch.no_grad():
            self.beta = float(self.network(sequence))

    def sequence(self, episode: Episode, bonus: np.ndarray) -> Tensor:
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
        return torch.from_numpy(np.concatenate([seen, rewards], axis=1).astype(np.float32))

    def learn(self, extrinsic: np.ndarray, intrinsic: list[np.ndarray]) -> None:
        """See `BetaController`: credit the βs of the last rollout, then remember this one's."""
        credited = [
            (sequence, alignment(extrinsic, gradient))
            for sequence, gradient in self.pending
            if sequence is not None
        ]
        if credited:
            loss = -sum(self.network(sequence) * credit for sequence, credit in credited)
            self.network.zero_grad()
            (loss / len(credited)).backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), self.config.max_gradient_norm)
            for learner, parameter in zip(self.learners, self.network.parameters(), strict=True):
                learner.descend(parameter.grad.view(-1).numpy())
        self.pending = [(self.sources.popleft(), gradient) for gradient in intrinsic]

    def state_dict(self) -> dict[str, Any]:
        """See `BetaController`."""
        return {
            "learners": [learner.state_dict() for learner in self.learners],
            "standardiser": self.standardiser.state_dict(),
            "beta": self.beta,
            "sources": list(self.sources),
            "pending": [
                (sequence, torch.from_numpy(gradient)) for sequence, gradient in self.pending
            ],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `BetaController`."""
        for learner, saved in zip(self.learners, state["learners"], strict=True):
            learner.load_state_dict(saved)
        self.standardiser.load_state_dict(state["standardiser"])
        self.beta = state["beta"]
        self.sources = deque(state["sources"])
        self.pending = [(sequence, gradient.numpy()) for sequence, gradient in state["pending"]]


def alignment(extrinsic: np.ndarray, change: np.ndarray) -> float:
    """The part of `change` along the extrinsic gradient: ⟨g_E, change⟩ / |g_E|; 0 if g_E is 0."""
    length = np.linalg.norm(extrinsic)
    return float(extrinsic @ change / length) if length > 0 else 0.0
