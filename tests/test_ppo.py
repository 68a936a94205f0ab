"""PPO's gradients and updates, against autograd and a loop written out here."""

import copy
import math
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from shared import Twin

from mace_rl.agent.adam import Adam
from mace_rl.agent.ppo import PPO, Batch
from mace_rl.streams import Streams

ENVIRONMENTS = ["CartPole-v1", "Pendulum-v1"]  # Discrete and Box actions

both_engines = pytest.mark.parametrize("engine", ["compiled", "torch"])
both_environments = pytest.mark.parametrize("environment", ENVIRONMENTS)


def random_batch(ppo: PPO, count=40, seed=0, spread=0.4) -> Batch:
    """A batch whose log-probabilities are off by `spread`, so that many ratios are clipped."""
    rng, policy = np.random.default_rng(seed), ppo.policy
    own = Twin(policy).own()
    policy.parameters += 0.3 * own * rng.standard_normal(len(own)).astype(np.float32)
    size = len(ppo.normaliser.mean)
    observations = rng.standard_normal((count, size)).astype(np.float32)
    outputs = policy.forward(observations).outputs
    actions = (
        rng.integers(outputs.shape[1], size=count)
        if policy.discrete
        else rng.standard_normal(outputs.shape).astype(np.float32)
    )
    noise = spread * rng.standard_normal(count)
    return Batch(
        observations=observations,
        actions=actions,
        log_probs=(policy.log_probs(outputs, actions) + noise).astype(np.float32),
        advantages=rng.standard_normal(count).astype(np.float32),
        returns={kind: rng.standard_normal(count).astype(np.float32) for kind in ppo.critics},
    )


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
@pytest.mark.parametrize("entropy_coefficient", [0.0, 0.05])
def test_actor_gradient_is_that_of_the_clipped_surrogate(
    make_ppo, environment, entropy_coefficient, engine
):
    """Autograd through min and clamp, torch.distributions below."""
    ppo = make_ppo(environment, engine=engine, entropy_coefficient=entropy_coefficient)
    batch = random_batch(ppo)
    twin = Twin(ppo.policy)
    policy = twin.policy(batch.observations)
    mean, ratio = surrogate(policy, batch)
    # All cases occur: inside, and outside on each side with each sign of the advantage.
    advantage = torch.from_numpy(batch.advantages)
    assert len(torch.stack([ratio > 1.2, ratio < 0.8, advantage > 0], dim=1).unique(dim=0)) == 6
    expected = twin.gradient(-mean - entropy_coefficient * policy.entropy().mean())
    gradient = ppo.actor_gradient(batch, np.zeros(3))
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-5)


@both_engines
@both_environments
def test_policy_gradients_equal_autograd(make_ppo, environment, engine):
    ppo = make_ppo(environment, engine=engine)
    batch = random_batch(ppo)
    several = [batch.advantages, np.ones(40), batch.advantages.astype(np.float64) ** 2]
    twin = Twin(ppo.policy)
    log_probs = twin.policy(batch.observations).log_prob(torch.from_numpy(batch.actions))
    found = ppo.policy_gradients(batch.observations, batch.actions, several)
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
    batch = random_batch(ppo, count=700, spread=0.05)
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
        for part in (batch[places[a:b]] for a, b in pairwise(ends)):
            policy = twins["actor"].policy(part.observations)
            mean, ratio = surrogate(policy, part)
            losses = {"actor": -mean - entropy_coefficient * policy.entropy().mean()}
            for kind, returns in part.returns.items():
                errors = twins[kind](part.observations)[:, 0] - torch.from_numpy(returns)
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
    before = {name: adam.parameters.copy() for name, adam in ppo.optimisers.items()}
    update = ppo.update(batch)
    assert update.gradient_norms == pytest.approx(norms, rel=1e-3)
    found = [update.approximate_kl, update.clip_fraction, update.entropy]
    assert found == pytest.approx(told, rel=1e-3) and min(told) > 0
    for name, twin in twins.items():
        expected, found = twin.flat(twin.parameters()), ppo.optimisers[name].parameters
        assert np.abs(found - before[name]).max() > 1e-3
        np.testing.assert_allclose(found, expected, atol=2e-5, err_msg=name)


@both_environments
@pytest.mark.parametrize("entropy_coefficient", [0.0, 0.05])
@pytest.mark.parametrize("minibatch_size", [None, 256, 64, 45])
def test_the_compiled_update_has_the_bits_of_step_by_step(
    make_ppo, environment, entropy_coefficient, minibatch_size
):
    """Weights, Adam's state and what the update tells; zeros added to the layers stay zeros."""
    settings = {"minibatch_size": minibatch_size, "entropy_coefficient": entropy_coefficient}
    made = [make_ppo(environment, 5, intrinsic=True, **settings) for _ in range(2)]
    batches = [random_batch(ppo, count=700, spread=0.2) for ppo in made]
    start = made[0].policy.parameters.copy()
    general = made[1]
    for owner in (general.policy, *general.critics.values()):
        one = owner.network  # and nobody can tell that it is compiled
        owner.network = SimpleNamespace(
            parameters=one.parameters, forward=one.forward, backward=one.backward
        )
    with patch.object(Adam, "step", autospec=True, side_effect=Adam.step) as step:
        updates = []
        for ppo, batch in zip(made, batches, strict=True):
            assert step.call_count == 0  # in one call
            updates.append([ppo.update(batch[:690]), ppo.update(batch)])
    count = 1 if minibatch_size is None else math.ceil(700 / minibatch_size)
    assert step.call_count == 3 * 4 * 2 * count  # networks, epochs, updates
    assert updates[0] == updates[1]
    assert updates[0][1].clip_fraction > 0 and min(updates[0][1].gradient_norms.values()) > 0
    assert (made[0].policy.parameters != start).mean() > 0.5
    states = [ppo.state_dict() for ppo in made]
    assert states[0].pop("minibatches") == states[1].pop("minibatches")
    torch.testing.assert_close(*states, rtol=0, atol=0)
    twins = {"actor": Twin(made[0].policy)} | {k: Twin(v) for k, v in made[0].critics.items()}
    for name, twin in twins.items():
        added, adam = ~twin.own(), made[0].optimisers[name]
        assert added.any()
        for array in (adam.parameters, adam.mean, adam.square):
            assert (array[added] == 0).all() and (array[~added] != 0).mean() > 0.9
