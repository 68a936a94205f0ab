"""PPO: advantages from their definition, updates against autograd and a loop written out here."""

import copy
import math
from itertools import chain

import numpy as np
import pytest
import torch

from mace_rl.environments import Environment
from mace_rl.learner import Learner
from mace_rl.ppo import PPO, Batch, advantages
from mace_rl.streams import numpy_generator

ENVIRONMENTS = ["CartPole-v1", "Pendulum-v1"]  # Discrete and Box actions


@pytest.fixture
def make_ppo(run_config):
    """`make_ppo(environment, seed, intrinsic, **settings of ppo)`."""

    def make(environment="CartPole-v1", seed=0, intrinsic=False, **settings) -> PPO:
        config = run_config(environment, "ppo", seed, ppo=settings).ppo
        return PPO(config, Environment(environment, seed), seed, intrinsic)

    return make


def random_batch(ppo: PPO, count=40, seed=0, spread=0.4) -> Batch:
    """A batch whose log-probabilities are off by `spread`, so that many ratios are clipped."""
    rng = np.random.default_rng(seed)
    ppo.actor.parameters += 0.3 * rng.standard_normal(len(ppo.actor.parameters)).astype(np.float32)
    observations = rng.standard_normal((count, ppo.actor.sizes[0])).astype(np.float32)
    actions = (
        rng.integers(ppo.actor.sizes[-1], size=count)
        if ppo.actor.discrete
        else rng.standard_normal((count, ppo.actor.sizes[-1])).astype(np.float32)
    )
    log_probs = ppo.actor.log_probs(ppo.actor.forward(observations)[-1], actions)
    return Batch(
        observations=observations,
        actions=actions,
        log_probs=(log_probs + spread * rng.standard_normal(count)).astype(np.float32),
        advantages=rng.standard_normal(count).astype(np.float32),
        returns={kind: rng.standard_normal(count).astype(np.float32) for kind in ppo.critics},
    )


# --- Advantages ---------------------------------------------------------------------------------


def test_advantages_by_hand():
    # γ = λ = ½. δ: 1 + ½·1 − 1 = ½, 2 + ½·1 − 1 = 1½, 3 + ½·4 − 1 = 4; each earlier one adds a
    # quarter of the advantage that follows: 4, 1½ + 4/4 = 2½, ½ + 2½/4 = 1⅛.
    found = advantages(np.array([1.0, 2.0, 3.0]), np.array([1.0, 1.0, 1.0, 4.0]), 0.5, 0.5)
    assert found.tolist() == [1.125, 2.5, 4.0]


@pytest.mark.parametrize("gae_lambda", [0.0, 0.3, 0.95, 1.0])
@pytest.mark.parametrize("discount", [0.0, 0.9, 0.99, 1.0])
def test_advantages_are_the_weighted_mean_of_k_step_ones(discount, gae_lambda):
    """Schulman et al. 2016, eq. 16 as it is stated, before the telescoping that gives δ."""
    rng = np.random.default_rng(0)
    length = 17
    rewards, values = rng.standard_normal(length), rng.standard_normal(length + 1)

    def k_step(t: int, k: int) -> float:
        rewarded = sum(discount**i * rewards[t + i] for i in range(k))
        return rewarded + discount**k * values[t + k] - values[t]

    expected = []
    for t in range(length):
        most = length - t  # all longer ones are equal: nothing follows the end
        weighted = sum(
            (1 - gae_lambda) * gae_lambda ** (k - 1) * k_step(t, k) for k in range(1, most)
        )
        expected.append(weighted + gae_lambda ** (most - 1) * k_step(t, most))
    np.testing.assert_allclose(advantages(rewards, values, discount, gae_lambda), expected)


@pytest.mark.parametrize("last_value", [0.0, 3.5])
def test_with_lambda_1_advantage_is_monte_carlo_return_minus_value(last_value):
    rng = np.random.default_rng(1)
    rewards, values = rng.standard_normal(9), rng.standard_normal(10)
    values[-1] = last_value
    returns = [
        sum(0.9 ** (i - t) * rewards[i] for i in range(t, 9)) + 0.9 ** (9 - t) * last_value
        for t in range(9)
    ]
    np.testing.assert_allclose(advantages(rewards, values, 0.9, 1.0), returns - values[:-1])


