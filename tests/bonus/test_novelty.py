"""Novelty: counts by hand, the rest by brute force, and what it is for: the new and the known."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from shared import Twin

from mace_rl.base.rng import Streams
from mace_rl.bonus.counts import CountNovelty
from mace_rl.bonus.density import DensityEstimator
from mace_rl.bonus.novelty import DensityNovelty
from mace_rl.config.bonus import NoveltyConfig
from mace_rl.numerics.normaliser import RunningNormaliser

SIZE = 3


def settings(**changes) -> NoveltyConfig:
    small = {"count_decay": 0.5, "buffer_size": 50, "write_every": 1, "neighbours": [1, 3, 8]}
    small |= {"refresh_every": 1, "calibration_states": 32, "knn_weight": 0.7}
    density = {"hidden_units": 16, "learning_rate": 0.01, "batch_size": 64, "steps": 2}
    small |= {f"density_{name}": value for name, value in density.items()}
    return NoveltyConfig(**small | changes)


def make(size=SIZE, **changes) -> DensityNovelty:
    normaliser = RunningNormaliser(size)
    return DensityNovelty(settings(**changes), normaliser, Streams(0))


def observe(novelty: DensityNovelty, states: np.ndarray) -> None:
    """As curiosity does it: the normaliser first, which the estimates refer to."""
    novelty.normaliser.update(states)
    novelty.observe(states)


def cluster(count, centre=0.0, scale=1.0, seed=0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (centre + scale * rng.standard_normal((count, SIZE))).astype(np.float32)


def line(*places: float) -> np.ndarray:
    return np.float32(places)[:, None]


def one_hot(*states: int) -> np.ndarray:
    return np.eye(4, dtype=np.float32)[list(states)]


def test_counts_by_hand():
    """1 / n(s), this visit included; after each episode all counts are halved (decay ½)."""
    novelty, first = CountNovelty(settings(), 4), one_hot(0, 1, 0, 0)
    for _ in range(2):  # asking is not visiting
        assert novelty(first).tolist() == [1, 1, 1 / 2, 1 / 3]
    novelty.observe(first)  # counts 3, 1 → 1½, ½
    assert novelty(one_hot(0, 1, 2)).tolist() == [1 / 2.5, 1 / 1.5, 1]
    visits = {one_hot(0).tobytes(): 1, one_hot(2).tobytes(): 2}  # earlier in the same episode
    assert novelty.continued(one_hot(0, 2, 2), visits).tolist() == [1 / 3.5, 1 / 3, 1 / 4]
    novelty.observe(one_hot(2, 2))  # 1½, ½, 2 → ¾, ¼, 1
    assert novelty(one_hot(0, 1, 2, 2)).tolist() == [1 / 1.75, 1 / 1.25, 1 / 2, 1 / 3]


def brute_distances(states, known, skip=0) -> np.ndarray:
    """Mean distance to the nearest 1, 3 and 8 of the known, in their deviations, [N, 3]."""
    std = known.std(0, dtype=np.float64)
    std[std == 0] = 1
    ordered = np.sort(cdist(states / std, known / std), axis=1)[:, skip:]
    return np.stack([ordered[:, :k].mean(1) for k in (1, 3, 8)], axis=1)


@pytest.mark.parametrize("visited", [9, 40])
@pytest.mark.parametrize("scale", [[1, 10, 0.1], [1, 10, 0], [0, 10, 0]])
def test_both_parts_equal_brute_force(visited, scale):
    """Also if some dimensions are constant, which D does not count."""
    novelty, scale, dimensions = make(), np.array(scale), np.count_nonzero(scale)
    known, states = cluster(visited, 2, scale), cluster(15, 2 + scale / 2, 1.5 * scale, seed=1)
    observe(novelty, known)
    batches = Streams(0)["density_batches"].integers(visited, size=(2, 64))
    sample = known[batches[-1]]
    usual = np.sort(brute_distances(sample[:32], known, skip=1), axis=0)
    usual = 0.1 * usual[27] + 0.9 * usual[28]  # place 27.9 of 0 to 31 is 90 % of the way
    np.testing.assert_allclose(novelty.distance_thresholds, usual, rtol=1e-4)
    beyond = 1 - usual / brute_distances(states, known)
    found = novelty.knn_novelty(states)
    np.testing.assert_allclose(found, np.where(beyond > 0, beyond, 0).mean(1), atol=1e-4)
    assert (found > 0).any()
    assert [novelty.knn_novelty(state[None])[0] for state in states] == found.tolist()

    def log_density(points: np.ndarray) -> np.ndarray:
        std = known.std(0, dtype=np.float64)
        points = (points - known.mean(0, dtype=np.float64)) / np.where(std > 0, std, 1)
        return novelty.density.log_prob(points.astype(np.float32)).astype(np.float64)

    lack = np.quantile(log_density(sample), 0.1) - log_density(states)
    expected = [1 - math.exp(-nats / dimensions) if nats > 0 else 0.0 for nats in lack]
    np.testing.assert_allclose(novelty.density_novelty(states), expected, atol=1e-4)
    assert 0 < np.count_nonzero(expected) < 15
    whole = 0.7 * found + 0.3 * np.array(expected)
    np.testing.assert_allclose(novelty(states), whole, atol=1e-4)


def test_a_full_buffer_takes_what_is_far_for_what_is_redundant():
    """Pairs, ever farther apart: of the closest one goes. 400 draws of 40 find all of them."""
    novelty = make(size=1, buffer_size=40, neighbours=[1], calibration_states=400)
    pairs = [(10.0 * i, 10.0 * i + 0.1 + 0.05 * i) for i in range(20)]

    def held() -> list[float]:
        return sorted(novelty.visited.ravel().astype(float).round(3).tolist())

    def after(*places: float) -> set[float]:
        """What one observation after the other has added, less what has gone for it."""
        before = set(held())
        for place in places:
            observe(novelty, line(place))
        new = set(held())
        assert len(novelty.visited) == len(new) == 40
        assert new - before <= set(places)
        return before - new

    observe(novelty, line(*(place for pair in pairs for place in pair)))
    for place, pair in ((-10, pairs[0]), (205, pairs[1])):
        (gone,) = after(place)
        assert gone in np.round(pair, 3) and place in held()
    # Nine in ten are less than 1.05 from their neighbour, four are 0.2 or 0.25: what is between has
    # no novelty, and does not come in, however redundant those are.
    between = line(30.9, 189.2, 205.01)
    nearest = novelty.neighbours.nearest
    assert (nearest(between[:2], 1)[0] > nearest(line(*pairs[2]), 2)[0][:, 1]).all()
    assert novelty.knn_novelty(between).tolist() == [0, 0, 0]
    assert after(*between.ravel().tolist()) == set()
    # Of several at once the farthest, and then not its like.
    observe(novelty, line(230, 230.01, 31))
    assert 230.01 in held() and 230 not in held() and 31 not in held()


@pytest.mark.parametrize(
    ("known", "states"),
    [
        ([0, 1, 2, 30, 30], [10, 20]),  # of a redundant pair both go
        ([0, 1, 2, 3, 30], [100, 100.1, 100.2, 100.3, 100.4]),  # all that was known goes
    ],
)
def test_a_region_is_not_forgotten_within_an_episode(known, states):
    novelty = make(size=1, buffer_size=5, neighbours=[1], calibration_states=200)
    observe(novelty, line(*known))
    observe(novelty, line(*states))
    assert 30 in novelty.visited


@pytest.mark.parametrize("write_every", [1, 3])
def test_all_is_brought_up_to_date_at_the_first_end_of_an_episode_after_so_many_steps(write_every):
    """50 of them. Until then nothing changes, whatever the normaliser makes of new states."""
    novelty = make(refresh_every=50, write_every=write_every, buffer_size=300)
    probes = cluster(9, 1, seed=99)
    episodes = [cluster(length, seed=length) for length in (20, 21, 19, 49, 1, 120, 10)]
    refreshed = steps = 0
    for states, due in zip(episodes, (0, 0, 1, 0, 1, 1, 0), strict=True):
        before, weights = novelty(probes), novelty.density.parameters.copy()
        observe(novelty, states)
        steps += len(states)
        refreshed = steps if due else refreshed
        taken = np.concatenate(episodes)[:steps:write_every]
        written = math.ceil(refreshed / write_every)
        assert novelty.visited.tolist() == taken[:written].tolist()
        assert novelty.pending.tolist() == taken[written:].tolist()
        for same in (novelty(probes) == before, novelty.density.parameters == weights):
            assert same.all() != bool(due)


def test_until_more_than_the_neighbours_were_visited_all_is_new():
    novelty = make()  # of 8 neighbours
    assert novelty(cluster(5)).tolist() == [1.0] * 5
    for count, new in ((8, True), (1, False)):
        observe(novelty, cluster(count))
        assert (novelty(cluster(5)).tolist() == [1.0] * 5) == new


@pytest.mark.parametrize("density_steps", [2, 20])
def test_novelty_falls_where_the_agent_stays_until_it_goes_elsewhere(density_steps):
    novelty, stays, away = make(buffer_size=500, density_steps=density_steps), [], []
    for episode in range(45):
        states = cluster(20, 8.0 * (episode >= 40), seed=episode)
        stays.append(novelty(states).mean())
        away.append(novelty(cluster(20, 30.0)).min())
        observe(novelty, states)
    assert stays[0] == 1 and max(stays[1:40]) < 0.3 and np.mean(stays[20:40]) < 0.1
    assert stays[40] > 0.9 and stays[41] < 0.6 and stays[44] < 0.3  # a new region, then visited
    assert min(away) > 0.95


@pytest.mark.parametrize("cells", [1, 5])
def test_states_that_repeat_exactly_are_known(cells):
    """A grid of positions, or an observation that never changes."""
    novelty, rng = make(size=2, buffer_size=500), np.random.default_rng(0)
    grid = np.float32([(i, j) for i in range(cells) for j in range(cells)])
    for _ in range(50):
        observe(novelty, grid[rng.integers(len(grid), size=20)])
    assert novelty(grid).mean() < 0.2


def arbitrary(size, hidden_units) -> DensityEstimator:
    generator = np.random.default_rng(0)
    model = DensityEstimator(size, hidden_units, generator)
    parameters = model.parameters
    parameters[:] = 0.5 * generator.standard_normal(len(parameters)) * free(model)
    return model


def free(model: DensityEstimator) -> np.ndarray:
    """Which parameters are neither masked nor zeros added to the layout."""
    return model.mask * Twin(model).own()


@pytest.mark.parametrize("size", [1, 2, 5, 15])
def test_conditional_of_each_coordinate_depends_on_earlier_ones_only(size):
    """To the bit: its μ and σ change with those, and with no other."""
    model = arbitrary(size, hidden_units=32)
    x = np.random.default_rng(1).standard_normal((1, size)).astype(np.float32)
    before = model.forward(x).outputs[0]
    for j in range(size):
        changed = x + np.float32(0.5) * (np.arange(size) == j)
        same = model.forward(changed).outputs[0] == before
        assert same.tolist() == [i <= j for i in range(size)] * 2


@pytest.mark.parametrize("narrow", [False, True])
@pytest.mark.parametrize("size", [1, 2, 5])
def test_log_density_and_gradient_equal_autograd(size, narrow):
    """Of normal distributions with the network's μ and σ, in double precision.

    Of the first coordinate log σ is the bias alone; if `narrow`, below its bound.
    """
    model = arbitrary(size, hidden_units=8)
    _, biases = model.layers(model.parameters)[-1]  # of μ, then log σ
    biases[size] = -5.5 if narrow else -1.0
    x = np.random.default_rng(1).standard_normal((200, size)).astype(np.float32)
    twin = Twin(model)
    outputs = twin(x)
    normal = torch.distributions.Normal(outputs[:, :size], outputs[:, size:].clamp(min=-5).exp())
    expected = normal.log_prob(torch.from_numpy(x)).sum(dim=1)
    np.testing.assert_allclose(model.log_prob(x), expected.detach(), rtol=1e-4, atol=1e-5)
    found, expected = model.gradient(x), twin.gradient(expected.mean()) * free(model)
    assert found.dtype == np.float32 and (found[free(model) == 0] == 0).all()
    largest = np.abs(expected).max()
    assert largest > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * largest)
