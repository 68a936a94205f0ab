"""The bonus: novelty × relevance, and relevance in the three cases the paper tells apart."""

import copy

import numpy as np
import pytest
from shared import environment_of

from mace_rl import train
from mace_rl.bonus.curiosity import Curiosity, relevance
from mace_rl.environments.rollout import Episode
from mace_rl.streams import Streams

RETURNS = np.float32([-20, -10, 0, 10, 20])  # mean 0, standard deviation √200


def relevance_of(similarity: float, value: float, returns: np.ndarray = RETURNS) -> float:
    return float(relevance(np.float32([similarity]), np.float32([value]), returns)[0])


def episode_of(states, rewards=None, terminated=True) -> Episode:
    """An episode through `states`, [T + 1, observation]."""
    states = np.asarray(states, np.float32)
    length = len(states) - 1
    return Episode(
        observations=states,
        actions=np.zeros(length, np.int64),
        log_probs=np.zeros(length, np.float32),
        rewards=np.zeros(length) if rewards is None else np.asarray(rewards, np.float64),
        terminated=terminated,
    )


def wander(seed, centre=0.0, scale=0.3, length=30) -> Episode:
    """Observations of CartPole's shape around `centre`."""
    rng = np.random.default_rng(seed)
    return episode_of(centre + scale * rng.standard_normal((length + 1, 4)))


@pytest.fixture
def make(run_config):
    """`make(environment, **changes)`: curiosity as in a run of mace_full."""

    def build(environment="CartPole-v1", **changes) -> Curiosity:
        changes = {"memory": {"write_every": 1}, "novelty": {"write_every": 1}} | changes
        config = run_config(environment, "mace_full", 0, **changes)
        return train.curiosity(config, environment_of(environment), Streams(0))

    return build


# --- Relevance ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("similarity", "value", "expected"),
    [
        *((0.0, value, 1.0) for value in (-1000.0, 0.0, 1000.0)),  # unlike all: fully relevant
        # Like what was: the logistic function of value / √200, to 0 where it was unproductive ...
        *((1.0, 0.0, 0.5), (1.0, -20.0, 0.19557), (1.0, -100.0, 0.00085)),
        *((1.0, 20.0, 0.80443), (1.0, 100.0, 0.99915)),  # ... and near 1 where it was productive
        (
            0.5,
            10.0,
            0.83488,
        ),  # 10 / √200 = 0.7071; the function of it, 0.66976; 1 − ½ (1 − 0.66976)
    ],
)
def test_relevance_by_hand(similarity, value, expected):
    assert relevance_of(similarity, value) == pytest.approx(expected, abs=1e-5)


def test_relevance_does_not_depend_on_the_unit_of_reward():
    found = relevance_of(0.7, -7.0)
    other = relevance_of(0.7, -0.07 + 5, RETURNS / 100 + 5)
    assert found == pytest.approx(other, abs=1e-4)


def test_relevance_is_within_0_and_1_even_if_all_returns_are_equal():
    for returns in (np.zeros(5, np.float32), np.float32([3]), RETURNS):
        for similarity in (0.0, 0.3, 1.0):
            for value in (-1e6, 0.0, 3.0, 1e6):
                assert 0 <= relevance_of(similarity, value, returns) <= 1


def test_relevance_is_in_the_middle_if_all_returns_are_equal_up_to_rounding():
    returns = np.full(1000, 100, np.float32)
    for value in (100.0, np.nextafter(np.float32(100), np.float32(200))):
        assert relevance_of(1.0, value, returns) == pytest.approx(0.5, abs=0.1)


# --- The bonus ----------------------------------------------------------------------------------


def test_first_episode_is_wholly_new(make):
    bonus = make().bonus(wander(0))
    assert bonus.reward.tolist() == bonus.relevance.tolist() == [1.0] * 30
    assert bonus.similarity.tolist() == [0.0] * 30


def test_bonus_is_novelty_times_relevance_of_the_states_arrived_at(make):
    """Both factors recomputed from the parts on their own, before they take the episode in."""
    curiosity = make()
    for seed in range(5):
        episode = wander(seed)
        curiosity.remember(episode, np.random.default_rng(seed).standard_normal(30))
    episode = wander(9, scale=0.6)
    arrived = episode.observations[1:]
    apart = copy.deepcopy(curiosity)
    novelty = apart.novelty(arrived)
    entries = apart.memory.usage > 0
    mean, std = apart.normaliser.mean, apart.normaliser.std
    keys, values = apart.memory.keys[entries].numpy(), apart.memory.values[entries].numpy()
    found = curiosity.bonus(episode)
    for t, state in enumerate(arrived):
        squares = (((state - mean) / std - (keys - mean) / std) ** 2).mean(1)
        nearest = np.argsort(squares)[:10]
        kernel = 1 / (squares[nearest] + 0.1)
        recalled = (kernel * values[nearest, -1]).sum() / kernel.sum()
        z = (recalled - values[:, -1].mean()) / values[:, -1].std()
        relevant = 1 - 0.1 * kernel.max() * (1 - 1 / (1 + np.exp(-z)))
        expected = novelty[t] * relevant, novelty[t], relevant, 0.1 * kernel.max()
        assert [part[t] for part in found] == pytest.approx(expected, rel=1e-3)


