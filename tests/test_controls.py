"""Constant, random and bandit β: against sums over the whole history, through the real trainer."""

import copy
import io
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import kstest
from shared import environment_of, finish

from mace_rl.beta.controls import RandomDraw, SlidingWindowBandit
from mace_rl.config.beta import BanditBeta
from mace_rl.config.section import ConfigError
from mace_rl.config.study import read_study
from mace_rl.environments.rollout import Episode
from mace_rl.factories import beta_controller
from mace_rl.runs.checkpoint import archive
from mace_rl.streams import Streams
from mace_rl.train import Trainer

ROOT = Path(__file__).parents[1]
ARMS = [0.0, 0.1, 0.4, 1.0]
BANDIT = {"kind": "bandit", "arms": ARMS, "window": 90, "exploration": 1.0, "epsilon": 0.1}
RANDOM = {"kind": "random", "low": 0.2, "high": 0.7}


def episode_of(extrinsic_return: float, length: int = 1) -> Episode:
    rewards = np.zeros(length)
    rewards[-1] = extrinsic_return
    return Episode(np.zeros((length + 1, 1), np.float32), None, None, rewards, True)


def bandit(seed: int = 0, rollout_steps: int = 1, **changes) -> SlidingWindowBandit:
    config = BanditBeta.model_validate(BANDIT | changes)
    return SlidingWindowBandit(config, rollout_steps, np.random.default_rng(seed))


# --- Constant -----------------------------------------------------------------------------------


@pytest.mark.parametrize("environment", ["CartPole-v1", "Acrobot-v1"])
def test_constant_0_is_plain_ppo_to_the_bit(run_config, environment):
    plain = finish(run_config(environment, "ppo", 3, episodes=8))
    constant = {"kind": "constant", "value": 0.0}
    zero = finish(run_config(environment, "mace_fixed", 3, episodes=8, beta=constant))
    for one, other in zip(plain.records, zero.records, strict=True):
        assert vars(one) == {**vars(other), "intrinsic_return": 0.0}
    for name in ("actor", "extrinsic"):
        states = [archive(run.ppo.optimisers[name].state_dict()) for run in (plain, zero)]
        assert states[0] == states[1]
    assert sum(record.intrinsic_return for record in zero.records) > 1


@pytest.mark.parametrize("value", [0.3, 1])
def test_a_constant_is_a_schedule_that_does_not_decay(run_config, value):
    schedule = {"kind": "exponential", "initial": value, "decay": 1.0, "floor": 0.0}
    runs = [
        finish(run_config("CartPole-v1", "mace_fixed", 1, episodes=9, beta=beta))
        for beta in ({"kind": "constant", "value": value}, schedule)
    ]
    assert {record.beta for record in runs[0].records} == {value}
    assert runs[0].records == runs[1].records
    assert archive(runs[0].ppo.state_dict()) == archive(runs[1].ppo.state_dict())


# --- Random -------------------------------------------------------------------------------------


def test_random_is_uniform_from_its_own_stream(run_config):
    config = run_config("CartPole-v1", "mace_fixed", 5, beta=RANDOM)
    controller = beta_controller(config, environment_of("CartPole-v1"), Streams(5))
    assert isinstance(controller, RandomDraw) and not controller.learns
    found = []
    for _ in range(3000):
        found.append(controller.beta)
        assert controller.beta == found[-1]  # asking again draws nothing
        controller.next_episode(episode_of(1.0), np.zeros(1))
    assert kstest(found, "uniform", args=(0.2, 0.5)).pvalue > 0.01
    assert np.abs(np.corrcoef(found[:-1], found[1:])[0, 1]) < 0.05
    assert found == Streams(5)["beta"].uniform(0.2, 0.7, 3000).tolist()


# --- Bandit -------------------------------------------------------------------------------------


def arms_by_the_whole_history(returns, lengths, rollout_steps, window, exploration, epsilon, seed):
    """The arm of every episode, each rollout's computed anew from all that was before it."""
    rng, arms, steps, rollouts = np.random.default_rng(seed), [], 0, [[]]
    chosen = [0]  # by rollout
    for i, length in enumerate(lengths):
        arms.append(chosen[-1])
        rollouts[-1].append(returns[i])
        steps += length
        if steps < rollout_steps:
            continue
        steps, k = 0, len(chosen)
        rollouts.append([])
        if k < len(ARMS):
            chosen.append(k)
        elif rng.random() < epsilon:
            chosen.append(int(rng.integers(len(ARMS))))
        else:
            low, high = min(returns[: i + 1]), max(returns[: i + 1])
            # The reward of rollout m's arm is what rollout m + 1 returned.
            pulls = [(chosen[m], np.mean(rollouts[m + 1])) for m in range(k - 1)][-window:]
            bounds = []
            for arm in range(len(ARMS)):
                paid = [(reward - low) / (high - low) for one, reward in pulls if one == arm]
                new = -np.inf if arm == chosen[-1] else np.inf
                bounds.append(np.mean(paid) + exploration * len(paid) ** -0.5 if paid else new)
            chosen.append(bounds.index(max(bounds)))
    return arms


