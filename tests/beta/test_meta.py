"""The paper's meta network: gradients, what it reads, credit and evidence, in another way."""

import math

import numpy as np
import pytest
import torch
from shared import environment_of, learned, random_episode

from mace_rl.base.rng import Streams
from mace_rl.beta.controller import BetaGradient
from mace_rl.beta.credit import Evidence
from mace_rl.beta.lstm import MetaNetwork, add_gradient, lstm_output, lstm_states
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.beta.network import CompiledMetaNetwork
from mace_rl.beta.torch_network import TorchMetaNetwork
from mace_rl.environments.episode import Episode
from mace_rl.training.factories import beta_controller


@pytest.fixture
def make(run_config):
    """`make(engine, objective, **settings of meta)`: that of mace_evidence in CartPole."""

    def build(engine: str = "compiled", objective=None, **settings) -> MetaAdaptation:
        changes = {"engine": engine, "meta": settings, "beta": learned(**(objective or {}))}
        config = run_config("CartPole-v1", "mace_evidence", 0, **changes)
        return beta_controller(config, environment_of("CartPole-v1"), Streams(0))

    return build


@pytest.mark.parametrize("length", [1, 2, 32])
@pytest.mark.parametrize("units", [4, 16])
def test_gradient_by_autograd_in_float64(units, length):
    rng = np.random.default_rng(length)
    vector = rng.standard_normal(sum(math.prod(s) for s in MetaNetwork.shapes(5, units))).astype(
        np.float32
    )
    sequence = rng.standard_normal((length, 5)).astype(np.float32)
    network, found = MetaNetwork.of(vector, 5, units), np.zeros_like(vector)
    states = lstm_states(sequence, network)
    add_gradient(sequence, states, network, np.float32(-1.5), MetaNetwork.of(found, 5, units))
    parts = [torch.from_numpy(part).double().requires_grad_() for part in network]
    weight_ih, weight_hh, bias, readout, readout_bias = parts
    hidden = cell = torch.zeros(units, dtype=torch.float64)
    for x in torch.from_numpy(sequence).double():
        i, f, o, g = (x @ weight_ih + hidden @ weight_hh + bias).chunk(4)
        cell = f.sigmoid() * cell + i.sigmoid() * g.tanh()
        hidden = o.sigmoid() * cell.tanh()
    logit = readout @ hidden + readout_bias[0]
    assert lstm_output(sequence, network) == pytest.approx(logit.item(), rel=1e-5, abs=1e-5)
    (-1.5 * logit).backward()
    expected = torch.cat([part.grad.ravel() for part in parts]).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_both_engines_learn_the_same(make):
    """`torch.nn.LSTM`, autograd and `torch.optim.Adam`; from one to five sequences a credit."""
    config, rng = make().reader.config, np.random.default_rng(1)
    ours = CompiledMetaNetwork(config, 7, np.random.default_rng(0))
    theirs = TorchMetaNetwork(config, 7, np.random.default_rng(0))
    outputs = []
    for step in range(80):
        sequences = [
            rng.standard_normal((rng.integers(1, 33), 7)).astype(np.float32)
            for _ in range(1 + step % 5)
        ]
        outputs.append(ours.output(sequences[0]))
        assert outputs[-1] == pytest.approx(theirs.output(sequences[0]), rel=1e-3, abs=1e-5)
        slope = -1 - rng.standard_normal()
        for network in (ours, theirs):
            network.learn(sequences, slope)
    assert outputs[0] == 0 and max(outputs) > 0.1


