"""The LSTM that answers β, and its derivative, against PyTorch's."""

import numpy as np
import pytest
import torch

from mace_rl.meta_network import MetaNetwork


class MetaTwin:
    """A meta network in PyTorch, float64: an independent forward and backward."""

    def __init__(self, network: MetaNetwork) -> None:
        flat = network.parameters.astype(np.float64)
        self.parts = [torch.tensor(part, requires_grad=True) for part in network.split(flat)]
        self.lstm = torch.nn.LSTM(
            network.input_size, network.units, batch_first=True, dtype=torch.float64
        )

    def __call__(self, sequence: np.ndarray) -> torch.Tensor:
        inward, recurrent, bias, readout, readout_bias = self.parts

        def theirs(weights: torch.Tensor) -> torch.Tensor:
            """Gates last, in PyTorch's order and place."""
            enter, forget, leave, candidate = weights.chunk(4, dim=-1)
            return torch.cat([enter, forget, candidate, leave], dim=-1).movedim(-1, 0)

        weights = {
            "weight_ih_l0": theirs(inward),
            "weight_hh_l0": theirs(recurrent),
            "bias_ih_l0": theirs(bias),
            "bias_hh_l0": torch.zeros_like(bias),
        }
        inputs = torch.from_numpy(sequence.astype(np.float64))[None]
        _, (hidden, _) = torch.func.functional_call(self.lstm, weights, inputs)
        return torch.sigmoid(readout @ hidden[0, 0] + readout_bias[0])

    def gradient(self, loss: torch.Tensor) -> np.ndarray:
        """∇ loss in the order of `MetaNetwork.parameters`."""
        found = torch.autograd.grad(loss, self.parts)
        return np.concatenate([part.numpy().ravel() for part in found])


@pytest.mark.parametrize("units", [1, 5, 128])
@pytest.mark.parametrize("length", [1, 2, 32, 300])
def test_meta_network_and_its_gradient_equal_torch(run_config, units, length):
    config = run_config("CartPole-v1", "mace_full", meta={"hidden_units": units}).meta
    rng = np.random.default_rng(0)
    network = MetaNetwork(7, config, 0.4, rng)
    network.parameters[:] = rng.standard_normal(len(network.parameters)) / units**0.5
    sequence = 2 * rng.standard_normal((length, 7)).astype(np.float32)
    twin = MetaTwin(network)
    expected = twin(sequence)
    assert network(sequence) == pytest.approx(expected.item(), abs=1e-5)
    gradient = twin.gradient(expected)
    tolerance = 1e-4 * np.abs(gradient).max()
    np.testing.assert_allclose(network.gradient(sequence), gradient, rtol=1e-3, atol=tolerance)
