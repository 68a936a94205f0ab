"""The networks: compiled ones against autograd, the LSTM against PyTorch's, any torch module."""

import copy
import math
from itertools import permutations

import numpy as np
import pytest
import torch
from shared import LAYER_NORM, laid_out

from mace_rl.agent.custom import custom_module
from mace_rl.config.section import ConfigError
from mace_rl.numerics.arrays import shuffled
from mace_rl.numerics.network import CompiledMLP, mlp
from mace_rl.numerics.torch_network import TorchNetwork, tanh_layers


def both_mlps(hidden: list[int], seed: int) -> tuple[CompiledMLP, torch.nn.Module]:
    layers = mlp([6, *hidden, 3], 1.0, np.random.default_rng(seed))
    return CompiledMLP(layers), tanh_layers(layers)


def drawn(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal inputs, float32."""
    return rng.standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize("hidden", [[1], [5], [64, 64], [3, 4, 5]])
def test_compiled_networks_equal_autograd_in_double_precision(hidden):
    """Outputs and gradients with arbitrary weights, biases included, to float32's rounding."""
    rng = np.random.default_rng(0)
    one, module = both_mlps(hidden, 0)
    same = zip(one.module().parameters(), module.parameters(), strict=True)
    assert all(torch.equal(*pair) for pair in same)
    with torch.no_grad():
        for part in module.parameters():
            part += 0.3 * torch.from_numpy(rng.standard_normal(part.shape)).float()
    inputs = drawn(rng, (20, 6))

    def answers(module: torch.nn.Module) -> torch.Tensor:
        return module(torch.from_numpy(inputs).to(next(module.parameters()).dtype))

    double = copy.deepcopy(module).double()
    expected = answers(double)
    grad_outputs = rng.standard_normal(expected.shape)
    loss = (expected * torch.from_numpy(grad_outputs)).sum()
    gradients = [g.numpy() for g in torch.autograd.grad(loss, double.parameters())]
    layers = zip(*2 * [iter(module.parameters())], strict=True)  # weights and biases in turn
    for mine, theirs in zip(one.layers(one.parameters), layers, strict=True):
        for own, part in zip(mine, theirs, strict=True):
            own[:] = part.detach().numpy().T
    trace = one.forward(inputs)
    np.testing.assert_allclose(trace.outputs, expected.detach(), rtol=1e-4, atol=2e-5)
    one.backward(trace, np.ones_like(trace.outputs))  # it may go back more than once
    found = one.backward(trace, grad_outputs.astype(np.float32))
    flat = laid_out(one, gradients)
    np.testing.assert_allclose(found, flat, rtol=1e-3, atol=1e-4 * np.abs(flat).max())
    assert found.dtype == trace.outputs.dtype == one.parameters.dtype == np.float32
    added = laid_out(one, [np.ones_like(part) for part in gradients]) == 0
    assert (found[added] == 0).all() and (one.parameters[added] == 0).all()
    seen = torch.from_numpy(inputs).double().requires_grad_()
    (double(seen) * torch.from_numpy(grad_outputs)).sum().backward()
    again, inward = one.gradients(trace, grad_outputs.astype(np.float32))
    np.testing.assert_array_equal(again, found)
    tolerance = 1e-4 * seen.grad.abs().max().item()
    np.testing.assert_allclose(inward, seen.grad, rtol=1e-3, atol=tolerance)
    assert inward.dtype == np.float32
    assert found.shape == one.parameters.shape == flat.shape
    other, _ = both_mlps(hidden, 1)
    held = other.parameters
    other.load_module_state(copy.deepcopy(one.module().state_dict()))
    assert (other.parameters == one.parameters).all() and other.parameters is held
    again = answers(copy.deepcopy(one.module())).detach()
    np.testing.assert_allclose(again, expected.detach(), rtol=1e-4, atol=2e-5)


def test_parameters_in_another_precision_are_refused():
    """Compiled code would read them as other numbers."""
    compiled = CompiledMLP(mlp([3, 5, 2], 1.0, np.random.default_rng(0)))
    with pytest.raises(ValueError, match="float32, not float64"):
        compiled.move_to(np.zeros(len(compiled.parameters)))


@pytest.mark.parametrize("sizes", [[4, 64, 64, 2], [15, 64, 64, 3], [64, 8, 64, 1]])
@pytest.mark.parametrize("output_gain", [0.01, 1.0])
def test_initial_weights_are_orthogonal_and_biases_zero(sizes, output_gain):
    layers = mlp(sizes, output_gain, np.random.default_rng(0))
    for weights, biases in layers:
        gain = output_gain if weights is layers[-1][0] else math.sqrt(2)
        small = weights if weights.shape[0] <= weights.shape[1] else weights.T
        expected = gain**2 * np.eye(len(small))
        np.testing.assert_allclose(small @ small.T, expected, atol=1e-6 * gain**2)
        assert (biases == 0).all()


def test_a_permutation_is_uniform_if_the_draws_are():
    """Draws from the middles of equal parts of [0, 1), so that each choice is equally often."""
    middles = (np.arange(12) + 0.5) / 12
    draws = np.stack(np.meshgrid([0.3], middles, middles, middles), axis=-1).reshape(-1, 4)
    found, counts = np.unique(shuffled(draws), axis=0, return_counts=True)
    assert found.tolist() == sorted(map(list, permutations(range(4))))
    assert (counts == 12**3 / 24).all()
    assert (shuffled(np.ones((2, 5))) == np.arange(5)).all()


class Normalised(torch.nn.Sequential):
    """Keeps running statistics, which are no parameters."""

    def __init__(self, inputs, outputs, hidden_units):
        super().__init__(torch.nn.Linear(inputs, outputs), torch.nn.BatchNorm1d(outputs))


class Dropping(torch.nn.Sequential):
    """Drops inputs, and has no bias that would show it if they were 0."""

    def __init__(self, inputs, outputs, hidden_units, p):
        super().__init__(torch.nn.Dropout(p), torch.nn.Linear(inputs, outputs, bias=False))


def headless(inputs, outputs, hidden_units):
    return torch.nn.Linear(inputs, hidden_units[0])


@pytest.mark.parametrize(
    ("module", "arguments", "problem"),
    [
        ("headless", {}, r"gives \(2, 64\) for inputs \(2, 40\), not \(2, 3\)"),
        ("Normalised", {}, "keeps state besides its parameters"),
        ("Dropping", {"p": 0.5}, "gives other outputs the second time"),
        ("nothing", {}, "has no 'nothing'"),
    ],
)
def test_modules_that_do_not_fit_are_refused_by_name(run_config, module, arguments, problem):
    own = LAYER_NORM | {"module": f"test_network:{module}", "arguments": arguments}
    config = run_config(engine="torch", ppo={"network": own}).ppo
    with pytest.raises(ConfigError, match=rf"ppo\.network\.module.*{module}.*{problem}"):
        custom_module(config.network, config.hidden_units, 40, 3, np.random.default_rng(0))


def test_a_module_of_one_s_own_is_the_same_from_the_same_seed_and_disturbs_nothing(run_config):
    config = run_config(engine="torch", ppo={"network": LAYER_NORM}).ppo
    before = torch.get_rng_state()
    generators = map(np.random.default_rng, (0, 0, 1))
    modules = [custom_module(config.network, [16], 5, 3, generator) for generator in generators]
    one, same, other = map(TorchNetwork, modules)
    assert (one.parameters == same.parameters).all() and (one.parameters != other.parameters).any()
    inputs = drawn(np.random.default_rng(2), (9, 5))
    expected = one.module()(torch.from_numpy(inputs)).detach()
    one.move_to(np.zeros_like(one.parameters))
    assert (one.outputs(inputs) == expected.numpy()).all()
    assert (torch.get_rng_state() == before).all()