@pytest.mark.parametrize("rollout_steps", [1, 40])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
@pytest.mark.parametrize(("window", "exploration"), [(90, 1.0), (5, 0.1), (4, 0.0)])
def test_bandit_equals_the_formula_on_its_whole_history(rollout_steps, scale, window, exploration):
    rng = np.random.default_rng(1)
    returns = (scale * (rng.standard_normal(600) - 3)).tolist()
    lengths = rng.integers(1, 30, 600).tolist()
    settings = {"window": window, "exploration": exploration, "epsilon": 0.2}
    controller, betas = bandit(7, rollout_steps, **settings), []
    for value, length in zip(returns, lengths, strict=True):
        betas.append(controller.beta)
        controller.next_episode(episode_of(value, length), np.zeros(length))
    expected = arms_by_the_whole_history(returns, lengths, rollout_steps, seed=7, **settings)
    assert betas == [ARMS[arm] for arm in expected]
    assert set(betas) == set(ARMS)


@pytest.mark.parametrize("seed", range(5))
def test_bandit_follows_the_best_arm_when_it_changes(seed):
    """β works on the next episode, whose return has noise as large as the arms differ."""
    controller, rng = bandit(seed, exploration=0.3, window=60), np.random.default_rng(100 + seed)
    betas, before = [], 0.0
    for episode in range(1200):
        best = ARMS[1] if episode < 600 else ARMS[3]
        controller.next_episode(episode_of(50 * (before == best) + 50 * rng.random()), np.zeros(1))
        before = controller.beta
        betas.append(before)
    assert betas[300:600].count(ARMS[1]) > 180 and betas[900:].count(ARMS[3]) > 180
    assert min(betas[900:].count(arm) for arm in ARMS) > 3  # the others are still tried


def test_equal_returns_leave_all_arms_alike():
    controller = bandit(epsilon=0.0)
    betas = []
    for _ in range(400):
        betas.append(controller.beta)
        controller.next_episode(episode_of(-500.0), np.zeros(1))
    assert all(90 <= betas.count(arm) <= 110 for arm in ARMS)


# --- Resuming, mistakes, the study --------------------------------------------------------------


@pytest.mark.parametrize("rollout_steps", [1, 60])
@pytest.mark.parametrize(
    "beta", [{"kind": "constant", "value": 0.4}, RANDOM, BANDIT | {"window": 5}]
)
def test_saved_midway_it_continues_to_the_bit(run_config, beta, rollout_steps):
    settings = {"episodes": 16, "beta": beta, "ppo": {"rollout_steps": rollout_steps}}
    config = run_config("CartPole-v1", "mace_fixed", 2, **settings)
    original, restored = Trainer(config), Trainer(config)
    rounds = original.run()
    while len(original.records) < 7:
        betas = {record.beta for record in next(rounds)}
        assert len(betas) == 1 or beta is RANDOM  # an arm holds for a rollout
    saved = archive(copy.deepcopy(original.state_dict()))
    restored.load_state_dict(torch.load(io.BytesIO(saved), weights_only=True))
    assert finish(original).records == finish(restored).records
    assert original.controller.state_dict() == restored.controller.state_dict()
    assert archive(original.ppo.state_dict()) == archive(restored.ppo.state_dict())


@pytest.mark.parametrize(
    ("beta", "message"),
    [
        ({"kind": "constant", "value": 1.5}, "beta.value is 1.5, but .* less than or equal to 1"),
        ({"kind": "constant", "value": True}, "beta.value is True, but .* number"),
        ({"kind": "constant"}, "the key 'beta.value' is missing"),
        (RANDOM | {"low": 0.8}, "beta .* low is 0.8, which must not exceed high, 0.7"),
        (RANDOM | {"high": -0.1}, "beta.high is -0.1, but .* greater than or equal to 0"),
        (BANDIT | {"arms": []}, r"beta.arms is \[\], but .* at least 1 item"),
        (BANDIT | {"arms": [0, 2]}, "beta.arms.1 is 2, but .* less than or equal to 1"),
        (BANDIT | {"window": 3}, "beta .* window is 3, which must hold each of the 4 arms"),
        (BANDIT | {"epsilon": 1.1}, "beta.epsilon is 1.1, but .* less than or equal to 1"),
        (BANDIT | {"exploration": -1}, "beta.exploration is -1, but .* 0"),
        (BANDIT | {"explore": 1}, "unknown key 'beta.explore' .* 'exploration'"),
    ],
)
def test_wrong_settings_get_one_line(run_config, beta, message):
    with pytest.raises(ConfigError, match=message) as caught:
        run_config("CartPole-v1", "mace_fixed", beta=beta)
    assert "\n" not in str(caught.value)


def test_the_study_of_controls_compares_the_learned_beta_with_each():
    study = read_study([ROOT / "config.yaml", ROOT / "config" / "controls.yaml"])
    assert len(set(study.colours.values())) == len(set(study.labels.values())) == 13
    others = [variant for variant in study.variants if variant != "mace_full"]
    assert sorted(study.metrics.comparisons) == sorted(["mace_full", other] for other in others)
    for variant in others:
        assert study.run_config("CartPole-v1", variant, 0).meta is None
    constants = [0, 0.1, 0.2, 0.4, 0.7, 1]
    found = [study.run_config("Acrobot-v1", f"beta_{v}", 0).beta.value for v in constants]
    assert found == constants
