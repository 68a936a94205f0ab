"""Advantages and the scales of rewards: from their definitions, and what the scales are for."""

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TransformReward
from shared import Bonanza, Twin, finish

from mace_rl.agent.advantages import generalised_advantages
from mace_rl.agent.scale import RewardScale
from mace_rl.bonus.curiosity import Curiosity


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
    found, _ = generalised_advantages(rewards, values, discount, gae_lambda)
    np.testing.assert_allclose(found, expected)


def discounted_sums(rewards: np.ndarray, discount: float) -> list[float]:
    steps = range(len(rewards))
    return [sum(discount ** (t - i) * rewards[i] for i in range(t + 1)) for t in steps]


@pytest.mark.parametrize("kind", ["extrinsic", "intrinsic"])
@pytest.mark.parametrize("gae_lambda", [0.9, 1.0])
@pytest.mark.parametrize("terminated", [True, False])
@pytest.mark.parametrize("scaled", [True, False])
def test_truncation_alone_bootstraps(make_ppo, kind, gae_lambda, terminated, scaled):
    """Of rewards as they are, or over the deviation of their discounted sums, these included."""
    settings = {"scale_rewards": scaled, "scale_advantages": scaled}
    ppo = make_ppo(intrinsic=True, gae_lambda=gae_lambda, **settings)
    rng = np.random.default_rng(2)
    observations, paid = rng.standard_normal((6, 4)).astype(np.float32), 3 * rng.random(5)
    rewards = paid / np.std(discounted_sums(paid, 0.99)) if scaled else paid
    values = Twin(ppo.critics[kind])(observations)[:, 0].detach().numpy()
    worth = 0.0 if terminated else values[5]
    assert abs(values[5]) > 0.05
    found, returns, _ = ppo.advantages(kind, observations, paid, terminated)
    assert (ppo.advantage_scale(kind) == 1) != scaled
    # Backwards, the λ-return is r + γ ((1 − λ) V(s') + λ the next λ-return).
    following = worth
    for t in range(4, -1, -1):
        bootstrap = worth if t == 4 else values[t + 1]
        following = rewards[t] + 0.99 * ((1 - gae_lambda) * bootstrap + gae_lambda * following)
        assert returns[t] == pytest.approx(following, abs=1e-5)
        assert found[t] == pytest.approx(following - values[t], abs=1e-5)


@pytest.mark.parametrize("smallest", [1e-8, 3.0])
@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99, 1.0])
def test_reward_scale_is_the_deviation_of_discounted_sums_or_smallest(discount, smallest):
    scale, sums, rng = RewardScale(discount, smallest), [], np.random.default_rng(0)
    assert scale.value == max(1.0, smallest)  # nothing seen yet
    for length in (1, 7, 2, 30, 1, 12):
        rewards = 0.7 + rng.standard_normal(length)
        scale.update(rewards)
        sums += discounted_sums(rewards, discount)
        if len(sums) > 1:
            assert scale.value == pytest.approx(max(np.std(sums), smallest), rel=1e-9)
    constant = RewardScale(0.0, 1e-8)
    constant.update(np.ones(30))
    assert constant.value > 0.1  # rewards that have not varied are not blown up


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    ("kind", "smallest", "least"), [("extrinsic", 1.0, 0.1), ("intrinsic", 0.0, 0.0)]
)
def test_scales_of_several_episodes(make_ppo, kind, smallest, least, unit):
    """γ = 0 and critics that say 0: a step's discounted sum and advantage are its reward.

    Tiny extrinsic rewards are not blown up: they are over at least 1, their advantages over 0.1.
    """
    ppo, paid, seen = make_ppo(intrinsic=True, discount=0.0), [], []
    ppo.critics[kind].parameters[:] = 0
    for rewards in unit * np.array([[4.0, -4.0], [0.0, 0.0], [8.0, -8.0]]):
        paid += rewards.tolist()
        expected = rewards / max(np.std(paid), smallest)
        found = ppo.advantages(kind, np.zeros((3, 4)), rewards, True).advantages
        np.testing.assert_allclose(found, expected)
        seen += expected.tolist()
        mean_square = np.mean(np.square(seen))
        assert ppo.advantage_scale(kind) == pytest.approx(max(math.sqrt(mean_square), least))


@pytest.mark.parametrize(("reward", "bonus"), [(128.0, 1.0), (64.0, 2.0**-10)])
def test_units_do_not_matter(run_config, register, monkeypatch, reward, bonus):
    """To the bit, as a power of two rounds nothing; unscaled they do matter."""
    curiosity = Curiosity.bonus

    def learned(reward: float, bonus: float, scaled: bool) -> dict[str, bytes]:
        def paid() -> gymnasium.Env:
            return TransformReward(Bonanza(), lambda r: reward * r)

        def in_units(self, episode):
            found = curiosity(self, episode)
            return found._replace(reward=bonus * found.reward)

        monkeypatch.setattr(Curiosity, "bonus", in_units)
        ppo = {"rollout_steps": 20, "scale_rewards": scaled, "scale_advantages": scaled}
        name = register("Paid-v0", paid, 5)
        novelty = {"refresh_every": 10}
        trainer = finish(run_config(name, "mace_fixed", episodes=40, ppo=ppo, novelty=novelty))
        assert len(trainer.curiosity.novelty.visited) > 20  # all of novelty was at work
        assert sum(record.extrinsic_return for record in trainer.records) > 40 * reward
        return {name: own.tobytes() for name, own in trainer.ppo.learner.parameters.items()}

    for scaled in (True, False):
        same = learned(64.0, 1.0, scaled) == learned(reward, bonus, scaled)
        assert same == scaled


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
    constant, same = make_ppo(normalise_observations=True), np.full((5, 4), 3.25, np.float32)
    assert (constant.normalise(same) == same).all()  # nothing seen yet
    constant.normaliser.update(same)
    assert (constant.normalise(same) == 0).all()  # never varied: only centred
