"""The density estimator: normalised, autoregressive, and it learns a density."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate

from mace_rl.density import MADE


def made(size, hidden_units=16, scale=1.0, seed=0) -> MADE:
    """An estimator with arbitrary weights, float64."""
    generator = torch.Generator().manual_seed(seed)
    model = MADE(size, hidden_units, generator).double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter[:] = scale * torch.randn(
                parameter.shape, generator=generator, dtype=torch.float64
            )
    return model


@pytest.mark.parametrize("size", [1, 2, 5, 15])
def test_conditional_of_each_coordinate_depends_on_earlier_ones_only(size):
    """With the other outputs silenced, log p is that conditional and known standard normals."""
    x = torch.randn(size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for i in range(size):
        model = made(size, hidden_units=32, scale=0.5)
        with torch.no_grad():
            for row in range(2 * size):
                if row % size != i:
                    model.output_weight[row] = 0
                    model.output_bias[row] = 0

        def conditional(point: torch.Tensor, i=i, model=model) -> torch.Tensor:
            others = torch.distributions.Normal(0.0, 1.0).log_prob(point)
            return model.log_prob(point[None])[0] - others.sum() + others[i]

        slopes = torch.autograd.functional.jacobian(conditional, x)
        assert all(abs(float(slope)) < 1e-12 for slope in slopes[i + 1 :])
        assert all(abs(float(slope)) > 1e-6 for slope in slopes[: i + 1])


@pytest.mark.parametrize("seed", range(3))
def test_density_integrates_to_1_in_one_dimension(seed):
    model = made(1, seed=seed)

    def density(x: float) -> float:
        with torch.no_grad():
            return math.exp(model.log_prob(torch.tensor([[x]], dtype=torch.float64)))

    total, _ = integrate.quad(density, -300, 300, points=[-30, -3, 0, 3, 30], limit=500)
    assert total == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_density_integrates_to_1_in_two_dimensions(seed):
    model = made(2, hidden_units=8, scale=0.5, seed=seed)
    axis = np.linspace(-40, 40, 3001)
    totals = []
    for rows in np.array_split(axis, 30):
        points = np.stack(np.meshgrid(rows, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        with torch.no_grad():
            density = model.log_prob(torch.from_numpy(points)).exp().numpy()
        totals.append(density.sum())
    assert sum(totals) * (axis[1] - axis[0]) ** 2 == pytest.approx(1, abs=1e-3)


def test_density_of_a_constant_stays_bounded():
    """A coordinate that never varies draws its σ to 0 only down to exp(-5)."""
    model = made(1)
    with torch.no_grad():
        model.output_weight[:], model.output_bias[:] = 0, torch.tensor([2.0, -50.0])
        peak = model.log_prob(torch.tensor([[2.0]], dtype=torch.float64))
    assert float(peak) == pytest.approx(5 - 0.5 * math.log(2 * math.pi))


@pytest.mark.slow
def test_training_approaches_the_entropy_of_a_known_gaussian():
    """Held-out log-likelihood rises to minus the entropy, and not above it."""
    rng = np.random.default_rng(0)
    factor = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [-0.5, 0.5, 0.3]])
    data = (rng.standard_normal((12_000, 3)) @ factor.T + [1, -1, 0]).astype(np.float32)
    entropy = 1.5 * math.log(2 * math.pi * math.e) + math.log(0.6 * 0.3)
    train, held_out = torch.from_numpy(data[:10_000]), torch.from_numpy(data[10_000:])
    model = MADE(3, 64, torch.Generator().manual_seed(0))
    optimiser = torch.optim.Adam(model.parameters(), 0.005)
    likelihoods = []
    for step in range(1201):
        if step % 400 == 0:
            with torch.no_grad():
                likelihoods.append(float(model.log_prob(held_out).mean()))
        loss = -model.log_prob(train[torch.from_numpy(rng.integers(10_000, size=256))]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert likelihoods[0] < likelihoods[1] < likelihoods[3]
    assert likelihoods[-1] == pytest.approx(-entropy, abs=0.08)
