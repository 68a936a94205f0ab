"""The bonus: novelty × relevance, and relevance in the three cases the paper tells apart."""

import copy
import math
from collections import Counter

import numpy as np
import pytest
from shared import environment_of

from mace_rl.base.rng import Streams
from mace_rl.bonus.curiosity import Curiosity, relevance
from mace_rl.environments.episode import Episode
from mace_rl.training import factories


def episode_of(states, rewards=None) -> Episode:
    """An episode through `states`, [T + 1, observation]."""
    states = np.asarray(states, np.float32)
    zeros = np.zeros(len(states) - 1)
    rewards = zeros if rewards is None else np.asarray(rewards, np.float64)
    return Episode(states, zeros.astype(np.int64), zeros.astype(np.float32), rewards, True)


def wander(seed, centre=0.0, scale=0.3, length=30) -> Episode:
    """Observations of CartPole's shape around `centre`."""
    rng = np.random.default_rng(seed)
    return episode_of(centre + scale * rng.standard_normal((length + 1, 4)))


@pytest.fixture
def make(run_config):
    """`make(environment, **changes)`: curiosity as in a run of mace_full."""

    def build(environment="CartPole-v1", **changes) -> Curiosity:
        novelty = {"write_every": 1, "refresh_every": 1}
        changes = {"memory": {"write_every": 1}, "novelty": novelty} | changes
        config = run_config(environment, "mace_full", 0, **changes)
        return factories.intrinsic_reward(config, environment_of(environment), Streams(0))

    return build


@pytest.mark.parametrize(
    ("similarity", "value", "expected"),
    [
        *((0.0, value, 1.0) for value in (-1000.0, 0.0, 1000.0)),  # unlike all: fully relevant
        # Like what was: 0 if it was a whole spread worse than usual or more ...
        *((1.0, -20.0, 0.0), (1.0, -1000.0, 0.0), (1.0, -15.0, 0.25), (1.0, -5.0, 0.75)),
        *((1.0, 0.0, 1.0), (1.0, 20.0, 1.0), (1.0, 1000.0, 1.0)),  # ... and 1 from usual on
        (0.5, -5.0, 0.875),  # 1 - ½ · ¼
        *((1.0, math.nan, math.nan), (math.nan, -20.0, math.nan)),  # which stops a run
    ],
)
def test_relevance_by_hand(similarity, value, expected):
    """Of returns that are usually 0 and spread by 20, or in another unit and shifted."""
    for unit, shift in ((1.0, 0.0), (1000.0, 0.0), (0.5, 30.0), (0.01, -4.0)):
        recalled = np.float32([unit * value + shift])
        found = relevance(np.float32([similarity]), recalled, shift, 20 * unit)
        assert found == pytest.approx([expected], abs=1e-4, nan_ok=True)
    for spread in (0.0, 0.01):  # hardly any differ: nothing is known to be unproductive
        found = relevance(np.float32([similarity]), np.float32([value]), 0.0, spread)
        assert found == pytest.approx([1 + 0 * similarity], nan_ok=True)


@pytest.mark.parametrize(
    ("lucky", "expected"),
    [(0, 1.0), (1, 1 - math.sqrt(1 / 999)), (100, 1 - 1 / 3), (500, 0.0), (900, 0.0)],
)
def test_luck_of_a_few_does_not_make_the_others_unproductive(make, lucky, expected):
    """Of 1000 remembered returns some are 1, the others 0: q / √(q (1 - q)) below the mean."""
    curiosity = make("FrozenLake-v1")
    states = np.eye(16)[[0] * (1000 - lucky) + [1] * (lucky + 1)]
    curiosity.remember(episode_of(states), np.r_[np.zeros(1000 - lucky), np.ones(lucky)])
    found = curiosity.bonus(episode_of(np.eye(16)[[5, 0, 1 if lucky else 0]]))
    assert found.similarity == pytest.approx([1, 1])
    assert found.relevance == pytest.approx([expected, 1], abs=1e-3)


