"""The policy: against torch.distributions, autograd and the textbook's statements."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from shared import ENGINES, Twin, acting

from mace_rl.agent.distribution import log_prob_gradient
from mace_rl.agent.policy import CompiledActing, NetworkActing, Policy
from mace_rl.environments.actions import Actions
from mace_rl.numerics.network import mlp

SPACES = {
    "Discrete": Discrete(4),
    "MultiDiscrete": MultiDiscrete([3, 2, 4]),
    "MultiBinary": MultiBinary(5),
    "Box": Box(-1, 1, (3,), np.float32),
}
SIZE = 5

both_engines = pytest.mark.parametrize("engine", ENGINES)
both_spaces = pytest.mark.parametrize("space", SPACES)


def random_policy(space="Discrete", engine="compiled", hidden=(7, 6), scale=1.0, seed=0) -> Policy:
    """A policy all of whose parameters, biases and log-std included, are arbitrary."""
    rng = np.random.default_rng(seed)
    actions = Actions("a test's", SPACES[space])
    policy = Policy(ENGINES[engine](mlp([SIZE, *hidden, actions.outputs], 1.0, rng)), actions, 0.0)
    policy.parameters[:] = scale * rng.standard_normal(len(policy.parameters))
    policy.parameters *= Twin(policy).own()
    return policy


PLAIN = np.zeros(SIZE), np.ones(SIZE), np.inf  # no normalisation


def steps(policy: Policy, count=50, seed=1):
    """Observations, [count, size], and actions that need not be the policy's own."""
    rng = np.random.default_rng(seed)
    observations = rng.standard_normal((count, SIZE)).astype(np.float32)
    if policy.discrete:
        return observations, rng.integers(4, size=count)
    if len(policy.parts):
        return observations, rng.integers(policy.parts, size=(count, len(policy.parts)))
    return observations, rng.standard_normal((count, 3)).astype(np.float32)


def test_a_new_policy_is_nearly_uniform(make_ppo):
    observations = np.random.default_rng(0).standard_normal((100, 4)).astype(np.float32)
    policy = make_ppo("CartPole-v1").policy
    log_probs = policy.log_probs(policy.network.outputs(observations), np.zeros(100, np.int64))
    np.testing.assert_allclose(np.exp(log_probs), 1 / 2, atol=0.02)
    gaussian = make_ppo("Pendulum-v1", initial_log_std=-0.7).policy
    assert np.abs(gaussian.network.outputs(observations[:, :3])).max() < 0.1
    assert len(policy.log_std) == 0 and (gaussian.log_std == np.float32(-0.7)).all()


def apart(logits: torch.Tensor, sizes: list[int], space: str) -> SimpleNamespace:
    """Independent categoricals, or Bernoullis of the differences of two logits, by torch alone."""
    each = logits.split(sizes, -1)
    if space == "MultiBinary":
        differences = [part[:, 1] - part[:, 0] for part in each]
        each = [torch.distributions.Bernoulli(logits=one) for one in differences]
    else:
        each = [torch.distributions.Categorical(logits=part) for part in each]

    def log_prob(values: torch.Tensor) -> torch.Tensor:
        columns = values.unbind(-1)
        if space == "MultiBinary":
            columns = [column.double() for column in columns]
        return sum(one.log_prob(own) for one, own in zip(each, columns, strict=True))

    return SimpleNamespace(log_prob=log_prob, entropy=lambda: sum(one.entropy() for one in each))


@both_spaces
@pytest.mark.parametrize(("scale", "entropy_weight"), [(0.5, 0.0), (0.5, 0.3), (2.0, 0.3)])
def test_log_probs_and_gradient_equal_autograd(space, scale, entropy_weight):
    """Through torch.distributions, in double precision; at the network's outputs and log_std."""
    policy = random_policy(space, scale=scale)
    observations, actions = steps(policy)
    outputs, weights = policy.network.outputs(observations), np.linspace(-2, 2, len(actions))
    parts = outputs, policy.log_std
    leaves = [torch.from_numpy(part).double().requires_grad_() for part in parts]
    if policy.discrete:
        expected = torch.distributions.Categorical(logits=leaves[0])
    elif len(policy.parts):
        expected = apart(leaves[0], policy.parts.tolist(), space)
    else:
        normal = torch.distributions.Normal(leaves[0], leaves[1].exp())
        expected = torch.distributions.Independent(normal, 1)
    log_probs, entropies = expected.log_prob(torch.from_numpy(actions)), expected.entropy()
    objective = (log_probs * torch.from_numpy(weights)).sum() + entropy_weight * entropies.sum()
    gradients = torch.autograd.grad(objective, leaves, materialize_grads=True)
    found = policy.log_probs(outputs, actions)
    np.testing.assert_allclose(found, log_probs.detach(), rtol=1e-4, atol=1e-4)
    grad_log_std = np.ones_like(policy.log_std)  # to which it is added
    given = outputs, policy.log_std, actions, weights.astype(np.float32), entropy_weight
    grad, found = log_prob_gradient(*given, grad_log_std, policy.parts)
    np.testing.assert_allclose(found, entropies.detach(), rtol=1e-4)
    np.testing.assert_allclose(grad[:, : outputs.shape[1]], gradients[0], rtol=1e-3, atol=1e-4)
    assert grad.shape == (50, 16) and not grad[:, outputs.shape[1] :].any()
    np.testing.assert_allclose(grad_log_std - 1, gradients[1], rtol=1e-3, atol=1e-3)


