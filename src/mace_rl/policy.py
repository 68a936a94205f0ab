"""Actor and critic networks: tanh MLPs with orthogonal initialisation."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from torch import Tensor, nn


def mlp(sizes: list[int], output_gain: float, generator: torch.Generator) -> nn.Sequential:
    """Linear layers of the given sizes with tanh between them.

    Weights are orthogonal with gain √2, `output_gain` in the last layer; biases are 0.
    """
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        linear = nn.Linear(inputs, outputs)
        last = i == len(sizes) - 2
        gain = output_gain if last else math.sqrt(2)
        nn.init.orthogonal_(linear.weight, gain, generator=generator)
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.Tanh()]
    return nn.Sequential(*layers)


class ActingPolicy(NamedTuple):
    """What a rollout needs of the policy, as plain arrays for the compiled functions."""

    mean: np.ndarray  # float32 [observation], subtracted from observations
    inverse_std: np.ndarray  # float32 [observation]
    clip: np.float32  # bound of normalised observations
    parameters: np.ndarray  # float32, all layers, see compiled.forward
    sizes: np.ndarray  # int64 [layers + 1]
    log_std: np.ndarray | None  # float32 [actions]; None for Discrete actions


class Actor(nn.Module):
    """π(a|s): categorical for Discrete actions, diagonal Gaussian for Box ones.

    The Gaussian's log standard deviation does not depend on the state; its samples are clipped to
    the action bounds only when acting.
    """

    def __init__(
        self,
        observation_size: int,
        action_space: Discrete | Box,
        hidden_units: list[int],
        initial_log_std: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        discrete = isinstance(action_space, Discrete)
        outputs = int(action_space.n) if discrete else action_space.shape[0]
        self.sizes = [observation_size, *hidden_units, outputs]
        # A small last layer starts near the uniform policy, or means near 0.
        self.network = mlp(self.sizes, 0.01, generator)
        self.log_std = (
            None if discrete else nn.Parameter(torch.full((outputs,), float(initial_log_std)))
        )

    def log_prob_and_entropy(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability of each action, [N], and entropy of the policy, [N] or [].

        observations: float32 [N, observation]; actions: int64 [N] or float32 [N, actions].
        """
        outputs = self.network(observations)
        if self.log_std is None:
            log_probs = torch.log_softmax(outputs, dim=-1)
            entropy = -(log_probs.exp() * log_probs).sum(-1)
            return log_probs.gather(1, actions[:, None]).squeeze(1), entropy
        deviations = (actions - outputs) * torch.exp(-self.log_std)
        constant = 0.5 * math.log(2 * math.pi)
        log_probs = (-0.5 * deviations.square() - self.log_std - constant).sum(-1)
        return log_probs, (self.log_std + 0.5 + constant).sum()

    def for_acting(self, mean: np.ndarray, std: np.ndarray, clip: float) -> ActingPolicy:
        """A copy of the current policy with the observation normalisation in front of it."""
        parameters = []
        for layer in self.network:
            if isinstance(layer, nn.Linear):
                parameters += [layer.weight.detach().numpy().T.ravel(), layer.bias.detach().numpy()]
        return ActingPolicy(
            mean=mean.astype(np.float32),
            inverse_std=(1.0 / std).astype(np.float32),
            clip=np.float32(clip),
            parameters=np.concatenate(parameters),
            sizes=np.array(self.sizes),
            log_std=None if self.log_std is None else self.log_std.detach().numpy().copy(),
        )


def critic(
    observation_size: int, hidden_units: list[int], generator: torch.Generator
) -> nn.Sequential:
    """V(s), [N, observation] → [N, 1]."""
    return mlp([observation_size, *hidden_units, 1], 1.0, generator)
