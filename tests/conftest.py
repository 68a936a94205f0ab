"""What several test files share: configurations of runs, environments for a test, networks."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

# As in training, here and in the processes that tests start; numpy and torch read it once.
os.environ["OMP_NUM_THREADS"] = "1"

import gymnasium
import numpy as np
import pytest

from mace_rl.hyperparameters import RunConfig, check
from mace_rl.study import Study, merge, read_study

if TYPE_CHECKING:
    import torch

    from mace_rl.network import MLP

CONFIG = Path(__file__).parents[1] / "config.yaml"


@pytest.fixture(scope="session")
def study() -> Study:
    """The paper's study, as `config.yaml` has it."""
    return read_study([CONFIG])


@pytest.fixture(scope="session")
def run_config(study: Study) -> Callable[..., RunConfig]:
    """`run_config(environment, variant, seed, **changes)`: the study's settings, some changed.

    Sections merge: `ppo={"epochs": 1}` leaves the rest of that section as it is.
    """

    def make(
        environment: str = "CartPole-v1", variant: str = "ppo", seed: int = 0, **changes: Any
    ) -> RunConfig:
        settings = study.run_config(environment, variant, seed).model_dump()
        return check(RunConfig, merge(settings, changes, whole={"beta"}), "the test")

    return make


@pytest.fixture
def register() -> Iterator[Callable[..., str]]:
    """`register(name, entry_point, max_episode_steps, **kwargs)`: an environment for one test."""
    before = dict(gymnasium.registry)

    def make(name: str, entry_point: Any, max_episode_steps: int | None = 10, **kwargs: Any) -> str:
        gymnasium.registry.pop(name, None)
        gymnasium.register(
            name, entry_point=entry_point, max_episode_steps=max_episode_steps, kwargs=kwargs
        )
        return name

    yield make
    gymnasium.registry.clear()
    gymnasium.registry.update(before)


class Twin:
    """The same network in PyTorch, float64 unless told: an independent forward and backward."""

    def __init__(self, network: "MLP", dtype: "torch.dtype | None" = None) -> None:
        import torch

        dtype = dtype or torch.float64
        self.sizes = network.sizes.tolist()
        self.layers: list[torch.nn.Linear] = []
        layers: list[torch.nn.Module] = []
        start, flat = 0, torch.from_numpy(network.parameters.astype(np.float64))
        for inputs, outputs in zip(self.sizes, self.sizes[1:], strict=False):
            linear = torch.nn.Linear(inputs, outputs, dtype=dtype)
            weights, biases = inputs * outputs, outputs
            with torch.no_grad():
                linear.weight[:] = flat[start : start + weights].reshape(inputs, outputs).T
                linear.bias[:] = flat[start + weights : start + weights + biases]
            start += weights + biases
            self.layers.append(linear)
            layers += [linear, torch.nn.Tanh()]
        self.module = torch.nn.Sequential(*layers[:-1])
        self.log_std = torch.nn.Parameter(flat[start:].to(dtype))
        self.dtype = dtype

    def parameters(self) -> "list[torch.nn.Parameter]":
        """Every parameter, in the order of the flat vector."""
        layers = [part for layer in self.layers for part in (layer.weight, layer.bias)]
        return [*layers, self.log_std] if len(self.log_std) else layers

    def flat(self, tensors: "list[torch.Tensor]") -> np.ndarray:
        """Tensors shaped like `parameters()` as one vector in the order of `MLP.parameters`."""
        return np.concatenate([tensor.detach().numpy().T.ravel() for tensor in tensors])

    def gradient(self, loss: "torch.Tensor") -> np.ndarray:
        """∇ loss by autograd, in the order of `MLP.parameters`."""
        import torch

        gradients = torch.autograd.grad(loss, self.parameters(), allow_unused=True)
        return self.flat(
            [
                torch.zeros_like(parameter) if gradient is None else gradient
                for parameter, gradient in zip(self.parameters(), gradients, strict=True)
            ]
        )

    def __call__(self, inputs: np.ndarray) -> "torch.Tensor":
        """The outputs, [N, out]."""
        import torch

        return self.module(torch.as_tensor(inputs, dtype=self.dtype))

    def policy(self, observations: np.ndarray) -> "torch.distributions.Distribution":
        """π(·|s) as torch.distributions has it; categorical if there is no log_std."""
        import torch

        outputs = self(observations)
        if len(self.log_std):
            normal = torch.distributions.Normal(outputs, self.log_std.exp())
            return torch.distributions.Independent(normal, 1)
        return torch.distributions.Categorical(logits=outputs)


@pytest.fixture(scope="session")
def twin() -> type[Twin]:
    """`twin(network)`: the same network, or policy, in PyTorch."""
    return Twin
