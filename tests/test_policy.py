"""The policy: against torch.distributions, autograd and the textbook's statements."""

import math

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from numba import njit
from scipy import special, stats

from mace_rl import compiled
from mace_rl.network import MLP
from mace_rl.policy import Actor

SPACES = {"Discrete": Discrete(4), "Box": Box(-1, 1, (3,), np.float32)}


def random_actor(space="Discrete", size=5, hidden=(7, 6), scale=1.0, seed=0) -> Actor:
    """An actor all of whose parameters, biases and log-std included, are arbitrary."""
    rng = np.random.default_rng(seed)
    actor = Actor(size, SPACES[space], list(hidden), 0.0, rng)
    actor.parameters[:] = scale * rng.standard_normal(len(actor.parameters))
    return actor


def acting(actor: Actor, mean=None, std=None, clip=np.inf):
    """The actor for rollouts, by default without normalisation."""
    size = actor.sizes[0]
    return actor.for_acting(
        np.zeros(size) if mean is None else mean, np.ones(size) if std is None else std, clip
    )


def steps(actor: Actor, count=50, seed=1):
    """Observations, [count, size], and actions that need not be the policy's own."""
    rng = np.random.default_rng(seed)
    observations = rng.standard_normal((count, actor.sizes[0])).astype(np.float32)
    if actor.discrete:
        return observations, rng.integers(actor.sizes[-1], size=count)
    return observations, rng.standard_normal((count, actor.sizes[-1])).astype(np.float32)


@pytest.mark.parametrize("hidden", [[1], [5], [64, 64], [3, 4, 5]])
def test_network_output_equals_torch(hidden, twin):
    rng = np.random.default_rng(0)
    network = MLP([6, *hidden, 3], 1.0, rng)
    network.parameters[:] = rng.standard_normal(len(network.parameters))
    inputs = rng.standard_normal((20, 6)).astype(np.float32)
    expected = twin(network)(inputs).detach().numpy()
    activations = network.forward(inputs)
    assert [part.shape[1] for part in activations] == [6, *hidden, 3]
    np.testing.assert_allclose(activations[-1], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("hidden", [[1], [5], [64, 64], [3, 4, 5]])
def test_network_gradient_equals_autograd(hidden, twin):
    rng = np.random.default_rng(0)
    network = MLP([6, *hidden, 3], 1.0, rng, extra=2)
    network.parameters[:] = 0.5 * rng.standard_normal(len(network.parameters))
    inputs, slope = rng.standard_normal((20, 6)), rng.standard_normal((20, 3))
    other = twin(network)
    expected = other.gradient((other(inputs) * torch.from_numpy(slope)).sum())
    inputs, slope = inputs.astype(np.float32), slope.astype(np.float32)
    found = network.backward(network.forward(inputs), slope)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert (found[-2:] == 0).all()  # the owner's extra numbers


@pytest.mark.parametrize("sizes", [[4, 64, 64, 2], [15, 64, 64, 3], [64, 8, 64, 1]])
@pytest.mark.parametrize("output_gain", [0.01, 1.0])
def test_initial_weights_are_orthogonal_and_biases_zero(sizes, output_gain):
    network = MLP(sizes, output_gain, np.random.default_rng(0))
    last = len(sizes) - 2
    for layer, weights in enumerate(network.weights):
        gain = output_gain if layer == last else math.sqrt(2)
        small = weights if weights.shape[0] <= weights.shape[1] else weights.T
        gram = small.astype(np.float64) @ small.T
        np.testing.assert_allclose(gram, gain**2 * np.eye(len(small)), atol=1e-6 * gain**2)
    assert all((biases == 0).all() for biases in network.biases)


def test_initial_policy_is_nearly_uniform_and_critic_is_not_flat():
    observations = np.random.default_rng(0).standard_normal((100, 4)).astype(np.float32)
    actor = Actor(4, SPACES["Discrete"], [64, 64], 0.0, np.random.default_rng(0))
    outputs = actor.forward(observations)[-1]
    actions = np.zeros(100, np.int64)
    np.testing.assert_allclose(np.exp(actor.log_probs(outputs, actions)), 1 / 4, atol=0.02)
    gaussian = Actor(4, SPACES["Box"], [64, 64], -0.7, np.random.default_rng(0))
    assert np.abs(gaussian.forward(observations)[-1]).max() < 0.1
    assert (gaussian.log_std == np.float32(-0.7)).all()


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("scale", [0.3, 2.0])
def test_log_probs_equal_torch_distributions(space, scale, twin):
    actor = random_actor(space, scale=scale)
    observations, actions = steps(actor)
    policy = twin(actor).policy(observations)
    outputs = actor.forward(observations)[-1]
    np.testing.assert_allclose(
        actor.log_probs(outputs, actions),
        policy.log_prob(torch.from_numpy(actions)).detach().numpy(),
        rtol=1e-4,
        atol=1e-4,
    )


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("entropy_weight", [0.0, 0.3])
def test_gradient_equals_autograd_through_torch_distributions(space, entropy_weight, twin):
    actor = random_actor(space, scale=0.5)
    observations, actions = steps(actor)
    weights = np.random.default_rng(2).standard_normal(len(actions))
    other = twin(actor)
    policy = other.policy(observations)
    log_probs = policy.log_prob(torch.from_numpy(actions))
    objective = (log_probs * torch.from_numpy(weights)).sum()
    expected = other.gradient(objective + entropy_weight * policy.entropy().sum())
    found = actor.gradient(
        actor.forward(observations), actions, weights.astype(np.float32), entropy_weight
    )
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-4)
    assert np.abs(expected).max() > 0.1


