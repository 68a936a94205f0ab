"""The policy as a torch module: observations → `torch.distributions.Distribution`."""

from typing import Any

import torch
from torch import Tensor, from_numpy
from torch.distributions import Categorical, Distribution, Independent, Normal
from torch.distributions.constraints import dependent

from mace_rl.agent.policy import Policy


class Categoricals(Distribution):
    """Independent categoricals side by side; a value has one choice each, [..., parts]."""

    arg_constraints = {}  # noqa: RUF012
    support = dependent

    def __init__(self, logits: Tensor, sizes: list[int], validate: bool | None = None) -> None:
        """logits: [..., sum of sizes]."""
        each = logits.split(sizes, dim=-1)
        self.each = [Categorical(logits=part, validate_args=validate) for part in each]
        super().__init__(logits.shape[:-1], torch.Size([len(sizes)]), validate_args=False)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return torch.stack([part.sample(sample_shape) for part in self.each], -1)

    def log_prob(self, value: Tensor) -> Tensor:
        each = zip(self.each, value.unbind(-1), strict=True)
        return torch.stack([part.log_prob(choice) for part, choice in each], -1).sum(-1)

    def entropy(self) -> Tensor:
        return torch.stack([part.entropy() for part in self.each], -1).sum(-1)

    @property
    def mode(self) -> Tensor:
        return torch.stack([part.probs.argmax(-1) for part in self.each], -1)


class TorchPolicy(torch.nn.Module):
    """π(·|s) for normalised observations, [..., observation].

    Discrete actions count from 0; the others are not clipped to their bounds. Its parameters are a
    `Policy`'s, in the same memory unless its network is compiled.
    """

    def __init__(self, policy: Policy, validate: bool | None = None) -> None:
        """validate: whether distributions check their parameters; None: torch's default."""
        super().__init__()
        self.network, self.validate = policy.network.module(), validate
        self.discrete, self.parts = policy.discrete, policy.parts.tolist()
        self.continuous = not (self.discrete or self.parts)
        if self.continuous:
            self.log_std = torch.nn.Parameter(from_numpy(policy.log_std))

    def forward(self, observations: Tensor) -> Distribution:
        """The distribution over actions in each state."""
        outputs = self.network(observations)
        if self.discrete:
            return Categorical(logits=outputs, validate_args=self.validate)
        if self.parts:
            return Categoricals(outputs, self.parts, self.validate)
        normal = Normal(outputs, self.log_std.exp(), validate_args=self.validate)
        return Independent(normal, 1, validate_args=self.validate)
