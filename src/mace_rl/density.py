"""Neural density estimator: a masked autoencoder, MADE (Germain et al. 2015), Gaussian outputs."""

import math

import torch
from torch import Tensor, nn


class MADE(nn.Module):
    """log p(x) = Σ_i log N(x_i; μ_i(x_<i), σ_i(x_<i)) with one masked hidden layer.

    Being autoregressive it is normalised: p integrates to 1 whatever the weights are.
    """

    def __init__(self, size: int, hidden_units: int, generator: torch.Generator) -> None:
        super().__init__()
        # Unit h sees inputs below its degree; output i sees units whose degree is at most i.
        degrees = torch.arange(hidden_units) % max(size - 1, 1) + 1
        inputs = torch.arange(1, size + 1)
        self.register_buffer("input_mask", (degrees[:, None] >= inputs).float())  # [hidden, size]
        self.register_buffer(
            "output_mask", (inputs[:, None] > degrees).float().repeat(2, 1)
        )  # [2 size, hidden]
        bound = 1 / math.sqrt(hidden_units)
        self.input_weight = nn.Parameter(torch.empty(hidden_units, size))
        self.input_bias = nn.Parameter(torch.zeros(hidden_units))
        self.output_weight = nn.Parameter(torch.empty(2 * size, hidden_units))
        self.output_bias = nn.Parameter(torch.zeros(2 * size))
        nn.init.uniform_(self.input_weight, -1, 1, generator=generator)
        nn.init.uniform_(self.output_weight, -bound, bound, generator=generator)

    def log_prob(self, x: Tensor) -> Tensor:
        """Log-density of each row of x, [N, size] → [N]."""
        hidden = torch.tanh(
            nn.functional.linear(x, self.input_weight * self.input_mask, self.input_bias)
        )
        outputs = nn.functional.linear(
            hidden, self.output_weight * self.output_mask, self.output_bias
        )
        mean, log_std = outputs.chunk(2, dim=1)
        # Bounded away from 0: a coordinate that never varies would otherwise have infinite density.
        log_std = log_std.clamp(min=-5.0)
        deviations = (x - mean) * torch.exp(-log_std)
        return (-0.5 * deviations.square() - log_std - 0.5 * math.log(2 * math.pi)).sum(1)
