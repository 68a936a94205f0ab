"""PPO's gradients and updates, against autograd and a loop written out here."""

import copy
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from shared import Twin, finish

from mace_rl.agent.compiled_learner import CompiledLearner
from mace_rl.agent.learner import Batch
from mace_rl.agent.ppo import PPO
from mace_rl.agent.torch_learner import TorchLearner
from mace_rl.numerics.adam import Adam
from mace_rl.streams import Streams

ENVIRONMENTS = ["CartPole-v1", "Pendulum-v1"]  # Discrete and Box actions

both_engines = pytest.mark.parametrize("engine", ["compiled", "torch"])
both_environments = pytest.mark.parametrize("environment", ENVIRONMENTS)


def random_batch(ppo: PPO, count=40, seed=0, spread=0.4) -> tuple[Batch, dict[str, np.ndarray]]:
    """A batch whose log-probabilities are off, so that many ratios are clipped; and returns."""
    rng, policy = np.random.default_rng(seed), ppo.policy
    own = Twin(policy).own()
    policy.parameters += 0.3 * own * rng.standard_normal(len(own)).astype(np.float32)
    size = len(ppo.normaliser.mean)
    observations = rng.standard_normal((count, size)).astype(np.float32)
    outputs = policy.network.outputs(observations)
    actions = (
        rng.integers(outputs.shape[1], size=count)
        if policy.discrete
        else rng.standard_normal(outputs.shape).astype(np.float32)
    )
    noise = spread * rng.standard_normal(count)
    batch = Batch(
        observations=observations,
        actions=actions,
        log_probs=(policy.log_probs(outputs, actions) + noise).astype(np.float32),
        advantages=rng.standard_normal(count).astype(np.float32),
    )
    return batch, {k: rng.standard_normal(count).astype(np.float32) for k in ppo.critics}


def surrogate(
    policy: torch.distributions.Distribution, batch: Batch
) -> tuple[torch.Tensor, torch.Tensor]:
    """The clipped surrogate's mean as the paper writes it, with min and clamp; and the ratios."""
    advantage = torch.from_numpy(batch.advantages)
    log_probs = policy.log_prob(torch.from_numpy(batch.actions))
    ratio = (log_probs - torch.from_numpy(batch.log_probs)).exp()
    return torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean(), ratio


# --- Gradients ----------------------------------------------------------------------------------


@both_engines
@both_environments
def test_policy_gradients_equal_autograd(make_ppo, environment, engine):
    ppo = make_ppo(environment, engine=engine)
    batch, _ = random_batch(ppo)
    several = [batch.advantages, np.ones(40), batch.advantages.astype(np.float64) ** 2]
    twin = Twin(ppo.policy)
    log_probs = twin.policy(batch.observations).log_prob(torch.from_numpy(batch.actions))
    found = ppo.learner.policy_gradients(batch.observations, batch.actions, several)
    for gradient, advantage in zip(found, several, strict=True):
        expected = twin.gradient((log_probs * torch.from_numpy(advantage)).mean())
        np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-5)
        assert gradient.dtype == np.float32


# --- Updates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_gradient_norm", [0.05, 1e9])
def test_adam_equals_torch_s_with_clipping(max_gradient_norm):
    rng = np.random.default_rng(0)
    parameters = rng.standard_normal(500).astype(np.float32)
    expected = torch.nn.Parameter(torch.from_numpy(parameters.astype(np.float64)))
    optimiser = torch.optim.Adam([expected], lr=0.01, eps=1e-5)
    adam = Adam(parameters, 0.01, max_gradient_norm)
    for _ in range(30):
        gradient = 0.01 * rng.standard_normal(500)
        expected.grad = torch.tensor(gradient)
        norm = torch.nn.utils.clip_grad_norm_([expected], max_gradient_norm)
        optimiser.step()
        assert adam.step(gradient.astype(np.float32)) == pytest.approx(float(norm), rel=1e-5)
    np.testing.assert_allclose(parameters, expected.detach().numpy(), atol=2e-5)


