"""The density estimator: normalised, autoregressive, and it learns a density."""

import math

import numpy as np
import pytest
import torch
from shared import Twin

from mace_rl.bonus.density import DensityEstimator
from mace_rl.numerics.adam import Adam


def made(size, hidden_units) -> DensityEstimator:
    """An estimator with arbitrary weights."""
    generator = np.random.default_rng(0)
    model = DensityEstimator(size, hidden_units, generator)
    parameters = model.network.parameters
    parameters[:] = 0.5 * generator.standard_normal(len(parameters)) * free(model)
    return model


def free(model: DensityEstimator) -> np.ndarray:
    """Which parameters are neither masked nor zeros added to the layout."""
    return model.network.mask * Twin(model.network).own()


@pytest.mark.parametrize("size", [1, 2, 5, 15])
def test_conditional_of_each_coordinate_depends_on_earlier_ones_only(size):
    """To the bit: its μ and σ change with those, and with no other."""
    model = made(size, hidden_units=32)
    x = np.random.default_rng(1).standard_normal((1, size)).astype(np.float32)
    before = model.network.forward(x).outputs[0]
    for j in range(size):
        changed = x + np.float32(0.5) * (np.arange(size) == j)
        same = model.network.forward(changed).outputs[0] == before
        assert same.tolist() == [i <= j for i in range(size)] * 2


@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("size", [1, 2, 5])
def test_log_density_and_gradient_equal_autograd(size, narrow):
    """Of normal distributions with the network's μ and σ, in double precision.

    Of the first coordinate log σ is the bias alone; if `narrow`, below its bound.
    """
    model = made(size, hidden_units=8)
    _, biases = model.network.layers(model.network.parameters)[-1]  # of μ, then log σ
    biases[size] = -5.5 if narrow else -1.0
    x = np.random.default_rng(1).standard_normal((200, size)).astype(np.float32)
    twin = Twin(model.network)
    outputs = twin(x)
    normal = torch.distributions.Normal(outputs[:, :size], outputs[:, size:].clamp(min=-5).exp())
    expected = normal.log_prob(torch.from_numpy(x)).sum(dim=1)
    np.testing.assert_allclose(model.log_prob(x), expected.detach(), rtol=1e-4, atol=1e-5)
    found, expected = model.gradient(x), twin.gradient(expected.mean()) * free(model)
    assert found.dtype == np.float32 and (found[free(model) == 0] == 0).all()
    largest = np.abs(expected).max()
    assert largest > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * largest)


def test_training_approaches_the_entropy_of_a_known_gaussian():
    """Held-out log-likelihood rises to minus the entropy, and not above it."""
    rng = np.random.default_rng(0)
    factor = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [-0.5, 0.5, 0.3]])
    data = (rng.standard_normal((12_000, 3)) @ factor.T + [1, -1, 0]).astype(np.float32)
    entropy = 1.5 * math.log(2 * math.pi * math.e) + math.log(0.6 * 0.3)
    train, held_out = data[:10_000], data[10_000:]
    model = DensityEstimator(3, 64, rng)
    adam = Adam(model.network.parameters, 0.005)
    likelihoods = []
    for step in range(1201):
        if step in (0, 50, 1200):
            likelihoods.append(float(model.log_prob(held_out).mean()))
        adam.step(-model.gradient(train[rng.integers(10_000, size=256)]))
    # Masked weights stay 0: of the 64 units half may see one input and half two, of three; and two
    # outputs may see no unit, two one half, and two all.
    parameters = adam.parameters[Twin(model.network).own()]
    assert (parameters == 0).sum() == 32 * 2 + 32 + 2 * (64 + 32)
    assert np.count_nonzero(adam.parameters) == np.count_nonzero(parameters)
    assert likelihoods[0] < likelihoods[1] < likelihoods[2]
    assert likelihoods[-1] == pytest.approx(-entropy, abs=0.08)
