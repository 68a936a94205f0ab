"""Novelty: counts by hand, k-NN by brute force, and what it is for: the new against the known."""

import copy
import math

import numpy as np
import pytest

from mace_rl.agent.normaliser import RunningNormaliser
from mace_rl.bonus.novelty import CountNovelty, DensityNovelty
from mace_rl.config.run import NoveltyConfig
from mace_rl.streams import Streams

SIZE = 3


def settings(**changes) -> NoveltyConfig:
    return NoveltyConfig(
        **{
            "count_decay": 0.5,
            "buffer_size": 50,
            "write_every": 1,
            "neighbours": [1, 3, 8],
            "knn_weight": 0.7,
            "density_hidden_units": 16,
            "density_learning_rate": 0.01,
            "density_batch_size": 64,
            "density_steps": 2,
            **changes,
        }
    )


def make(seed=0, **changes) -> DensityNovelty:
    normaliser = RunningNormaliser(SIZE)
    return DensityNovelty(settings(**changes), "compiled", normaliser, Streams(seed))


def observe(novelty: DensityNovelty, states: np.ndarray) -> None:
    """As curiosity does it: the normaliser first, which the estimates refer to."""
    novelty.normaliser.update(states)
    novelty.observe(states)


def cluster(count, centre=0.0, scale=1.0, seed=0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (centre + scale * rng.standard_normal((count, SIZE))).astype(np.float32)


def one_hot(*states: int) -> np.ndarray:
    return np.eye(4, dtype=np.float32)[list(states)]


# --- Counts -------------------------------------------------------------------------------------


def test_counts_by_hand():
    """1 / n(s), this visit included; after each episode all counts are halved (decay ½)."""
    novelty = CountNovelty(settings(), 4)
    first = one_hot(0, 1, 0, 0)
    assert novelty(first).tolist() == [1, 1, 1 / 2, 1 / 3]
    assert novelty(first).tolist() == [1, 1, 1 / 2, 1 / 3]  # asking is not visiting
    novelty.observe(first)  # counts 3, 1 → 1½, ½
    assert novelty(one_hot(0, 1, 2)).tolist() == [1 / 2.5, 1 / 1.5, 1]
    novelty.observe(one_hot(2, 2))  # 1½, ½, 2 → ¾, ¼, 1
    assert novelty(one_hot(0, 1, 2, 2)).tolist() == [1 / 1.75, 1 / 1.25, 1 / 2, 1 / 3]


def test_a_state_not_visited_for_long_is_new_again():
    novelty = CountNovelty(settings(), 4)
    novelty.observe(one_hot(*[0] * 50))
    values = []
    for _ in range(12):
        values.append(float(novelty(one_hot(0))[0]))
        novelty.observe(one_hot(1))
    assert values == sorted(values) and values[0] < 0.04 and 0.98 < values[-1] <= 1


# --- k-NN ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("visited", [1, 2, 7, 40])
def test_knn_part_equals_brute_force(visited):
    """Also with fewer visited states than neighbours asked for."""
    novelty = make()
    known, states = cluster(visited, scale=[1, 10, 0.1]), cluster(15, 0.5, [2, 20, 0.2], seed=1)
    observe(novelty, known)
    std = known.std(0, dtype=np.float64)
    std[std == 0] = 1
    for found, state in zip(novelty.knn_novelty(states), states, strict=True):
        distances = sorted(
            math.sqrt(sum(((state[d] - other[d]) / std[d]) ** 2 for d in range(SIZE)) / SIZE)
            for other in known
        )
        ensemble = []
        for k in (1, 3, 8):
            nearest = distances[: min(k, visited)]
            ensemble.append(1 - math.exp(-sum(nearest) / len(nearest)))
        assert found == pytest.approx(sum(ensemble) / 3, rel=1e-4)


def test_buffer_keeps_the_last_states():
    novelty = make(buffer_size=7)
    states = np.arange(60, dtype=np.float32).reshape(20, SIZE)
    seen: list[list[float]] = []
    for part in np.split(states, [4, 6, 11, 12]):  # one part is longer than the buffer
        observe(novelty, part)
        seen += part.tolist()
        assert sorted(novelty.visited.tolist()) == seen[-7:]


def test_one_state_in_write_every_enters_the_buffer():
    novelty = make(write_every=4)
    states = np.arange(30, dtype=np.float32).reshape(10, SIZE)
    observe(novelty, states)
    observe(novelty, states[:1])
    assert novelty.visited.tolist() == states[[0, 4, 8, 0]].tolist()


# --- Density ------------------------------------------------------------------------------------


def test_density_part_is_the_share_of_visited_states_that_are_denser():
    novelty = make(density_batch_size=256, density_learning_rate=1e-7)
    observe(novelty, cluster(50))
    states = np.concatenate([cluster(20, scale=0.5, seed=1), cluster(20, 2.0, seed=2)])

    def log_density(points: np.ndarray) -> np.ndarray:
        return novelty.density.log_prob(novelty.normaliser(points))

    denser = log_density(novelty.visited)[None, :] > log_density(states)[:, None]
    # The reference is 256 draws with replacement from the 50 visited.
    np.testing.assert_allclose(novelty.density_novelty(states), denser.mean(1), atol=0.12)


def test_observing_trains_the_density_estimator():
    """Held-out states of the visited distribution become likelier, episode by episode."""
    novelty = make(buffer_size=2000, density_steps=10)
    held_out = cluster(500, seed=99)
    likelihood = []
    for episode in range(60):
        observe(novelty, cluster(50, seed=episode))
        likelihood.append(float(novelty.density.log_prob(novelty.normaliser(held_out)).mean()))
    entropy = SIZE / 2 * math.log(2 * math.pi * math.e)  # of a standard normal
    assert likelihood[0] < likelihood[20] < likelihood[-1]
    assert likelihood[-1] == pytest.approx(-entropy, abs=0.15)


# --- The whole ----------------------------------------------------------------------------------


def test_before_anything_was_visited_all_is_new():
    assert make()(cluster(5)).tolist() == [1.0] * 5


def test_parts_are_weighted():
    novelty = make(knn_weight=0.7)
    observe(novelty, cluster(40))
    states = cluster(10, seed=1)
    expected = 0.7 * novelty.knn_novelty(states) + 0.3 * novelty.density_novelty(states)
    np.testing.assert_allclose(novelty(states), expected, rtol=1e-12)
    only = make(knn_weight=1.0)
    observe(only, cluster(40))
    assert (only(states) == only.knn_novelty(states)).all()


def test_novelty_is_within_0_and_1():
    novelty = make()
    for episode in range(30):
        states = cluster(20, centre=0.3 * episode, scale=10.0 ** (episode % 5 - 2), seed=episode)
        found = novelty(np.concatenate([states, 1e6 * states, 0 * states]))
        assert ((found >= 0) & (found <= 1)).all()
        observe(novelty, states)


@pytest.mark.parametrize("density_steps", [2, 20])
def test_repeated_states_lose_novelty_and_far_ones_keep_it(density_steps):
    novelty = make(buffer_size=500, density_steps=density_steps)
    means = []
    for episode in range(40):
        states = cluster(20, seed=episode)
        means.append(novelty(states).mean())
        observe(novelty, states)
    assert means[0] == 1 and np.mean(means[-5:]) < 0.45
    assert np.mean(means[-5:]) < np.mean(means[1:6])
    assert (novelty(cluster(20, centre=30.0)) > 0.99).all()
    # Exactly the states in the buffer: nothing left in the nearest-neighbour part of k = 1.
    exact = make(buffer_size=500, neighbours=[1])
    observe(exact, cluster(20))
    assert (exact.knn_novelty(cluster(20)) == 0).all()


def test_units_do_not_matter():
    """Metres or millimetres: distances are taken in standard deviations."""
    one, other = make(), make()
    scale, shift = np.float32([1000, 0.01, 1]), np.float32([5, -3, 0])
    observe(one, cluster(40))
    observe(other, cluster(40) * scale + shift)
    states = cluster(10, seed=1)
    np.testing.assert_allclose(
        one.knn_novelty(states), other.knn_novelty(states * scale + shift), rtol=1e-2
    )


def test_restored_novelty_continues_to_the_bit():
    original, restored = make(buffer_size=30), make(seed=1, buffer_size=30)
    for episode in range(3):
        observe(original, cluster(13, seed=episode))
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    restored.normaliser.load_state_dict(original.normaliser.state_dict())
    for episode in range(3, 6):
        states = cluster(13, seed=episode)
        assert (original(states) == restored(states)).all()
        observe(original, states)
        observe(restored, states)
    counts, others = CountNovelty(settings(), 4), CountNovelty(settings(), 4)
    counts.observe(one_hot(0, 1, 1))
    others.load_state_dict(counts.state_dict())
    counts.observe(one_hot(2))
    assert others(one_hot(0, 1, 2)).tolist() == [1 / 1.5, 1 / 2, 1]
