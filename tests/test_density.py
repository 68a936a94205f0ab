"""The density estimator: normalised, autoregressive, and it learns a density."""

import math

import numpy as np
import pytest

from mace_rl.agent.adam import Adam
from mace_rl.bonus.density import DensityEstimator


def made(size, hidden_units=16, scale=1.0, seed=0) -> DensityEstimator:
    """An estimator with arbitrary weights, float64."""
    generator = np.random.default_rng(seed)
    model = DensityEstimator(size, hidden_units, "compiled", generator)
    network = model.network
    network.parameters = scale * generator.standard_normal(len(network.parameters)) * network.mask
    return model


def output_layer(model: DensityEstimator) -> tuple[np.ndarray, np.ndarray]:
    """Weights, [hidden, 2 size], and biases: of μ, then log σ."""
    return model.network.layers(model.network.parameters)[-1]


@pytest.mark.parametrize("size", [1, 2, 5, 15])
def test_conditional_of_each_coordinate_depends_on_earlier_ones_only(size):
    """With the other outputs silenced, log p is that conditional and known standard normals."""
    x = np.random.default_rng(1).standard_normal(size)
    for i in range(size):
        model = made(size, hidden_units=32, scale=0.5)
        silent = np.arange(2 * size) % size != i
        weights, biases = output_layer(model)
        weights[:, silent], biases[silent] = 0, 0

        def conditional(point: np.ndarray, i=i, model=model) -> float:
            others = -0.5 * point**2 - 0.5 * math.log(2 * math.pi)
            return model.log_prob(point[None])[0] - others.sum() + others[i]

        for j in range(size):
            step = 1e-3 * (np.arange(size) == j)
            slope = (conditional(x + step) - conditional(x - step)) / 2e-3
            assert abs(slope) < 1e-9 if j > i else abs(slope) > 1e-6


@pytest.mark.parametrize("size", [1, 2, 5])
def test_gradient_of_the_log_density_by_finite_differences(size):
    model = made(size, hidden_units=8, scale=0.5)
    x = np.random.default_rng(1).standard_normal((7, size))
    found = model.gradient(x)
    parameters = model.network.parameters
    for i, step in enumerate(1e-5 * np.eye(len(found))):
        values = []
        for model.network.parameters in (parameters + step, parameters - step):
            values.append(model.log_prob(x).mean())
        expected = (values[0] - values[1]) / 2e-5 * model.network.mask[i]
        assert found[i] == pytest.approx(expected, rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_density_integrates_to_1(size, seed):
    model = made(size, hidden_units=8, scale=0.5, seed=seed)
    axis = np.linspace(-40, 40, 3001)
    totals = []
    for rows in np.array_split(axis, 30):
        points = np.stack(np.meshgrid(*[rows, axis][:size], indexing="ij"), axis=-1)
        totals.append(np.exp(model.log_prob(points.reshape(-1, size))).sum())
    assert sum(totals) * (axis[1] - axis[0]) ** size == pytest.approx(1, abs=1e-3)


def test_density_of_a_constant_stays_bounded():
    """A coordinate that never varies draws its σ to 0 only down to exp(-5)."""
    model = made(1)
    weights, biases = output_layer(model)
    weights[:], biases[:] = 0, [2.0, -50.0]
    assert model.log_prob(np.array([[2.0]]))[0] == pytest.approx(5 - 0.5 * math.log(2 * math.pi))


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_training_approaches_the_entropy_of_a_known_gaussian(engine):
    """Held-out log-likelihood rises to minus the entropy, and not above it."""
    rng = np.random.default_rng(0)
    factor = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [-0.5, 0.5, 0.3]])
    data = (rng.standard_normal((12_000, 3)) @ factor.T + [1, -1, 0]).astype(np.float32)
    entropy = 1.5 * math.log(2 * math.pi * math.e) + math.log(0.6 * 0.3)
    train, held_out = data[:10_000], data[10_000:]
    model = DensityEstimator(3, 64, engine, rng)
    adam = Adam(model.network.parameters, 0.005)
    likelihoods = []
    for step in range(1201):
        if step in (0, 50, 1200):
            likelihoods.append(float(model.log_prob(held_out).mean()))
        adam.step(-model.gradient(train[rng.integers(10_000, size=256)]))
    # Masked weights stay 0: of the 64 units half may see one input and half two, of three; and two
    # outputs may see no unit, two one half, and two all.
    assert (adam.parameters == 0).sum() == 32 * 2 + 32 + 2 * (64 + 32)
    assert likelihoods[0] < likelihoods[1] < likelihoods[2]
    assert likelihoods[-1] == pytest.approx(-entropy, abs=0.08)