@pytest.mark.parametrize("kind", ["extrinsic", "intrinsic"])
@pytest.mark.parametrize("gae_lambda", [0.9, 1.0])
@pytest.mark.parametrize("terminated", [True, False])
def test_truncation_bootstraps_and_termination_never(make_ppo, twin, kind, gae_lambda, terminated):
    ppo = make_ppo(intrinsic=True, gae_lambda=gae_lambda)
    rng = np.random.default_rng(2)
    observations, rewards = rng.standard_normal((6, 4)).astype(np.float32), rng.random(5)
    values = twin(ppo.critics[kind])(observations)[:, 0].detach().numpy()
    worth = 0.0 if terminated else values[5]
    assert abs(values[5]) > 0.05
    found, returns = ppo.advantages_and_returns(kind, observations, rewards, terminated)
    # Backwards, the λ-return is r + γ ((1 − λ) V(s') + λ the next λ-return).
    following = worth
    for t in range(4, -1, -1):
        bootstrap = worth if t == 4 else values[t + 1]
        following = rewards[t] + 0.99 * ((1 - gae_lambda) * bootstrap + gae_lambda * following)
        assert returns[t] == pytest.approx(following, abs=1e-5)
        assert found[t] == pytest.approx(following - values[t], abs=1e-5)


@pytest.mark.parametrize("terminated", [True, False])
def test_only_a_truncated_episode_depends_on_its_last_state(make_ppo, terminated):
    ppo = make_ppo()
    observations = np.random.default_rng(3).standard_normal((6, 4)).astype(np.float32)
    before, _ = ppo.advantages_and_returns("extrinsic", observations, np.ones(5), terminated)
    observations[-1] *= -1
    after, _ = ppo.advantages_and_returns("extrinsic", observations, np.ones(5), terminated)
    assert (before == after).all() == terminated


# --- Normalisation ------------------------------------------------------------------------------


def test_observations_are_standardised_by_everything_seen_and_clipped(make_ppo):
    ppo = make_ppo(normalise_observations=True)
    rng = np.random.default_rng(4)
    seen = rng.standard_normal((90, 4)) * [1, 5, 0.1, 3] + [0, 100, -1, 2]
    for part in (seen[:1], seen[1:30], seen[30:]):
        ppo.standardiser.update(part)
    observations = np.concatenate([seen[:10], [[500, 0, 0, -500]]]).astype(np.float32)
    expected = np.clip((observations - seen.mean(0)) / seen.std(0), -10, 10)
    found = ppo.normalise(observations)
    assert found.dtype == np.float32 and np.abs(found[-1]).max() == 10
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert make_ppo().normalise(observations) is observations


def test_a_dimension_that_never_varied_is_only_centred(make_ppo):
    ppo = make_ppo(normalise_observations=True)
    observations = np.full((5, 4), 3.25, np.float32)
    assert (ppo.normalise(observations) == observations).all()  # nothing seen yet
    ppo.standardiser.update(observations)
    assert (ppo.normalise(observations) == 0).all()


