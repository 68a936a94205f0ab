"""The masked autoencoder of the density estimator in PyTorch, to read and to check by."""

import numpy as np
import torch
from torch.nn.functional import linear

from mace_rl.bonus.density import masked_layers
from mace_rl.numerics.torch_network import tanh_layers


class MaskedAutoencoder(torch.nn.Module):
    """μ_i and log σ_i, functions of the inputs before the i-th: [N, size] → [N, 2 size]."""

    def __init__(self, size: int, hidden_units: int, generator: np.random.Generator) -> None:
        super().__init__()
        layers, masks = masked_layers(size, hidden_units, generator)
        parts = tanh_layers(layers)
        self.hidden, self.output = (part for part in parts if isinstance(part, torch.nn.Linear))
        self.masks = [torch.from_numpy(mask.T.copy()) for mask in masks]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """μ, then log σ, not bounded yet."""
        inward, outward = self.masks
        hidden = torch.tanh(linear(x, self.hidden.weight * inward, self.hidden.bias))
        return linear(hidden, self.output.weight * outward, self.output.bias)