def test_gradient_equals_finite_differences():
    """Without any library's derivative: the objective's own change, parameter by parameter."""
    actor = random_actor("Box", size=3, hidden=(4,), scale=0.5)
    observations, actions = steps(actor, count=8)
    weights = np.random.default_rng(2).standard_normal(8).astype(np.float32)

    def objective() -> float:
        outputs = actor.forward(observations.astype(np.float64))[-1]
        std = np.exp(actor.log_std)
        log_probs = stats.norm.logpdf(actions, outputs, std).sum(1)
        return log_probs @ weights + 0.3 * stats.norm.entropy(scale=std).sum() * 8

    found = actor.gradient(actor.forward(observations), actions, weights, 0.3)
    actor.parameters = actor.parameters.astype(np.float64)
    actor.weights, actor.biases = actor.split(actor.parameters)
    for i in range(len(actor.parameters)):
        original, values = actor.parameters[i], []
        for step in (1e-5, -1e-5):
            actor.parameters[i] = original + step
            values.append(objective())
        actor.parameters[i] = original
        assert found[i] == pytest.approx((values[0] - values[1]) / 2e-5, rel=2e-3, abs=2e-4)


@njit(error_model="numpy")
def over(function, values):
    """A compiled function of every value, in a loop that becomes vector operations."""
    result = np.empty_like(values)
    for i in range(len(values)):
        result[i] = function(values[i])
    return result


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_compiled_tanh_and_sigmoid(kind):
    values = np.concatenate([np.linspace(-12, 12, 10_001), [0.0, 1e-30, 1e30, np.inf, -np.inf]])
    values = values.astype(kind)
    exact = np.tanh(values.astype(np.float64))
    found = over(compiled.tanh, values)
    assert np.abs(found - exact).max() < 2e-7
    small = np.abs(values) < 1
    np.testing.assert_allclose(found[small], exact[small], rtol=4e-7)
    logistic = special.expit(values.astype(np.float64))
    assert np.abs(over(compiled.sigmoid, values) - logistic).max() < 2e-7
    for function in (compiled.tanh, compiled.sigmoid):  # or a run that goes bad is not noticed
        assert np.isnan(over(function, np.full(17, np.nan, kind))).all()


@pytest.mark.parametrize("hidden", [[1], [64, 64], [3, 4, 5]])
def test_compiled_forward_equals_torch(hidden, twin):
    actor = random_actor(size=6, hidden=hidden)
    observations, _ = steps(actor)
    expected = twin(actor, torch.float32)(observations).detach().numpy()
    for observation, row in zip(observations, expected, strict=True):
        found = compiled.forward(observation, actor.parameters, actor.sizes)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, row, rtol=1e-4, atol=1e-4)