def test_first_episode_is_wholly_new_and_without_a_memory_novelty_is_all(make):
    curiosity = make()
    bonus = curiosity.bonus(wander(0))
    assert bonus.reward.tolist() == bonus.relevance.tolist() == [1.0] * 30
    assert bonus.similarity.tolist() == [0.0] * 30
    curiosity.memory = None
    curiosity.remember(wander(0), np.zeros(30))
    bonus = curiosity.bonus(wander(1))
    assert (bonus.reward == bonus.novelty).all() and (bonus.relevance == 1).all()
    assert bonus.reward.min() < 0.9 and bonus.similarity is None


def test_bonus_is_novelty_times_relevance_of_the_states_arrived_at(make):
    """Both factors recomputed from the parts on their own, before they take the episode in.

    What is usual is what memory holds; the unit is the deviation of all that was visited.
    """
    curiosity = make(memory={"write_every": 3})
    for seed in range(5):
        returns = np.random.default_rng(seed).standard_normal(30)
        returns[1:3] = -5.0, 5.0  # steps that are not stored
        curiosity.remember(wander(seed), returns)
    episode = wander(9, scale=0.6)
    arrived = episode.observations[1:]
    apart = copy.deepcopy(curiosity)
    novelty = apart.novelty(arrived)
    entries = apart.memory.usage > 0
    remembered = np.concatenate([wander(seed).observations[1:] for seed in range(5)])
    mean, std = remembered.mean(0, dtype=np.float64), remembered.std(0, dtype=np.float64)
    keys, values = apart.memory.keys[entries], apart.memory.values[entries]
    assert len(keys) == 50 + 5 and np.abs(values[:, -1]).max() < 5
    found = curiosity.bonus(episode)
    for t, state in enumerate(arrived):
        squares = (((state - mean) / std - (keys - mean) / std) ** 2).mean(1)
        nearest = np.argsort(squares)[:10]
        kernel = 1 / (squares[nearest] + 0.1)
        recalled = (kernel * values[nearest, -1]).sum() / kernel.sum()
        worse = (values[:, -1].mean() - recalled) / values[:, -1].std()
        relevant = 1 - 0.1 * kernel.max() * min(max(worse, 0), 1)
        expected = novelty[t] * relevant, novelty[t], relevant, 0.1 * kernel.max()
        assert [part[t] for part in found] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_one_state_or_many(make, name):
    """In [0, 1]; asked for one after the other, an episode gets what it gets at once, and again.

    The density estimate within rounding: its matrix products are taken in another order.
    """
    curiosity, between = make(name), 0
    rng = np.random.default_rng(0)
    for seed in range(25):
        if name == "CartPole-v1":
            episode = wander(seed, centre=0.2 * seed, scale=10.0 ** (seed % 4 - 2))
        else:
            episode = episode_of(np.eye(16)[rng.integers(16, size=31)])
        bonus = curiosity.bonus(episode)
        visits = Counter()
        for t, state in enumerate(episode.observations[1:]):
            found = curiosity.of_states(state[None], visits)
            for part, whole in zip(found, bonus, strict=True):
                assert part == pytest.approx(whole[[t]], rel=1e-4, abs=1e-6)
            visits[state.tobytes()] += 1
        for part in bonus:
            assert part.shape == (30,) and ((part >= 0) & (part <= 1)).all()
        np.testing.assert_equal(bonus, curiosity.bonus(episode))  # asking is not remembering
        curiosity.remember(episode, 50 * rng.standard_normal(30))
        between += np.count_nonzero((bonus.reward > 0) & (bonus.reward < bonus.novelty))
    assert between > 100


@pytest.mark.parametrize("write_every", [1, 4, 10])
def test_memory_holds_one_step_in_write_every_across_episodes_and_each_last(make, write_every):
    curiosity, expected, count = make(memory={"write_every": write_every}), [], 0
    for length in (3, 1, 5, 10, 11, 2, 9):
        states, rewards = np.arange(4 * length + 4).reshape(-1, 4) + 9 * count, range(length)
        returns = 10.0 * np.arange(length) - count
        curiosity.remember(episode_of(states, rewards), returns)
        for t in range(length):
            if count % write_every == 0 or t == length - 1:
                expected.append([*states[t], *states[t + 1], rewards[t], returns[t]])
            count += 1
    memory = curiosity.memory
    stored = np.hstack([memory.keys, memory.values])[: len(memory)]
    assert stored.tolist() == expected
