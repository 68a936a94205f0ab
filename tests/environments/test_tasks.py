"""The exploration tasks: returns by search or by hand, borrowed dynamics."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.stats import kstest
from shared import ROOT

from mace_rl.environments.tasks import BarrenRegion, DeepSea, NoisyDeepSea
from mace_study.config.study import Study, read_study

NORTH, EAST, SOUTH, WEST = range(4)

# By state and action: probability, next state, reward, end; as Gymnasium's grids have it.
Table = Mapping[int, Mapping[int, list[tuple[float, int, float, bool]]]]


@pytest.fixture(scope="module")
def study() -> Study:
    return read_study([ROOT / "config.yaml", ROOT / "config" / "tasks.yaml"])


def value(table: Table, start: int, steps: int, over: Callable) -> float:
    """Expected return of so many steps, `over` the actions: `np.mean` for random ones, or `max`."""

    def ahead(ways: list, values: dict) -> float:
        return sum(p * (reward + (not end) * values[then]) for p, then, reward, end in ways)

    values = dict.fromkeys(table, 0.0)
    for _ in range(steps):
        values = {s: over([ahead(table[s][a], values) for a in table[s]]) for s in table}
    return float(values[start])


def random_actions(env: gymnasium.Env, seed: int) -> Iterator:
    env.action_space.seed(seed)
    return (env.action_space.sample() for _ in itertools.count())


def play(env: gymnasium.Env, actions: Iterable) -> tuple[list, list[float], bool]:
    """Observations from the reset on, rewards, and whether the last one is terminal."""
    observations, rewards, terminated = [env.reset()[0]], [], False
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            break
    return observations, rewards, terminated


def test_gymnasium_accepts_them(study, recwarn):
    for name in study.environments[2:]:
        check_env(gymnasium.make(name, disable_env_checker=True).unwrapped, skip_render_check=True)
        assert not [str(warning.message) for warning in recwarn]
        recwarn.clear()


def test_random_returns_of_the_study(study):
    expected = {f"DeepSea{size}-v0": 2.0**-size - 0.005 for size in (10, 20)}
    for name in ("FrozenLake8x8Deterministic-v0", "CliffWalking200-v0"):
        env = gymnasium.make(name).unwrapped
        start = int(np.argmax(env.initial_state_distrib))
        expected[name] = value(env.P, start, 200, np.mean)
    env = BarrenRegion()
    expected["BarrenRegion-v0"] = value(transitions(env), env.kinds.index("S"), 60, np.mean)
    expected |= {"SparseMountainCar-v0": 0.0, "NoisyMountainCar-v0": -0.001 * 200 / 4}
    noisy = NoisyDeepSea(10, 1)
    noisy.reset(seed=0)
    draws = (play(noisy, random_actions(noisy, seed))[1] for seed in range(20_000))
    expected["NoisyDeepSea10-v0"] = np.mean([sum(rewards) for rewards in draws])
    for name, mean in expected.items():
        given = study.metrics.random_return_in(name)
        assert given == pytest.approx(mean, rel=0.02, abs=0.001), name


@pytest.mark.parametrize("skilled", [False, True])
def test_mountain_car_is_gymnasiums_but_for_the_reward(skilled):
    ours, theirs = gymnasium.make("SparseMountainCar-v0"), gymnasium.make("MountainCar-v0")
    for seed in range(2):
        state, rng = ours.reset(seed=seed)[0], np.random.default_rng(seed)
        assert np.array_equal(state, theirs.reset(seed=seed)[0])
        rewards, over = [], False
        while not over:
            swing_up = skilled and rng.random() < 0.9
            action = 2 * int(state[1] >= 0) if swing_up else int(rng.integers(3))
            state, reward, *ends, _ = ours.step(action)
            expected, _, *expected_ends, _ = theirs.step(action)
            assert np.array_equal(state, expected) and ends == expected_ends
            rewards.append(reward)
            over = any(ends)
        assert rewards == [0.0] * (len(rewards) - 1) + [float(skilled)]
        assert (len(rewards) < 200) == skilled == (state[0] >= 0.5)


def test_the_television_of_the_noisy_mountain_car():
    """Watching is coasting, for 0.001; what is on is new each time, and off without it."""
    noisy, plain = gymnasium.make("NoisyMountainCar-v0"), gymnasium.make("SparseMountainCar-v0")
    shown, paid = [], []
    for seed in range(20):
        state, rng = noisy.reset(seed=seed)[0], np.random.default_rng(seed)
        assert np.array_equal(state, [*plain.reset(seed=seed)[0], 0])
        over = False
        while not over:
            swing_up = rng.random() < 0.9 * (seed % 2)
            action = 2 * int(state[1] >= 0) if swing_up else int(rng.integers(4))
            state, reward, *ends, _ = noisy.step(action)
            expected, goal, *expected_ends, _ = plain.step(1 if action == 3 else action)
            assert np.array_equal(state[:2], expected) and ends == expected_ends
            assert reward == goal - 0.001 * (action == 3) and (state[2] != 0) == (action == 3)
            shown += [state[2]] if action == 3 else []
            paid += [reward] if goal else []
            over = any(ends)
    assert len(paid) == 10 and len(np.unique(shown)) == len(shown) > 500
    assert kstest(shown, "uniform", args=(-1, 2)).pvalue > 0.01


@pytest.mark.parametrize("size", [1, 5, 9])
def test_returns_of_the_deep_sea(size):
    """Of all sequences of actions: one pays, and the others cost their moves to the right."""
    expected = np.random.RandomState(42).binomial(1, 0.5, [size, size]).ravel().tolist()
    env, returns, visited = DeepSea(size), [], set()
    assert env.right == expected  # bsuite's
    for actions in itertools.product((0, 1), repeat=size):
        cells, rewards, terminated = play(env, actions)
        assert terminated and len(rewards) == size and cells[-1] == size * size
        assert [cell // size for cell in cells] == list(range(size + 1))  # a row a step
        visited.update(cells)
        returns.append(sum(rewards))
    # Each cell has one action for right, so k moves to the right are in C(size, k) sequences.
    expected = [-0.01 * k / size for k in range(size) for _ in range(math.comb(size, k))]
    assert sorted(returns) == pytest.approx(sorted([*expected, 0.99]))
    triangle = {row * size + column for row in range(size) for column in range(row + 1)}
    assert visited == triangle | {size * size}


def test_the_archive_of_the_noisy_deep_sea():
    """It is entered in the first row alone, and left by no action; elsewhere all is as without."""
    noisy, plain = gymnasium.make("NoisyDeepSea10-v0"), DeepSea(10)
    noisy.reset(seed=0)
    pages = []
    for episode in range(200):
        actions = list(itertools.islice(random_actions(noisy, episode), 10))
        observations, rewards, terminated = play(noisy, actions)
        assert terminated and len(rewards) == 10
        if actions[0] == 2:
            assert rewards == [-0.001] * 10 and min(observations[1:]) > 100
            pages += observations[1:]
        else:
            expected = play(plain, [action % 2 for action in actions])
            assert (observations, rewards, terminated) == expected
    assert len(pages) > 500 and max(pages) < 1101
    assert kstest(pages, "uniform", args=(101, 1000)).pvalue > 0.01


@pytest.mark.parametrize("late", range(7))
def test_the_archive_of_the_late_deep_sea_is_beside_its_goal(late):
    """Right all along but for one third action, which is 0 in five rows and the door in two."""
    env, plain = gymnasium.make("LateDeepSea7-v0"), DeepSea(7)
    actions = [plain.right[8 * row] for row in range(7)]
    assert play(env, actions)[1:] == (pytest.approx([-0.01 / 7] * 6 + [1 - 0.01 / 7]), True)
    actions[late] = 2
    observations, rewards, terminated = play(env, [*actions, 0, 1, 2, 0, 1])
    if late < 5:
        actions[late] = 0
        assert (observations, rewards, terminated) == play(plain, actions)
    else:  # no action leads out, up to the time limit
        assert rewards[late:] == [-0.001] * (12 - late) and not terminated
        assert min(observations[late + 1 :]) >= 50 > max(observations[: late + 1])
    check_env(env.unwrapped, skip_render_check=True)


def transitions(env: BarrenRegion) -> Table:
    env.reset(seed=0)
    table = {}
    for cell, action in itertools.product(range(len(env.kinds)), range(4)):
        env.cell = cell
        _, reward, terminated, _, _ = env.step(action)
        table.setdefault(cell, {})[action] = [(1.0, env.cell, reward, terminated)]
    return table


def test_the_way_through_the_corridor():
    legs = [(WEST, 1), (NORTH, 2), (WEST, 7), (NORTH, 2), (EAST, 8)]
    env = gymnasium.make("BarrenRegion-v0")
    _, rewards, end = play(env, [action for action, length in legs for _ in range(length)])
    assert end and rewards == [0.0] * 19 + [1.0]
    # There is no shorter way, and none that pays more; the worst is to stay in the room.
    table, start = transitions(env.unwrapped), env.unwrapped.kinds.index("S")
    assert [value(table, start, steps, max) for steps in (19, 20, 60)] == [0, 1, 1]
    assert value(table, start, 60, min) == pytest.approx(-0.06)
    assert table == transitions(BarrenRegion(screen=0))


def test_only_the_room_is_full_of_news():
    env = gymnasium.make("BarrenRegion-v0")
    env.reset(seed=0)
    screens, generator = [], env.unwrapped.np_random
    for episode in range(30):
        env.reset()
        for action in itertools.islice(random_actions(env, episode), 59):
            before = generator.bit_generator.state
            observation, reward, *_ = env.step(action)
            in_room = observation[0] > 0.3  # the last five of the map's fourteen columns
            assert (generator.bit_generator.state != before) == in_room
            assert observation[2:].any() == in_room and reward == (-0.001 if in_room else 0)
            screens += [observation[2:]] if in_room else []
    assert len(screens) > 300 and len(np.unique(screens)) == np.size(screens)
    assert kstest(np.ravel(screens), "uniform", args=(-1, 2)).pvalue > 0.01