@both_engines
@pytest.mark.parametrize("hidden", [[1], [64, 64], [3, 4, 5]])
def test_acting_normalises_observations_and_follows_the_policy(engine, hidden):
    rng = np.random.default_rng(3)
    policy = random_policy(engine=engine, hidden=hidden)
    mean, std = rng.standard_normal(SIZE), np.exp(rng.standard_normal(SIZE))
    actor = acting(policy, mean, std, 1.5)
    assert isinstance(actor, CompiledActing if engine == "compiled" else NetworkActing)
    policy.parameters += 0.1 * Twin(policy).own()  # an update after the actor was made
    observations = (mean + 2 * std * rng.standard_normal((200, SIZE))).astype(np.float32)
    normalised = np.clip((observations - mean) / std, -1.5, 1.5)
    assert (np.abs(normalised) == 1.5).any() and (np.abs(normalised) < 1.5).any()
    expected = torch.log_softmax(Twin(policy)(normalised), dim=1).detach().numpy()
    for observation, row in zip(observations, expected, strict=True):
        action, log_prob = actor.act(observation, rng.random())
        assert log_prob == pytest.approx(row[action], abs=1e-4)


@both_engines
def test_discrete_action_is_the_inverse_distribution_function(engine):
    policy, observation = random_policy(engine=engine), np.zeros(SIZE, np.float32)
    policy.parameters[:] = 0  # the same logits in every state: the biases
    biases = policy.parameters[-16 if engine == "compiled" else -4 :][:4]
    biases[:] = np.log([0.1, 0.2, 0.3, 0.4])
    uniforms = (0.0, 0.099, 0.101, 0.299, 0.301, 0.599, 0.601, np.nextafter(1, 0))
    drawn = [int(acting(policy, *PLAIN).act(observation, uniform)[0]) for uniform in uniforms]
    assert drawn == [0, 0, 1, 1, 2, 2, 3, 3]
    biases[:] = [500, -500, 0, -1000]  # very certain: logarithms stay finite
    for uniform in (0.0, 0.5, 0.999):
        assert acting(policy, *PLAIN).act(observation, uniform) == (0, 0)
    outputs = policy.network.outputs(observation[None].repeat(4, 0))
    log_probs = policy.log_probs(outputs, np.arange(4))
    np.testing.assert_array_equal(log_probs, np.float32([0, -1000, -500, -1500]))


@both_engines
def test_box_actions_are_mean_plus_std_times_noise(engine):
    policy = random_policy("Box", engine, scale=0.7)
    observations, _ = steps(policy)
    noise = np.random.default_rng(6).standard_normal((len(observations), 3))
    drawn = [acting(policy, *PLAIN).act(*pair) for pair in zip(observations, noise, strict=True)]
    actions, log_probs = (np.stack(parts) for parts in zip(*drawn, strict=True))
    assert actions.dtype == np.float32
    expected = Twin(policy).policy(observations)
    exact = (expected.mean + expected.stddev * torch.from_numpy(noise)).detach()
    np.testing.assert_allclose(actions, exact, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(log_probs, expected.log_prob(exact).detach(), rtol=1e-5, atol=1e-5)


@both_spaces
@pytest.mark.parametrize("hidden", [[1], [5, 17], [64, 64]])
def test_acting_has_the_bits_of_the_batch(space, hidden):
    policy = random_policy(space, hidden=hidden, scale=0.4)
    observations, _ = steps(policy, 100)
    rng = np.random.default_rng(8)
    noise = Actions("a test's", SPACES[space]).noise(100, rng)
    drawn = [acting(policy, *PLAIN).act(*pair) for pair in zip(observations, noise, strict=True)]
    actions, log_probs = (np.array(parts) for parts in zip(*drawn, strict=True))
    found = policy.log_probs(policy.network.outputs(observations), actions)
    assert found.dtype == np.float32 and (found == log_probs).all()
    assert len(np.unique(found)) > 90


def test_each_part_is_drawn_by_its_own_number():
    policy, observation = random_policy("MultiDiscrete"), np.zeros(SIZE, np.float32)
    policy.parameters[:] = 0
    biases = policy.parameters[-16:][:9]
    biases[:] = np.log([0.1, 0.2, 0.7, 0.5, 0.5, 0.1, 0.2, 0.3, 0.4])
    for uniforms, expected in (
        ((0.05, 0.6, 0.95), [0, 1, 3]),
        ((0.29, 0.4, 0.05), [1, 0, 0]),
        ((0.31, 0.51, 0.59), [2, 1, 2]),
    ):
        action, log_prob = acting(policy, *PLAIN).act(observation, np.array(uniforms))
        assert action.tolist() == expected and action.dtype == np.int64
        chances = [0.1, 0.2, 0.7][expected[0]] * 0.5 * [0.1, 0.2, 0.3, 0.4][expected[2]]
        assert log_prob == pytest.approx(np.log(chances), abs=1e-5)


@pytest.mark.parametrize(
    "space",
    [
        Discrete(4, start=-1),
        MultiDiscrete([3, 2]),
        MultiDiscrete([[3, 2], [2, 5]], start=[[1, 0], [0, -2]]),
        MultiBinary(3),
        MultiBinary((2, 2)),
        Box(-1, 1, (3,), np.float32),
        Box(-2, 2, (2, 2), np.float64),
        Box(-1, 1, (), np.float32),
    ],
    ids=str,
)
def test_environments_get_elements_of_their_space(space):
    actions, rng = Actions("a test's", space), np.random.default_rng(0)
    space.seed(0)
    for _ in range(20):
        wanted = space.sample()
        chosen = actions.chosen(wanted)
        given = actions.given(chosen, clips=True)
        assert space.contains(given) and np.allclose(given, wanted)
        assert np.array_equal(actions.chosen(given), chosen)
    assert actions.noise(7, rng).shape[0] == 7
