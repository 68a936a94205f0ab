"""β: what its network is asked for and what it learns; that it follows what helped."""

import copy
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete
from shared import Twin, beta_of, environment_of, finish

from mace_rl.beta.controller import Effect
from mace_rl.beta.meta import MetaAdaptation
from mace_rl.beta.progress import FAST, IMPROVEMENT, SLOW, Progress
from mace_rl.config.study import read_study
from mace_rl.environments.rollout import Episode
from mace_rl.factories import beta_controller
from mace_rl.streams import Streams

ROOT = Path(__file__).parents[1]


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
    controller = make(environment, initial)
    assert controller.beta == initial
    rng = np.random.default_rng(0)
    for scale in (1, 100, 1e4):
        episode = episode_of(rng, environment)
        episode.rewards[:] *= scale
        controller.next_episode(episode, rng.random(20))
        assert 0 < controller.beta < 1
        assert controller.beta == pytest.approx(initial, abs=0.05)  # untrained


def test_sequence_is_state_action_reward_bonus(make):
    controller, rng = make(max_sequence=None), np.random.default_rng(0)
    episode, bonus = episode_of(rng, length=6), rng.random(6)
    controller.normaliser.update(3 + 2 * rng.standard_normal((50, 4)))
    mean, std = controller.normaliser.mean, controller.normaliser.std
    rows = [
        [
            *((episode.observations[t] - mean) / std),
            *(float(episode.actions[t] == action) for action in (0, 1)),
            math.copysign(math.log(1 + abs(episode.rewards[t])), episode.rewards[t]),
            math.log(1 + bonus[t]),
            *controller.progress.features(0.3),
        ]
        for t in range(6)
    ]
    found = controller.sequence(episode, bonus, 0.3)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, rows, rtol=1e-5)


def test_what_is_far_from_all_that_was_seen_does_not_flood_the_lstm(make):
    controller, rng = make(), np.random.default_rng(0)
    controller.normaliser.update(rng.standard_normal((50, 4)))
    episode = episode_of(rng, length=6)
    episode.observations[2] = [1e6, -1e6, 0, 0]
    found = controller.sequence(episode, np.zeros(6), 0.4)[2, :2]
    assert found.tolist() == [10, -10]


def test_one_credit_counts_for_no_more_than_the_bound(make):
    controller = make(max_credit=2.5, horizon=4)
    for credit, expected in ((3.0, 1.5), (-3.0, -1.5), (4.9, 2.45), (100.0, 2.5), (-100.0, -2.5)):
        assert controller.bounded(credit) == expected  # of four terms, whose noise is 2


@pytest.mark.parametrize("length", [5, 6, 7, 13, 60])
def test_long_sequences_are_condensed(make, length):
    """At most 6 stretches of consecutive steps, as even as can be, none left out: mean state and
    action, logarithm of the summed reward and bonus."""
    rng = np.random.default_rng(0)
    episode, bonus = episode_of(rng, "Pendulum-v1", length), rng.random(length)
    whole = make("Pendulum-v1", max_sequence=None).sequence(episode, bonus, 0.4)
    found = make("Pendulum-v1", max_sequence=6).sequence(episode, bonus, 0.4)
    if length <= 6:
        assert (found == whole).all()
        return
    assert len(found) == 6
    bounds = [math.floor(i * length / 6) for i in range(7)]
    for row, (start, end) in zip(found, pairwise(bounds), strict=True):
        means = [*range(4), *range(6, len(row))]  # state, action; progress, the same everywhere
        np.testing.assert_allclose(row[means], whole[start:end, means].mean(0), 1e-4, atol=1e-6)
        reward, summed = episode.rewards[start:end].sum(), bonus[start:end].sum()
        assert row[4] == pytest.approx(math.copysign(math.log(1 + abs(reward)), reward), rel=1e-5)
        assert row[5] == pytest.approx(math.log(1 + summed), rel=1e-5)


def test_beta_of_the_next_episode_is_the_lstm_s_answer_to_the_last(make):
    controller, rng = make(hidden_units=5), np.random.default_rng(0)
    controller.next_episode(episode_of(rng, length=7), rng.random(7))
    expected = beta_of(Twin(controller.network), controller.sources[-1])
    assert controller.beta == pytest.approx(expected.item(), abs=1e-6)


# --- What is learned -----------------------------------------------------------------------------


def slow_progress(returns: list[float], beta: float) -> list[float]:
    """`Progress.features` from the whole history."""
    fast, slow, averages = returns[0], returns[0], []
    best, stalled = returns[0], 0
    for count, value in enumerate(returns[1:], start=2):
        weight_fast, weight_slow = max(FAST, 1 / count), max(SLOW, 1 / count)
        fast = (1 - weight_fast) * fast + weight_fast * value
        slow = (1 - weight_slow) * slow + weight_slow * value
        averages.append(fast)
        stalled += 1
        if fast > best + IMPROVEMENT * np.std(returns[:count]):
            best, stalled = fast, 0
    unit = np.std(returns) or 1.0
    features = [(fast - slow) / unit, (best - fast) / unit, math.log(1 + stalled) / 2]
    return [*features, math.log(beta / (1 - beta)) / 2]