def test_a_preconditioned_direction_by_hand():
    """Over √v̂ + 10⁻⁵; v̂ after gradients 2 and 1: (0.999 · 0.001 · 4 + 0.001 · 1) / 0.001999."""
    adam, direction = Adam(np.float32([1, 1]), 0.1), np.float32([6, -6])
    assert (adam.preconditioned(direction) == direction).all()  # nothing is known yet
    adam.step(np.float32([0, 2]))
    np.testing.assert_allclose(adam.preconditioned(direction), [6e5, -3], rtol=1e-4)
    adam.step(np.float32([0, 1]))
    state = copy.deepcopy(adam.state_dict())
    found = adam.preconditioned(direction)
    np.testing.assert_allclose(found, [6e5, -6 / math.sqrt(0.004996 / 0.001999)], rtol=1e-4)
    assert found.dtype == np.float32
    torch.testing.assert_close(adam.state_dict(), state, rtol=0, atol=0)  # asking is not stepping


def fisher_yates(draws: np.ndarray) -> list[int]:
    """From the last place to the first one, each chosen from those before it and itself."""
    order = list(range(len(draws)))
    for place in reversed(range(1, len(draws))):
        other = math.floor(draws[place] * (place + 1))
        order[place], order[other] = order[other], order[place]
    return order


@both_engines
@both_environments
@pytest.mark.parametrize(
    "changes",
    [
        {},
        # More steps than the gradients take at once, and the last block is not full.
        {"minibatch_size": None, "entropy_coefficient": 0.05, "max_gradient_norm": 0.3},
        {"minibatch_size": 45},
    ],
    ids=["defaults", "one batch", "uneven"],
)
def test_update_equals_a_reference_loop(make_ppo, environment, changes, engine):
    """Epochs, minibatches and losses written out in float64 over autograd, with torch's Adam."""
    defaults = {"minibatch_size": 256, "entropy_coefficient": 0.0, "max_gradient_norm": 0.5}
    minibatch_size, entropy_coefficient, max_gradient_norm = (defaults | changes).values()
    ppo = make_ppo(environment, seed=5, intrinsic=True, engine=engine, **changes)
    batch, targets = random_batch(ppo, count=700, spread=0.4)
    twins = {"actor": Twin(ppo.policy)} | {k: Twin(critic) for k, critic in ppo.critics.items()}
    rates = {"actor": 3e-4, "extrinsic": 1e-3, "intrinsic": 1e-3}
    optimisers = {
        name: torch.optim.Adam(twin.parameters(), lr=rates[name], eps=1e-5)
        for name, twin in twins.items()
    }
    draws = Streams(5)["minibatches"].random((4, 700))
    sizes = {None: [700], 256: [233, 233, 234], 45: [43, 44, 44, 44] * 4}[minibatch_size]
    for epoch in range(4):
        places = fisher_yates(draws[epoch]) if minibatch_size else np.arange(700)
        told, norms = np.zeros(3), {}  # of the last epoch, and of its last minibatch
        ends = np.cumsum([0, *sizes])
        for chosen in (places[a:b] for a, b in pairwise(ends)):
            part = Batch(*(array[chosen] for array in batch))
            policy = twins["actor"].policy(part.observations)
            mean, ratio = surrogate(policy, part)
            losses = {"actor": -mean - entropy_coefficient * policy.entropy().mean()}
            for kind, returns in targets.items():
                errors = twins[kind](part.observations)[:, 0] - torch.from_numpy(returns[chosen])
                losses[kind] = (errors**2).mean()
            clipped = ((ratio - 1).abs() > 0.2).double()
            sums = (ratio - 1 - ratio.log()).sum(), clipped.sum(), policy.entropy().sum()
            told += [value.item() / 700 for value in sums]
            for name, loss in losses.items():
                optimisers[name].zero_grad()
                loss.backward()
                parameters = twins[name].parameters()
                norm = torch.nn.utils.clip_grad_norm_(parameters, max_gradient_norm)
                norms[name] = norm.item()
                optimisers[name].step()
    before = {name: own.copy() for name, own in ppo.learner.parameters.items()}
    update = ppo.update(batch, targets)
    assert update.gradient_norms == pytest.approx(norms, rel=1e-3)
    found = [update.approximate_kl, update.clip_fraction, update.entropy]
    assert found == pytest.approx(told, rel=1e-3) and min(told) > 0
    for name, twin in twins.items():
        expected, found = twin.flat(twin.parameters()), ppo.learner.parameters[name]
        assert np.abs(found - before[name]).max() > 1e-3
        np.testing.assert_allclose(found, expected, atol=2e-5, err_msg=name)