def test_bonus_is_for_the_state_reached_and_the_start_does_not_count(make):
    curiosity = make()
    for seed in range(5):
        curiosity.remember(wander(seed), np.zeros(30))
    episode = wander(9)
    moved = wander(9)
    moved.observations[0] += 100
    assert (curiosity.bonus(episode).reward == curiosity.bonus(moved).reward).all()
    moved.observations[-1] += 100
    before, after = curiosity.bonus(episode).reward, curiosity.bonus(moved).reward
    assert (before[:-1] == after[:-1]).all() and after[-1] > 0.99


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_bonus_is_within_0_and_1(make, name):
    curiosity = make(name)
    rng = np.random.default_rng(0)
    for seed in range(25):
        if name == "CartPole-v1":
            episode = wander(seed, centre=0.2 * seed, scale=10.0 ** (seed % 4 - 2))
        else:
            episode = episode_of(np.eye(16)[rng.integers(16, size=31)])
        for part in curiosity.bonus(episode):
            assert part.shape == (30,) and ((part >= 0) & (part <= 1)).all()
        curiosity.remember(episode, 50 * rng.standard_normal(30))


def test_familiar_and_unproductive_states_earn_least(make):
    """Two places equally often visited, one with high returns; and a third never seen."""
    curiosity = make()
    for seed in range(10):
        curiosity.remember(wander(seed, centre=-1.0), np.full(30, -50.0))
        curiosity.remember(wander(100 + seed, centre=1.0), np.full(30, 50.0))
    poor, rich, unseen = (
        curiosity.bonus(wander(50, centre=centre)).reward.mean() for centre in (-1.0, 1.0, 8.0)
    )
    assert poor < 0.5 * rich < rich < 0.6 < 0.95 < unseen


@pytest.mark.parametrize("name", ["FrozenLake-v1", "Taxi-v4"])
def test_different_discrete_states_are_not_similar(make, name):
    curiosity = make(name)
    states = np.eye(curiosity.normaliser.mean.size)
    curiosity.remember(episode_of(states[[0, 0, 0]]), np.array([-50.0, 50.0]))
    new = curiosity.bonus(episode_of(states[[0, 1]])).reward[0]
    assert new > 0.95  # neither visited nor like what was


def test_remembering_stores_one_step_in_write_every(make):
    curiosity = make(memory={"write_every": 4})
    episode = episode_of(np.arange(44).reshape(11, 4), rewards=range(10))
    curiosity.remember(episode, np.arange(10) * 10.0)
    assert len(curiosity.memory) == 3
    stored = curiosity.memory.values[:3].numpy()
    assert (curiosity.memory.keys[:3].numpy() == episode.observations[[0, 4, 8]]).all()
    assert (stored[:, :4] == episode.observations[[1, 5, 9]]).all()
    assert stored[:, 4:].tolist() == [[0, 0], [4, 40], [8, 80]]


def test_states_are_compared_in_the_normaliser_of_all_remembered(make):
    """Discrete ones are one-hot and stay as they are."""
    curiosity, states = make(), []
    for seed in range(3):
        curiosity.remember(wander(seed, centre=5.0, scale=2.0), np.zeros(30))
        states += [*wander(seed, centre=5.0, scale=2.0).observations[1:].astype(np.float64)]
    np.testing.assert_allclose(curiosity.normaliser.mean, np.mean(states, axis=0))
    np.testing.assert_allclose(curiosity.normaliser.std, np.std(states, axis=0))
    discrete = make("FrozenLake-v1")
    discrete.remember(episode_of(np.eye(16)[[0, 4, 8, 9]]), np.zeros(3))
    assert (discrete.normaliser.mean == 0).all() and (discrete.normaliser.std == 1).all()


def test_appraisal_comes_before_remembering(make):
    """An episode is rewarded for what was known before it: asking changes nothing known."""
    curiosity = make()
    curiosity.remember(wander(0), np.zeros(30))
    np.testing.assert_equal(*(curiosity.bonus(wander(1)) for _ in range(2)))


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_restored_curiosity_continues_to_the_bit(make, name):
    original, restored = make(name), make(name)
    rng = np.random.default_rng(0)

    def episode() -> Episode:
        if name == "CartPole-v1":
            return wander(int(rng.integers(1000)))
        return episode_of(np.eye(16)[rng.integers(16, size=31)])

    for _ in range(4):
        original.bonus(played := episode())
        original.remember(played, rng.standard_normal(30))
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    for _ in range(4):
        played, returns = episode(), rng.standard_normal(30)
        np.testing.assert_equal(original.bonus(played), restored.bonus(played))
        original.remember(played, returns)
        restored.remember(played, returns)
    assert (original.memory.usage == restored.memory.usage).all()