@pytest.mark.parametrize("kind", ["noise", "rise", "constant", "fall"])
def test_progress_equals_a_slow_computation(kind):
    rng, progress = np.random.default_rng(0), Progress()
    trend = {"noise": 0.0, "rise": 1.0, "constant": 0.0, "fall": -1.0}[kind]
    returns = [trend * n + 5 * (kind != "constant") * rng.standard_normal() for n in range(60)]
    for count in range(1, 61):
        progress.update(returns[count - 1])
        expected = np.clip(slow_progress(returns[:count], 0.3), -3, 3)
        np.testing.assert_allclose(progress.features(0.3), expected, rtol=1e-6, atol=1e-9)
    stalled = progress.features(0.3)[2]
    assert (stalled < 1.0) == (kind == "rise")


def judge(controller: MetaAdaptation, credits: list[float]) -> float | None:
    """Let one episode each get these credits, with what is usual fixed at 1."""
    controller.alignments = controller.alignment_weight = 1e12
    gradient = np.array([1.0, 0.0], np.float32)
    effects = [Effect(np.array([c, math.sqrt(1 - c * c)], np.float32), 1.0) for c in credits]
    controller.learn(np.zeros(2, np.float32), 0.0, effects)
    return controller.learn(gradient, 1.0, [])


@pytest.mark.parametrize("credits", [[0.7], [-0.7], [0.5, -0.2, 0.9]])
def test_lstm_receives_credit_and_prior_through_the_logit(make, learned, credits):
    controller, rng = make(hidden_units=6, horizon=1, prior=0.3), np.random.default_rng(0)
    controller.network.split(controller.network.parameters)[-1][:] += 0.7  # away from the prior
    for _ in range(len(credits) + 1):  # the first β is given, so one more
        controller.next_episode(episode_of(rng), rng.random(20))
    sequences = list(controller.sources)[1 : len(credits) + 1]
    controller.sources.popleft()
    twin = Twin(controller.network)
    assert judge(controller, credits) == pytest.approx(np.mean(credits), abs=1e-6)
    logits = [twin(sequence) for sequence in sequences]
    initial = math.log(0.4 / 0.6)
    terms = [c * x - 0.3 / 2 * (x - initial) ** 2 for c, x in zip(credits, logits, strict=True)]
    # Adam descends, so the gradient is that of minus the objective.
    expected = twin.gradient(-torch.cat(terms).mean())
    (gradient,) = learned
    np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-6)
    assert all((part != 0).any() for part in controller.network.split(gradient))


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


@pytest.mark.parametrize("missing", ["strength", "influence"])
def test_no_credit_without_extrinsic_or_intrinsic_advantage(make, missing):
    """Half as much of either is half the credit, however large the gradients are."""
    found = {}
    for share in (1.0, 0.5):
        controller = make(horizon=1)
        controller.next_episode(episode_of(np.random.default_rng(0)), np.ones(20))
        controller.sources.popleft()
        controller.alignments = controller.alignment_weight = 1e12
        given = {"strength": 1.0, "influence": 1.0} | {missing: share}
        effect = Effect(np.array([3.0, 4.0], np.float32), given["influence"])
        controller.learn(np.zeros(2, np.float32), 0.0, [effect])
        gradient = np.array([given["strength"], 0], np.float32)
        found[share] = controller.learn(gradient, given["strength"], [])
    assert found[1.0] == pytest.approx(0.6) and found[0.5] == pytest.approx(0.3)


def test_a_frozen_network_gives_the_initial_beta_for_ever(make):
    controller = make(learning_rate=0.0)
    before = controller.network.parameters.copy()
    assert not controller.learns
    for seed in range(5):
        controller.next_episode(episode_of(np.random.default_rng(seed)), np.ones(20))
        assert controller.beta == pytest.approx(0.4, abs=0.05)
    assert (controller.network.parameters == before).all()


def test_restored_controller_continues_to_the_bit(make):
    original, restored, rng = make(horizon=3), make(horizon=3), np.random.default_rng(0)

    def step(controllers, several: bool) -> None:
        episodes = [episode_of(rng) for _ in range(2 if several else 1)]
        gradient, *changes = rng.standard_normal((len(episodes) + 1, 9)).astype(np.float32)
        for controller in controllers:
            for episode in episodes:
                controller.next_episode(episode, np.ones(20))
            controller.learn(gradient, 0.7, [Effect(change, 0.5) for change in changes])

    for several in (False, True, False, False, True):
        step([original], several)
    restored.load_state_dict(copy.deepcopy(original.state_dict()))
    for several in (True, False, False, True, False):
        step([original, restored], several)
        assert original.beta == restored.beta
    assert (original.network.parameters == restored.network.parameters).all()
    assert original.optimiser.time > 5


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
