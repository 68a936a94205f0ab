"""PPO's advantages from their definition, the scales of rewards, and normalised observations."""

import math

import numpy as np
import pytest
from shared import Twin

from mace_rl.agent.advantages import generalised_advantages
from mace_rl.agent.ppo import PPO


def test_advantages_by_hand():
    # γ = λ = ½. δ: 1 + ½·1 − 1 = ½, 2 + ½·1 − 1 = 1½, 3 + ½·4 − 1 = 4; each earlier one adds a
    # quarter of the advantage that follows: 4, 1½ + 4/4 = 2½, ½ + 2½/4 = 1⅛.
    rewards, values = np.array([1.0, 2.0, 3.0]), np.array([1.0, 1.0, 1.0, 4.0])
    found = generalised_advantages(rewards, values, 0.5, 0.5)
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
    found = generalised_advantages(rewards, values, discount, gae_lambda)
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize("kind", ["extrinsic", "intrinsic"])
@pytest.mark.parametrize("gae_lambda", [0.9, 1.0])
@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("scaled", [True, False])
def test_truncation_bootstraps_and_termination_never(
    make_ppo, kind, gae_lambda, terminated, scaled
):
    """Of rewards as they are, or over the deviation of their discounted sums, these included."""
    ppo = make_ppo(intrinsic=True, gae_lambda=gae_lambda, scale_rewards=scaled)
    rng = np.random.default_rng(2)
    observations, paid = rng.standard_normal((6, 4)).astype(np.float32), 3 * rng.random(5)
    sums = [sum(0.99 ** (t - i) * paid[i] for i in range(t + 1)) for t in range(5)]
    rewards = paid / np.std(sums) if scaled else paid
    values = Twin(ppo.critics[kind])(observations)[:, 0].detach().numpy()
    worth = 0.0 if terminated else values[5]
    assert abs(values[5]) > 0.05
    found, returns = ppo.advantages_and_returns(kind, observations, paid, terminated)
    # Backwards, the λ-return is r + γ ((1 − λ) V(s') + λ the next λ-return).
    following = worth
    for t in range(4, -1, -1):
        bootstrap = worth if t == 4 else values[t + 1]
        following = rewards[t] + 0.99 * ((1 - gae_lambda) * bootstrap + gae_lambda * following)
        assert returns[t] == pytest.approx(following, abs=1e-5)
        assert found[t] == pytest.approx(following - values[t], abs=1e-5)


def silenced(ppo: PPO) -> PPO:
    """With critics that say 0, so that with λ = 1 advantages are discounted sums."""
    for critic in ppo.critics.values():
        critic.network.parameters[:] = 0
    return ppo


def test_advantages_without_scales_are_the_plain_ones(make_ppo):
    """γ = ½, λ = 1: 8; 4 + ½ 8 = 8; 2 + ½ 8 = 6; whatever came before."""
    plain = {"scale_rewards": False, "scale_advantages": False, "gae_lambda": 1.0, "discount": 0.5}
    ppo = silenced(make_ppo(intrinsic=True, **plain))
    for kind in ("extrinsic", "intrinsic"):
        for unit in (1, 1000, 0.001):
            rewards = unit * np.array([2.0, 4.0, 8.0])
            advantages, returns = ppo.advantages_and_returns(kind, np.zeros((4, 4)), rewards, True)
            assert advantages.tolist() == returns.tolist() == [6 * unit, 8 * unit, 8 * unit]
            assert ppo.advantage_scale(kind) == 1.0


def test_scales_of_several_episodes_by_hand(make_ppo):
    """γ = 0, so that a step's discounted sum and advantage are its reward."""
    ppo = silenced(make_ppo(intrinsic=True, discount=0.0))
    # The rewards' deviation so far; of all advantages so far, each over its own, the mean square.
    for rewards, deviation, square in (
        ([4.0, -4.0], 4.0, 1.0),  # ±1
        ([0.0, 0.0], math.sqrt(8), 0.5),  # 0
        ([8.0, -8.0], math.sqrt(160 / 6), (1 + 1 + 2 * 64 * 6 / 160) / 6),
    ):
        for kind in ("extrinsic", "intrinsic"):
            found, _ = ppo.advantages_and_returns(kind, np.zeros((3, 4)), np.array(rewards), True)
            np.testing.assert_allclose(found, np.array(rewards) / deviation)
            assert ppo.advantage_scale(kind) == pytest.approx(math.sqrt(square))


def test_tiny_costs_are_not_blown_up(make_ppo):
    """Extrinsic rewards are over at least 1, their advantages over at least 0.1."""
    ppo, rewards = silenced(make_ppo(intrinsic=True, discount=0.0)), np.array([-0.003, 0.001])
    extrinsic, intrinsic = (
        ppo.advantages_and_returns(kind, np.zeros((3, 4)), rewards, True)[0]
        / ppo.advantage_scale(kind)
        for kind in ("extrinsic", "intrinsic")
    )
    np.testing.assert_allclose(extrinsic, [-0.03, 0.01])
    np.testing.assert_allclose(intrinsic, np.array([-3, 1]) / math.sqrt(5))


# --- Normalisation ------------------------------------------------------------------------------


def test_observations_are_standardised_by_everything_seen_and_clipped(make_ppo):
    ppo = make_ppo(normalise_observations=True)
    rng = np.random.default_rng(4)
    seen = rng.standard_normal((90, 4)) * [1, 5, 0.1, 3] + [0, 100, -1, 2]
    for part in (seen[:1], seen[1:30], seen[30:]):
        ppo.normaliser.update(part)
    observations = np.concatenate([seen[:10], [[500, 0, 0, -500]]]).astype(np.float32)
    expected = np.clip((observations - seen.mean(0)) / seen.std(0), -10, 10)
    found = ppo.normalise(observations)
    assert found.dtype == np.float32 and np.abs(found[-1]).max() == 10
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert make_ppo(normalise_observations=False).normalise(observations) is observations


def test_a_dimension_that_never_varied_is_only_centred(make_ppo):
    ppo = make_ppo(normalise_observations=True)
    observations = np.full((5, 4), 3.25, np.float32)
    assert (ppo.normalise(observations) == observations).all()  # nothing seen yet
    ppo.normaliser.update(observations)
    assert (ppo.normalise(observations) == 0).all()