@both_environments
@pytest.mark.parametrize("minibatch_size", [None, 45])
def test_both_learners_learn_the_same(make_ppo, environment, minibatch_size):
    """Updates from the same weights and minibatches, and what the meta gradient asks, to rounding.

    Ratios are inside the bounds and outside, on each side with each sign of the advantage.
    """
    settings = {"minibatch_size": minibatch_size, "entropy_coefficient": 0.05}
    made = [make_ppo(environment, 5, True, engine, **settings) for engine in ("compiled", "torch")]
    batch, returns = random_batch(made[0], count=700)
    compiled, plain = (ppo.learner for ppo in made)
    assert isinstance(compiled, CompiledLearner) and isinstance(plain, TorchLearner)
    policies = [ppo.policy for ppo in made]
    policies[1].network.load_module_state(policies[0].network.module().state_dict())
    policies[1].log_std[:] = policies[0].log_std
    twins = {"actor": Twin(policies[0])} | {k: Twin(one) for k, one in made[0].critics.items()}

    def in_columns(flat: np.ndarray, name: str = "actor") -> np.ndarray:
        """A vector in the order of a torch module's parameters in that of a compiled network's."""
        shapes = [part.shape for part in twins[name].parameters()]
        ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
        parts = zip(np.split(flat, ends), shapes, strict=True)
        return twins[name].flat(torch.from_numpy(part.reshape(shape)) for part, shape in parts)

    direction = np.random.default_rng(0).standard_normal(len(policies[1].parameters))
    directions = in_columns(direction).astype(np.float32), direction.astype(np.float32)
    for learner, own in zip((compiled, plain), directions, strict=True):
        assert (learner.preconditioned(own) == own).all()  # before the first step
    for count in (700, 690):
        part = Batch(*(array[:count] for array in batch))
        targets = {kind: values[:count] for kind, values in returns.items()}
        one, other = (ppo.update(part, targets) for ppo in made)
        assert one.gradient_norms == pytest.approx(other.gradient_norms, rel=1e-3)
        told = [[u.approximate_kl, u.clip_fraction, u.entropy] for u in (one, other)]
        assert told[0] == pytest.approx(told[1], rel=1e-3) and told[0][1] > 0.1
    for name, ours in compiled.parameters.items():
        np.testing.assert_allclose(ours, in_columns(plain.parameters[name], name), atol=3e-5)
    seen, done = batch.observations, batch.actions
    asked = [
        (*learner.policy_gradients(seen, done, [batch.advantages]), learner.preconditioned(own))
        for learner, own in zip((compiled, plain), directions, strict=True)
    ]
    for ours, theirs in zip(*asked, strict=True):
        tolerance = 2e-3 * np.abs(ours).max()
        np.testing.assert_allclose(ours, in_columns(theirs), rtol=2e-3, atol=tolerance)


@pytest.mark.parametrize("seed", range(3))
def test_twenty_episodes_of_both_learners_agree(run_config, seed):
    """Their curves are equal: no sampled action hangs on the last bits."""
    curves = [
        [record.extrinsic_return for record in finish(run_config(seed=seed, **settings)).records]
        for settings in ({"episodes": 20, "engine": one} for one in ("compiled", "torch"))
    ]
    assert curves[0] == curves[1] and len(set(curves[0])) > 5
