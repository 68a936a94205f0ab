"""Networks in torch: any module as a `Network`, and the tanh network that is compiled otherwise."""

import numpy as np
import torch

from mace_rl.numerics.network import Layers


class TorchNetwork:
    """A `Network` of any torch module, whose parameters become views of the flat vector."""

    def __init__(self, module: torch.nn.Module) -> None:
        self._module = module
        vector = torch.nn.utils.parameters_to_vector(module.parameters())
        self.move_to(vector.detach().numpy().copy())

    @torch.no_grad()
    def outputs(self, inputs: np.ndarray) -> np.ndarray:
        return self._module(torch.from_numpy(np.array(inputs, np.float32))).numpy()

    def move_to(self, memory: np.ndarray) -> None:
        vector = torch.from_numpy(memory)
        vector.copy_(torch.nn.utils.parameters_to_vector(self._module.parameters()).detach())
        torch.nn.utils.vector_to_parameters(vector, self._module.parameters())  # as views
        self.parameters = memory

    def module(self) -> torch.nn.Module:
        return self._module

    def load_module_state(self, state: dict[str, torch.Tensor]) -> None:
        self._module.load_state_dict(state)


def tanh_layers(parameters: Layers) -> torch.nn.Sequential:
    """What `CompiledMLP` computes with these layers, as a torch module."""
    layers: list[torch.nn.Module] = []
    for weights, biases in parameters:
        generator = torch.get_rng_state()  # a new layer draws weights, which are replaced
        inputs, outputs = weights.shape
        layer = torch.nn.Linear(inputs, outputs, device="cpu", dtype=torch.float32)
        torch.set_rng_state(generator)
        with torch.no_grad():
            layer.weight.copy_(torch.from_numpy(weights.T))
            layer.bias.copy_(torch.from_numpy(biases))
        layers += [layer, torch.nn.Tanh()]
    return torch.nn.Sequential(*layers[:-1])
