"""β from the meta-adaptation network, an LSTM that is trained on what β did (paper, supplement)."""

import math
from collections import deque
from functools import reduce
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete

from mace_rl.agent.adam import Adam
from mace_rl.agent.network import Trace
from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.beta.controller import BetaController
from mace_rl.beta.lstm import meta_network
from mace_rl.config.run import MetaConfig
from mace_rl.environments.rollout import Episode


class MetaAdaptation(BetaController):
    """β from an LSTM trained on what helped the extrinsic return (paper; Xu et al. 2018).

    The update on episode n moves the policy along g(β_n), the policy gradient of the total reward.
    How the extrinsic return of the policy that results depends on β_n is therefore

        dJ_E / dβ_n ≈ η ⟨g_E(θ'; episode n+1), dg/dβ_n (θ; episode n)⟩

    and by the chain rule through β_n = LSTM_φ(episode n-1) it trains φ. g_E is scaled to length 1
    and dg/dβ by the length of g, which is what gradient clipping and Adam make of the step.
    """

    learns = True

    def __init__(
        self,
        config: MetaConfig,
        initial: float,
        engine: str,
        observation_size: int,
        action_space: Discrete | Box,
        generator: np.random.Generator,
    ) -> None:
        self.config = config
        self.initial = initial
        self.action_count = int(action_space.n) if isinstance(action_space, Discrete) else 0
        action_size = self.action_count or action_space.shape[0]
        inputs = observation_size + action_size + 2
        self.network = meta_network(inputs, config.hidden_units, initial, engine, generator)
        self.optimiser = Adam(
            self.network.parameters, config.learning_rate, config.max_gradient_norm
        )
        self.normaliser = RunningNormaliser(observation_size)
        # What the LSTM read for the β of each episode since the last `learn`, and for that of the
        # next; None for the first episode, whose β is given.
        self.sources: deque[np.ndarray | None] = deque([None])
        # The same with dg/dβ for the episodes of the last rollout, whose effect is not yet known.
        self.pending: list[tuple[np.ndarray | None, np.ndarray]] = []

    @property
    def beta(self) -> float:
        """See `BetaController`; from the network as it is now."""
        source = self.sources[-1]
        return self.initial if source is None else beta_of(self.network.forward(source))

    def next_episode(self, episode: Episode, bonus: np.ndarray) -> None:
        """See `BetaController`."""
        self.normaliser.update(episode.observations[:-1])
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
        seen = np.concatenate([self.normaliser(episode.observations[:-1]), actions], axis=1)
        rewards = np.stack([episode.rewards, bonus], axis=1)
        length = self.config.max_sequence
        if length is not None and len(episode) > length:
            starts = np.linspace(0, len(episode), length, endpoint=False).astype(np.int64)
            counts = np.diff(starts, append=len(episode))
            seen = np.add.reduceat(seen, starts) / counts[:, None]
            rewards = np.add.reduceat(rewards, starts)
        rewards = np.sign(rewards) * np.log1p(np.abs(rewards))
        return np.concatenate([seen, rewards], axis=1).astype(np.float32)

    def learn(self, extrinsic: np.ndarray, intrinsic: list[np.ndarray]) -> float | None:
        """See `BetaController`: credit the βs of the last rollout, then remember this one's."""
        credited = [
            (sequence, alignment(extrinsic, change))
            for sequence, change in self.pending
            if sequence is not None
        ]
        if credited:
            # Adam descends, so what it gets is minus the mean.
            gradients = (
                self.beta_gradient(sequence, -credit / len(credited))
                for sequence, credit in credited
            )
            self.optimiser.step(reduce(np.add, gradients))
        self.pending = [(self.sources.popleft(), change) for change in intrinsic]
        return sum(credit for _, credit in credited) / len(credited) if credited else None

    def beta_gradient(self, sequence: np.ndarray, weight: float = 1.0) -> np.ndarray:
        """`weight` · dβ/dφ for one episode, float32 [T, input]: φ are the parameters, [n]."""
        trace = self.network.forward(sequence)
        beta = beta_of(trace)
        return self.network.backward(trace, np.array([weight * beta * (1 - beta)], np.float32))

    def state_dict(self) -> dict[str, Any]:
        """See `BetaController`."""
        return {
            "optimiser": self.optimiser.state_dict(),
            "normaliser": self.normaliser.state_dict(),
            "sources": [as_tensor(source) for source in self.sources],
            "pending": [(as_tensor(source), as_tensor(change)) for source, change in self.pending],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `BetaController`."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.normaliser.load_state_dict(state["normaliser"])
        self.sources = deque(as_array(source) for source in state["sources"])
        self.pending = [(as_array(source), as_array(change)) for source, change in state["pending"]]


def beta_of(trace: Trace) -> float:
    """β in (0, 1): the logistic function of the network's output, without overflow."""
    return 0.5 + 0.5 * math.tanh(0.5 * float(trace.outputs[0]))


def alignment(extrinsic: np.ndarray, change: np.ndarray) -> float:
    """The part of `change` along the extrinsic gradient: ⟨g_E, change⟩ / |g_E|; 0 if g_E is 0."""
    length = np.linalg.norm(extrinsic)
    return float(extrinsic @ change / length) if length > 0 else 0.0


def as_tensor(array: np.ndarray | None) -> torch.Tensor | None:
    """For a checkpoint."""
    return None if array is None else torch.from_numpy(array)


def as_array(tensor: torch.Tensor | None) -> np.ndarray | None:
    """From a checkpoint."""
    return None if tensor is None else tensor.numpy()
