"""β by schedule and learned: each against a computation of its own."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from gymnasium.spaces import Discrete
from shared import environment_of, finish

from mace_rl.beta.controller import Effect
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.beta.progress import FAST, IMPROVEMENT, SLOW, Progress
from mace_rl.config.section import ConfigError
from mace_rl.environments.rollout import Episode
from mace_rl.factories import beta_controller
from mace_rl.streams import Streams
from mace_rl.study.config import read_study

ROOT = Path(__file__).parents[1]
SCHEDULE = {"kind": "exponential", "initial": 0.4, "decay": 0.5, "floor": 0.06}


def episode_of(rng, name="CartPole-v1", length=20) -> Episode:
    environment = environment_of(name)
    size, space = environment.observation_size, environment.action_space
    return Episode(
        observations=rng.standard_normal((length + 1, size)).astype(np.float32),
        actions=rng.integers(space.n, size=length)
        if isinstance(space, Discrete)
        else rng.standard_normal((length, *space.shape)).astype(np.float32),
        log_probs=np.zeros(length, np.float32),
        rewards=rng.standard_normal(length),
        terminated=True,
    )


# --- Schedules ----------------------------------------------------------------------------------

PAPER_S = 0.999 ** np.arange(5000)


@pytest.mark.parametrize(
    ("beta", "expected"),
    [
        ({"kind": "constant", "value": 0.3}, [0.3] * 3),
        (SCHEDULE, [0.4, 0.2, 0.1, 0.06, 0.06]),
        ({"variant": "mace_fixed"}, np.maximum(0.4 * PAPER_S, 0.01)),
        ({"variant": "mace_fixed_0.2"}, np.maximum(0.2 * PAPER_S, 0.01)),
        ({"variant": "mace_fixed_0.6"}, np.maximum(0.6 * PAPER_S, 0.01)),
    ],
)
def test_schedules_by_hand(run_config, beta, expected):
    changes = {"variant": "mace_fixed"} | (beta if "variant" in beta else {"beta": beta})
    config = run_config("CartPole-v1", **changes)
    rule, betas = beta_controller(config, environment_of("CartPole-v1"), Streams(0)), []
    for _ in expected:
        betas.append(rule.beta)
        rule.next_episode(None, None)  # whatever it was
    assert betas == pytest.approx(expected) and not rule.learns


@pytest.mark.parametrize(
    ("beta", "message"),
    [
        ({"kind": "constant", "value": 1.5}, "beta.value is 1.5, but .* less than or equal to 1"),
        ({"kind": "constant"}, "the key 'beta.value' is missing"),
        (SCHEDULE | {"floor": 0.5}, "beta .* floor is 0.5, which must not exceed initial, 0.4"),
        (SCHEDULE | {"flor": 0.1}, "unknown key 'beta.flor' .* 'floor'"),
    ],
)
def test_wrong_settings_get_one_line(run_config, beta, message):
    with pytest.raises(ConfigError, match=message) as caught:
        run_config("CartPole-v1", "mace_fixed", beta=beta)
    assert "\n" not in str(caught.value)


@pytest.fixture
def make(run_config):
    """`make(environment, initial, **settings of meta)`: the controller of mace_full."""

    def build(environment="CartPole-v1", initial=0.4, **settings) -> MetaAdaptation:
        beta = {"kind": "meta", "initial": initial}
        config = run_config(environment, "mace_full", 0, beta=beta, meta=settings)
        return beta_controller(config, environment_of(environment), Streams(0))

    return build


# --- What the network is asked for --------------------------------------------------------------


@pytest.mark.parametrize("initial", [0.05, 0.4, 0.9])
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_beta_starts_at_initial_and_stays_in_0_to_1(make, environment, initial):
    controller, rng = make(environment, initial, learning_rate=0.0), np.random.default_rng(0)
    assert controller.beta == initial and not controller.learns  # frozen: untrained for ever
    for scale in (1, 100, 1e4):
        episode = episode_of(rng, environment)
        episode.rewards[:] *= scale
        controller.next_episode(episode, rng.random(20))
        assert 0 < controller.beta < 1
        assert controller.beta == pytest.approx(initial, abs=0.05)


@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize(("length", "most"), [(9, None), (5, 6), (6, 6), (7, 6), (13, 6), (60, 6)])
def test_sequence_is_state_action_reward_bonus_in_even_stretches(make, environment, length, most):
    """Of consecutive steps, none left out: mean state and action, log of summed reward, bonus."""
    controller, rng = make(environment, max_sequence=most), np.random.default_rng(0)
    episode, bonus = episode_of(rng, environment, length), rng.random(length)
    states = episode.observations[:-1]
    controller.normaliser.update(3 + 2 * rng.standard_normal((50, states.shape[1])))
    states[2, :2] = [1e6, -1e6]  # far from all that was seen
    seen = ((states - controller.normaliser.mean) / controller.normaliser.std).clip(-10, 10)
    acted = np.eye(2)[episode.actions] if environment == "CartPole-v1" else episode.actions
    count = min(length, most or length)
    rows = []
    for start, end in pairwise(i * length // count for i in range(count + 1)):
        reward, summed = episode.rewards[start:end].sum(), bonus[start:end].sum()
        row = [*seen[start:end].mean(0), *acted[start:end].mean(0)]
        row += [math.copysign(math.log(1 + abs(reward)), reward), math.log(1 + summed)]
        rows.append([*row, *controller.progress.features(0.3)])
    found = controller.sequence(episode, bonus, 0.3)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, rows, rtol=1e-4, atol=1e-6)


# --- What is learned -----------------------------------------------------------------------------


def slow_progress(returns: list[float], beta: float) -> list[float]:
    """`Progress.features` from the whole history."""
    fast = slow = best = returns[0]
    stalled = 0
    for count, value in enumerate(returns[1:], start=2):
        fast += max(FAST, 1 / count) * (value - fast)
        slow += max(SLOW, 1 / count) * (value - slow)
        stalled += 1
        if fast > best + IMPROVEMENT * np.std(returns[:count]):
            best, stalled = fast, 0
    unit = np.std(returns) or 1.0
    features = [(fast - slow) / unit, (best - fast) / unit, math.log(1 + stalled) / 2]
    return [*features, math.log(beta / (1 - beta)) / 2]


@pytest.mark.parametrize(("trend", "noise"), [(0, 5), (1, 5), (0, 0), (-1, 5)])
def test_progress_equals_a_slow_computation(trend, noise):
    rng, progress = np.random.default_rng(0), Progress()
    returns = [trend * n + noise * rng.standard_normal() for n in range(60)]
    for count in range(1, 61):
        progress.update(returns[count - 1])
        expected = np.clip(slow_progress(returns[:count], 0.3), -3, 3)
        np.testing.assert_allclose(progress.features(0.3), expected, rtol=1e-6, atol=1e-9)
    assert (progress.features(0.3)[2] < 1.0) == (trend > 0)  # not stalled


@pytest.mark.parametrize(("credit", "rises"), [(0.8, True), (-0.8, False)])
def test_beta_follows_what_helped_and_comes_back_when_nothing_is_left_to_learn(make, credit, rises):
    """Also from the very end of its range."""
    controller, rng = make(horizon=1), np.random.default_rng(0)
    gradient = np.array([1.0, 0.0], np.float32)
    effect = Effect(np.array([credit, math.sqrt(1 - credit**2)], np.float32), 1.0)

    def play(episodes: int, strength: float) -> float:
        for _ in range(episodes):
            controller.next_episode(episode_of(rng), rng.random(20))
            controller.learn(strength * gradient, strength, [effect])
            assert 0 < controller.beta < 1
        return controller.beta

    learned = play(150, 1.0)
    assert (learned > 0.9) if rises else (learned < 0.1)
    assert play(600, 1e-6) == pytest.approx(0.4, abs=0.05)


def test_a_bonus_that_hardly_weighed_counts_for_little_and_a_heavy_one_for_one(make):
    gradient, found = np.array([1.0, 0.0], np.float32), []
    for advantage_rms in (0.5, 1.0, 3.0):
        controller, rng, credit = make(horizon=1), np.random.default_rng(0), None
        while credit is None:
            controller.next_episode(episode_of(rng), rng.random(20))
            credit = controller.learn(gradient, 1.0, [Effect(gradient, advantage_rms)])
        found.append(credit)
    # The gradient goes the effect's way, always as far: in its usual size, by 1.
    assert found == pytest.approx([0.5, 1.0, 1.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("problem", "low", "high"), [("Help", 0.6, 1), ("Harm", 0, 0.1), ("Nothing", 0.2, 0.6)]
)
def test_planted_problems(problem, low, high):
    """A bonus that helps, one that harms, one without any bearing; all starting from β = 0.4."""
    study = read_study([ROOT / "config.yaml", ROOT / "config" / "planted.yaml"])
    config = study.run_config(f"Planted{problem}-v0", "mace_full", 0)
    records = finish(config.model_copy(update={"episodes": 800})).records
    assert low <= np.mean([record.beta for record in records[-80:]]) <= high