def test_acting_normalises_observations(twin):
    rng = np.random.default_rng(3)
    actor = random_actor()
    mean, std = rng.standard_normal(5), np.exp(rng.standard_normal(5))
    policy = acting(actor, mean, std, clip=1.5)
    observations = (mean + 2 * std * rng.standard_normal((200, 5))).astype(np.float32)
    normalised = np.clip((observations - mean) / std, -1.5, 1.5)
    assert (np.abs(normalised) == 1.5).any() and (np.abs(normalised) < 1.5).any()
    expected = torch.log_softmax(twin(actor)(normalised), dim=1).detach().numpy()
    for observation, row in zip(observations, expected, strict=True):
        action, log_prob = compiled.act_discrete(observation, *policy[:5], rng.random())
        assert log_prob == pytest.approx(row[action], abs=1e-4)


@pytest.mark.parametrize("scale", [0.3, 0.8])
def test_discrete_actions_have_the_policy_s_frequencies(scale, twin):
    """χ² of 20,000 draws in one state; the log-probability is that of the action drawn."""
    actor = random_actor(scale=scale, seed=4)
    observation = steps(actor, count=1)[0][0]
    probabilities = torch.softmax(twin(actor)(observation), dim=0).detach().numpy()
    assert probabilities.min() > 1e-3  # else χ² does not apply
    rng, policy = np.random.default_rng(5), acting(actor)
    counts = np.zeros(4)
    for uniform in rng.random(20_000):
        action, log_prob = compiled.act_discrete(observation, *policy[:5], uniform)
        counts[action] += 1
        assert log_prob == pytest.approx(np.log(probabilities[action]), abs=1e-4)
    assert stats.chisquare(counts, 20_000 * probabilities).pvalue > 0.001


def test_discrete_action_is_the_inverse_distribution_function():
    actor = random_actor(seed=4)
    actor.parameters[:] = 0
    actor.biases[-1][:] = np.log([0.1, 0.2, 0.3, 0.4])
    policy, observation = acting(actor), np.zeros(5, np.float32)
    drawn = [
        int(compiled.act_discrete(observation, *policy[:5], uniform)[0])
        for uniform in (0.0, 0.099, 0.101, 0.299, 0.301, 0.599, 0.601, np.nextafter(1, 0))
    ]
    assert drawn == [0, 0, 1, 1, 2, 2, 3, 3]


def test_very_certain_policy_acts_with_finite_log_probability():
    actor = random_actor()
    actor.parameters[:] = 0
    actor.biases[-1][:] = [500, -500, 0, -1000]
    policy, observation = acting(actor), np.zeros(5, np.float32)
    for uniform in (0.0, 0.5, 0.999):
        action, log_prob = compiled.act_discrete(observation, *policy[:5], uniform)
        assert (action, log_prob) == (0, 0)
    log_probs = actor.log_probs(actor.forward(observation[None].repeat(4, 0))[-1], np.arange(4))
    np.testing.assert_array_equal(log_probs, np.float32([0, -1000, -500, -1500]))


def test_box_actions_are_mean_plus_std_times_noise(twin):
    actor = random_actor("Box", scale=0.7)
    observations, _ = steps(actor)
    noise = np.random.default_rng(6).standard_normal((len(observations), 3))
    policy = acting(actor)
    drawn = [
        compiled.act_box(observation, *policy, row)
        for observation, row in zip(observations, noise, strict=True)
    ]
    actions = np.stack([action for action, _ in drawn])
    assert actions.dtype == np.float32
    expected = twin(actor).policy(observations)
    means, stds = expected.base_dist.loc.detach().numpy(), expected.base_dist.scale
    exact = means + stds.detach().numpy() * noise
    np.testing.assert_allclose(actions, exact, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        [log_prob for _, log_prob in drawn],
        expected.log_prob(torch.from_numpy(exact)).detach().numpy(),
        rtol=1e-5,
        atol=1e-5,
    )


@pytest.mark.parametrize("space", SPACES)
def test_log_probability_when_acting_equals_the_one_when_learning(space):
    """PPO's ratio is 1 before the first step, up to float32."""
    actor = random_actor(space, scale=0.5)
    observations, _ = steps(actor, count=200)
    policy, rng = acting(actor), np.random.default_rng(7)
    actions, log_probs = [], []
    for observation in observations:
        if actor.discrete:
            drawn = compiled.act_discrete(observation, *policy[:5], rng.random())
        else:
            drawn = compiled.act_box(observation, *policy, rng.standard_normal(3))
        actions.append(drawn[0])
        log_probs.append(drawn[1])
    learning = actor.log_probs(actor.forward(observations)[-1], np.array(actions))
    np.testing.assert_allclose(learning, log_probs, rtol=1e-4, atol=1e-4)