def test_what_is_read_by_numpy(make):
    """Means of stretches, standardised by all rows so far, the observations over √4."""
    controller, rng, rows = make(chunks=8), np.random.default_rng(0), []
    for steps in (3, 8, 21, 200):
        episode, bonus = random_episode(rng, steps)
        parts = episode.observations[:-1], np.eye(2)[episode.actions], episode.rewards[:, None]
        each = np.concatenate([*parts, bonus[:, None]], axis=1)
        own = [part.mean(axis=0) for part in np.split(each, stretches_of(steps))]
        rows += own
        std = np.std(rows, axis=0)
        expected = ((own - np.mean(rows, axis=0)) / np.where(std > 1e-8, std, 1)).clip(-5, 5)
        expected[:, :4] /= 2
        found = controller.reader.read(episode, bonus)
        assert found.dtype == np.float32 and len(found) == min(steps, 8)
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def stretches_of(steps: int) -> list[int]:
    return [k * steps // min(steps, 8) for k in range(1, min(steps, 8))]


def test_box_actions_are_read_as_they_are(run_config):
    config = run_config("Pendulum-v1", "mace_full", 0)
    controller = beta_controller(config, environment_of("Pendulum-v1"), Streams(0))
    rng, steps = np.random.default_rng(0), 30
    actions = rng.standard_normal((steps, 1)).astype(np.float32)
    seen = rng.standard_normal((steps + 1, 3)).astype(np.float32)
    episode = Episode(seen, actions, np.zeros(steps), np.zeros(steps), False)
    found = controller.reader.read(episode, np.zeros(steps))
    expected = (actions - actions.mean()) / actions.std()
    np.testing.assert_allclose(found[:, 3:4], expected, rtol=1e-4, atol=1e-5)
    assert (found[:, 4:] == 0).all()  # what has not varied


def test_evidence_by_another_sum(make):
    """And Robbins' bound: a credit that agrees crosses it, chance seldom does."""
    config, rng = make().objective.config, np.random.default_rng(0)
    evidence, terms, outputs = Evidence(config, 8), [], []
    for _ in range(400):
        output, credit = rng.standard_normal(), rng.standard_normal()
        credit += 0.5 * np.sign(output)
        if outputs:
            ages = 0.99 ** np.arange(len(outputs))[::-1]
            size = np.sqrt(np.sum(ages * np.square(outputs)) / ages.sum())
            terms.append(credit * np.clip(output / size, -1, 1))
            assert evidence.unit(output) == pytest.approx(np.clip(output / size, -1, 1))
        evidence.credited(credit, output)
        outputs.append(output)
    known = np.square(terms).sum() + config.scale
    bound = math.sqrt(2 * math.log(1 / 0.3) + math.log(known / config.scale))
    beyond = sum(terms) / math.sqrt(known) - bound
    assert beyond > 0.5 and evidence.beyond_chance == pytest.approx(beyond)
    assert evidence.logit(9.0) == pytest.approx(6 * beyond)
    assert evidence.logit(-9.0) == pytest.approx(-6 * beyond)
    crossed = 0
    for _ in range(200):
        evidence = Evidence(config, 8)
        for output, credit in rng.standard_normal((1500, 2)):
            evidence.credited(credit, output)
            if evidence.beyond_chance > 0:
                crossed += 1
                break
    assert crossed <= 0.15 * 200  # half of `chance`: the sum would have to be positive


def test_beta_is_of_the_last_episode_and_learns_from_what_it_did(make):
    """β stays at 0.4 until a credit says more than chance; each credit is of its own rollout.

    Two episodes a rollout, judged by one update: the network that is shown what the controller
    should learn from, by hand, has the same weights.
    """
    controller = make(objective={"horizon": 1, "scale": 1.0}, sequences=3)
    config, rng = controller.reader.config, np.random.default_rng(3)
    network = CompiledMetaNetwork(config, controller.reader.inputs, Streams(0)["meta"])
    evidence, read, waiting, source = Evidence(controller.objective.config, 3), [], None, None
    assert controller.next_beta() == pytest.approx(0.4)
    for update in range(120):
        sources = []
        for _ in range(5 if update % 3 else 2):
            expected = 0.4
            if source is not None:
                sources.append(source)
                added = evidence.logit(network.output(source))
                expected = 1 / (1 + 1.5 * math.exp(-np.clip(added, -5.5, 6.4)))
            assert controller.next_beta() == pytest.approx(expected, rel=1e-4)
            controller.next_episode(*random_episode(rng, int(rng.integers(1, 60))))
            source = controller.sequence
            read.append(source)
        if len(sources) > 3:
            sources = [sources[k * len(sources) // 3] for k in range(3)]
        gradient = np.array([1.0, rng.standard_normal()], np.float32)
        credit = controller.learn(gradient, 1.0, BetaGradient(np.array([1, 0], np.float32), 1.0))
        assert (credit is None) == (update == 0)
        output = np.mean([network.output(sequence) for sequence in sources])
        if waiting and credit is not None:
            evidence.credited(credit, waiting[1])
            network.learn(waiting[0], -credit)
        waiting = sources, output
    assert (network.optimiser.parameters == controller.network.optimiser.parameters).all()
    assert controller.next_beta() > 0.9  # more of it was always good


@pytest.mark.parametrize("reads", [True, False])
def test_without_evidence_beta_moves_with_the_output(run_config, reads):
    """And what reads nothing is told the same for all."""
    changes = {"beta": learned("credit", horizon=1), "meta": {"reads": reads}}
    config = run_config("CartPole-v1", "mace_credit_network", 0, **changes)
    controller = beta_controller(config, environment_of("CartPole-v1"), Streams(0))
    rng, good = np.random.default_rng(0), np.array([1, 0], np.float32)
    for _ in range(15):
        controller.next_beta()
        controller.next_episode(*random_episode(rng, 20))
        controller.learn(good, 1.0, BetaGradient(good, 1.0))
    output = controller.network.output(controller.sequence)
    assert controller.next_beta() == pytest.approx(1 / (1 + 1.5 * math.exp(-output)))
    assert controller.next_beta() > 0.405 and controller.sequence.any() == reads
