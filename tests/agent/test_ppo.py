"""PPO's gradients and updates, against autograd and a loop written out here."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from shared import ENGINES, Twin, finish

from mace_rl.agent.learner import Batch
from mace_rl.agent.ppo import PPO
from mace_rl.base.rng import Streams
from mace_rl.numerics.adam import Adam

# With Discrete and Box actions.
both_environments = pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1"])


def networks(ppo: PPO) -> dict[str, Twin]:
    return {"actor": Twin(ppo.policy)} | {k: Twin(critic) for k, critic in ppo.critics.items()}


def random_batch(ppo: PPO, count=40) -> tuple[Batch, dict[str, np.ndarray]]:
    """A batch whose log-probabilities are off, so that many ratios are clipped; and returns."""
    rng, policy = np.random.default_rng(0), ppo.policy
    own = Twin(policy).own()
    policy.parameters += 0.3 * own * rng.standard_normal(len(own)).astype(np.float32)
    size = len(ppo.normaliser.mean)
    observations = rng.standard_normal((count, size)).astype(np.float32)
    outputs = policy.network.outputs(observations)
    actions = rng.standard_normal(outputs.shape).astype(np.float32)
    if policy.discrete:
        actions = rng.integers(outputs.shape[1], size=count)
    noise = 0.4 * rng.standard_normal(count)
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


@pytest.mark.parametrize("engine", ENGINES)
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


def fisher_yates(draws: np.ndarray) -> list[int]:
    """From the last place to the first one, each chosen from those before it and itself."""
    order = list(range(len(draws)))
    for place in reversed(range(1, len(draws))):
        other = math.floor(draws[place] * (place + 1))
        order[place], order[other] = order[other], order[place]
    return order


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
def test_an_update_of_both_learners_equals_a_reference_loop(make_ppo, environment, changes):
    """Epochs, minibatches and losses written out in float64 over autograd, with torch's Adam.

    Both begin with the same weights. Ratios are inside the bounds and outside.
    """
    defaults = {"minibatch_size": 256, "entropy_coefficient": 0.0, "max_gradient_norm": 0.5}
    minibatch_size, entropy_coefficient, max_gradient_norm = (defaults | changes).values()
    made = [make_ppo(environment, 5, True, engine, **changes) for engine in ENGINES]
    batch, targets = random_batch(made[0], count=700)
    policies = [ppo.policy for ppo in made]
    policies[1].network.load_module_state(policies[0].network.module().state_dict())
    policies[1].log_std[:] = policies[0].log_std
    twins, start = networks(made[0]), networks(made[0])
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
    direction = [part.detach() + 1 for part in twins["actor"].parameters()]
    states = [optimisers["actor"].state[part] for part in twins["actor"].parameters()]
    for ppo in made:
        flat = networks(ppo)["actor"].flat
        asked = flat(direction).astype(np.float32)
        assert (ppo.learner.preconditioned(asked) == asked).all()  # before the first step
        update = ppo.update(batch, targets)
        assert update.gradient_norms == pytest.approx(norms, rel=1e-3)
        found = [update.approximate_kl, update.clip_fraction, update.entropy]
        assert found == pytest.approx(told, rel=1e-3) and min(told) > 0
        for name, learned in networks(ppo).items():
            for part, expected in zip(learned.parameters(), twins[name].parameters(), strict=True):
                torch.testing.assert_close(part, expected, rtol=1e-7, atol=2e-5)
            pairs = zip(learned.parameters(), start[name].parameters(), strict=True)
            assert max((part - before).abs().max() for part, before in pairs if len(part)) > 1e-3
        # Over the root of Adam's second moment, as torch's has it.
        roots = [
            (one["exp_avg_sq"] / (1 - 0.999 ** one["step"])).sqrt() if one else 0 for one in states
        ]
        expected = flat(part / (root + 1e-5) for part, root in zip(direction, roots, strict=True))
        found = ppo.learner.preconditioned(asked)
        np.testing.assert_allclose(found, expected, rtol=5e-3)
        assert found.dtype == np.float32


@pytest.mark.parametrize("seed", range(3))
def test_twenty_episodes_of_both_learners_agree(run_config, seed):
    curves = [
        [record.extrinsic_return for record in finish(run_config(seed=seed, **settings)).records]
        for settings in ({"episodes": 20, "engine": one} for one in ENGINES)
    ]
    assert curves[0] == curves[1] and len(set(curves[0])) > 5