# --- Gradients ----------------------------------------------------------------------------------


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("entropy_coefficient", [0.0, 0.05])
def test_actor_gradient_is_that_of_the_clipped_surrogate(
    make_ppo, twin, environment, entropy_coefficient
):
    """Autograd through min and clamp as the paper writes them, torch.distributions below."""
    ppo = make_ppo(environment, entropy_coefficient=entropy_coefficient)
    batch = random_batch(ppo)
    other = twin(ppo.actor)
    policy, advantage = other.policy(batch.observations), torch.from_numpy(batch.advantages)
    log_probs = policy.log_prob(torch.from_numpy(batch.actions))
    ratio = (log_probs - torch.from_numpy(batch.log_probs)).exp()
    surrogate = torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    expected = other.gradient(-surrogate - entropy_coefficient * policy.entropy().mean())
    # All cases occur: inside, and outside on each side with each sign of the advantage.
    cases = torch.stack([ratio > 1.2, ratio < 0.8, advantage > 0], dim=1).unique(dim=0)
    assert len(cases) == 6
    np.testing.assert_allclose(ppo.actor_gradient(batch), expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_gradients_are_means_over_all_steps_of_a_large_batch(make_ppo, monkeypatch, environment):
    """Of what each step alone gives: blocks, also an incomplete last one, leave no trace."""
    ppo = make_ppo(environment)
    batch = random_batch(ppo, count=20)
    for gradient in (ppo.actor_gradient, lambda part: ppo.critic_gradient("extrinsic", part)):
        expected = np.mean([gradient(batch[t : t + 1]) for t in range(20)], axis=0)
        for block in (1, 7, 20, 512):
            monkeypatch.setattr("mace_rl.ppo.BLOCK", block)
            np.testing.assert_allclose(gradient(batch), expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("ratio", "advantage", "flat"),
    [
        (1.3, 1.0, True),  # good action, already much likelier: no more
        (1.3, -1.0, False),  # bad action, likelier: correct it
        (0.7, -1.0, True),  # bad action, already much less likely: no less
        (0.7, 1.0, False),  # good action, less likely: correct it
        (1.1, 1.0, False),
        (0.9, -1.0, False),
    ],
)
def test_surrogate_is_flat_only_where_the_advantage_already_pushed(
    make_ppo, ratio, advantage, flat
):
    ppo = make_ppo(entropy_coefficient=0.0)
    observations, actions = np.ones((1, 4), np.float32), np.array([1])
    log_prob = ppo.actor.log_probs(ppo.actor.forward(observations)[-1], actions)
    batch = Batch(
        observations=observations,
        actions=actions,
        log_probs=log_prob - np.float32(math.log(ratio)),
        advantages=np.array([advantage], np.float32),
        returns={},
    )
    assert (ppo.actor_gradient(batch) == 0).all() == flat


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_policy_gradients_equal_autograd(make_ppo, twin, environment):
    ppo = make_ppo(environment)
    batch = random_batch(ppo)
    several = [batch.advantages, np.ones(40), batch.advantages.astype(np.float64) ** 2]
    other = twin(ppo.actor)
    log_probs = other.policy(batch.observations).log_prob(torch.from_numpy(batch.actions))
    found = ppo.policy_gradients(batch.observations, batch.actions, several)
    for gradient, advantage in zip(found, several, strict=True):
        mean = (log_probs * torch.from_numpy(advantage)).mean()
        expected = torch.autograd.grad(mean, other.parameters(), retain_graph=True)
        np.testing.assert_allclose(gradient, other.flat(expected), rtol=1e-3, atol=1e-5)
        assert gradient.dtype == np.float32


# --- Updates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_gradient_norm", [0.05, 1e9])
def test_learner_equals_torch_adam_with_clipping(make_ppo, max_gradient_norm):
    network = make_ppo().actor
    expected = torch.nn.Parameter(torch.from_numpy(network.parameters.astype(np.float64)))
    optimiser = torch.optim.Adam([expected], lr=0.01, eps=1e-5)
    learner = Learner(network.parameters, 0.01, max_gradient_norm)
    rng = np.random.default_rng(0)
    for _ in range(30):
        gradient = 0.01 * rng.standard_normal(len(network.parameters))
        expected.grad = torch.tensor(gradient)
        norm = torch.nn.utils.clip_grad_norm_([expected], max_gradient_norm)
        optimiser.step()
        assert learner.descend(gradient.astype(np.float32)) == pytest.approx(float(norm), rel=1e-5)
    np.testing.assert_allclose(network.parameters, expected.detach().numpy(), atol=2e-5)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("minibatch_size", [None, 16])
def test_update_equals_a_reference_loop(make_ppo, twin, environment, minibatch_size):
    """Epochs, minibatches, losses, clipping and Adam written out in float64 over autograd."""
    ppo = make_ppo(
        environment, seed=5, intrinsic=True, minibatch_size=minibatch_size, max_gradient_norm=0.3
    )
    batch = random_batch(ppo, spread=0.05)
    networks = {"actor": twin(ppo.actor)} | {k: twin(v) for k, v in ppo.critics.items()}
    moments = {
        name: [(torch.zeros_like(p), torch.zeros_like(p)) for p in network.parameters()]
        for name, network in networks.items()
    }
    advantage, old = torch.from_numpy(batch.advantages), torch.from_numpy(batch.log_probs)
    order = numpy_generator(5, "minibatches")
    time, last_norms = 0, {}
    for _ in range(4):
        places = order.permutation(40) if minibatch_size else np.arange(40)
        for start in range(0, 40, minibatch_size or 40):
            chosen = places[start : start + (minibatch_size or 40)]
            time += 1
            policy = networks["actor"].policy(batch.observations[chosen])
            ratio = (policy.log_prob(torch.from_numpy(batch.actions[chosen])) - old[chosen]).exp()
            losses = {
                "actor": -torch.min(
                    ratio * advantage[chosen], ratio.clamp(0.8, 1.2) * advantage[chosen]
                ).mean()
                - 0.01 * policy.entropy().mean()
            }
            for kind, returns in batch.returns.items():
                errors = networks[kind](batch.observations[chosen])[:, 0]
                losses[kind] = ((errors - torch.from_numpy(returns[chosen])) ** 2).mean()
            for name, loss in losses.items():
                parameters = networks[name].parameters()
                gradients = torch.autograd.grad(loss, parameters)
                norm = math.sqrt(sum(float((g**2).sum()) for g in gradients))
                last_norms[name] = norm
                rate = 3e-4 if name == "actor" else 1e-3
                for p, g, (mean, square) in zip(parameters, gradients, moments[name], strict=True):
                    g = g * min(1.0, 0.3 / norm)
                    mean.mul_(0.9).add_(0.1 * g)
                    square.mul_(0.999).add_(0.001 * g * g)
                    step = (mean / (1 - 0.9**time)) / ((square / (1 - 0.999**time)).sqrt() + 1e-5)
                    p.data -= rate * step
    before = {name: learner.parameters.copy() for name, learner in ppo.learners.items()}
    norms = ppo.update(batch)
    assert norms == pytest.approx(last_norms, rel=1e-3)
    for name, network in networks.items():
        expected, found = network.flat(network.parameters()), ppo.learners[name].parameters
        assert np.abs(found - before[name]).max() > 1e-3
        np.testing.assert_allclose(found, expected, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("minibatch_size", [None, 1, 4, 10, 64])
def test_minibatches_partition_the_batch_in_every_epoch(make_ppo, monkeypatch, minibatch_size):
    ppo = make_ppo(epochs=3, minibatch_size=minibatch_size)
    batch = random_batch(ppo, count=10)
    seen: list[list[int]] = []
    rows = {tuple(row): number for number, row in enumerate(batch.observations.tolist())}
    forward = type(ppo.actor).forward

    def watched(network, inputs):
        if network is ppo.actor:
            seen.append([rows[tuple(row)] for row in inputs.tolist()])
        return forward(network, inputs)

    monkeypatch.setattr(type(ppo.actor), "forward", watched)
    ppo.update(batch)
    per_epoch = math.ceil(10 / (minibatch_size or 10))
    assert len(seen) == 3 * per_epoch
    epochs = [[*chain(*seen[i : i + per_epoch])] for i in range(0, len(seen), per_epoch)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert all(len(part) <= (minibatch_size or 10) for part in seen)
    if minibatch_size:
        assert epochs[0] != epochs[1] != epochs[2]


def test_intrinsic_reward_cannot_reach_the_extrinsic_critic(make_ppo):
    plain, curious = make_ppo(), make_ppo(intrinsic=True)
    batch = random_batch(plain)
    random_batch(curious)  # changes its weights alike
    extended = copy.copy(batch.returns) | {"intrinsic": np.full(40, 1e3, np.float32)}
    initial = curious.critics["intrinsic"].parameters.copy()
    for _ in range(3):
        plain.update(batch)
        curious.update(Batch(**{**vars(batch), "returns": extended}))
    for name in ("actor", "extrinsic"):
        mine, theirs = plain.learners[name], curious.learners[name]
        for part in ("parameters", "mean", "square"):
            assert (getattr(mine, part) == getattr(theirs, part)).all()
    assert (initial != curious.critics["intrinsic"].parameters).any()


def test_critics_learn_their_own_returns(make_ppo):
    """The value functions approach constant returns, each its own, and the actor's stays out."""
    ppo = make_ppo(intrinsic=True, critic_learning_rate=0.01)
    batch = random_batch(ppo)
    targets = {"extrinsic": 2.0, "intrinsic": -1.0}
    returns = {kind: np.full(40, value, np.float32) for kind, value in targets.items()}
    for _ in range(100):
        ppo.update(Batch(**{**vars(batch), "returns": returns}))
    for kind, value in targets.items():
        np.testing.assert_allclose(
            ppo.critics[kind].forward(batch.observations)[-1], value, atol=0.05
        )


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_update_makes_good_actions_likelier(make_ppo, environment):
    ppo = make_ppo(environment, entropy_coefficient=0.0)
    batch = random_batch(ppo, spread=0.0)

    def log_probs() -> np.ndarray:
        return ppo.actor.log_probs(ppo.actor.forward(batch.observations)[-1], batch.actions)

    before = log_probs()
    ppo.update(batch)
    assert (batch.advantages * (log_probs() - before)).sum() > 0.01


def test_restored_ppo_continues_to_the_bit(make_ppo):
    original = make_ppo(intrinsic=True, minibatch_size=8, normalise_observations=True)
    batch = random_batch(original)
    original.standardiser.update(batch.observations)
    original.update(batch)
    state = copy.deepcopy(original.state_dict())
    restored = make_ppo(seed=1, intrinsic=True, minibatch_size=8, normalise_observations=True)
    restored.load_state_dict(state)
    assert original.update(batch) == restored.update(batch)
    for name, learner in original.learners.items():
        assert (learner.parameters == restored.learners[name].parameters).all()
    assert (original.normalise(batch.observations) == restored.normalise(batch.observations)).all()
    policies = original.acting_policy(), restored.acting_policy()
    assert all((a == b).all() for a, b in zip(*(p[:5] for p in policies), strict=True))
