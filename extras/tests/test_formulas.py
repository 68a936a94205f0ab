"""What each plugin's own paper says, on a small example and against a computation of its own."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from shared import Twin
from torch.nn.functional import cross_entropy

from extras.bandit import Bandit
from extras.hashing import HashCounts
from extras.icm import ICM
from extras.random_beta import RandomBeta
from extras.rnd import RND
from mace_rl.config.section import ConfigError
from mace_rl.environments.episode import Episode
from mace_rl.environments.spaces import Spaces

ACTIONS = {"discrete": Discrete(3)}
ACTIONS |= {f"{len(shape)}d": Box(-1, 1, shape, np.float32) for shape in ((2,), (2, 1))}
ARMS = [0.0, 0.1, 0.4, 1.0]


def wander(seed, centre=0.0, scale=1.0, actions="discrete") -> Episode:
    rng = np.random.default_rng(seed)
    states = centre + scale * rng.standard_normal((51, 5))
    taken = rng.integers(3, size=50) if actions == "discrete" else rng.normal(size=(50, 2))
    return Episode(states.astype(np.float32), taken, np.zeros(50, np.float32), np.zeros(50), False)


def make(bonus, actions="discrete", **arguments):
    spaces = Spaces("a test's", Box(-9, 9, (5,)), ACTIONS[actions])
    return bonus(spaces, np.random.default_rng(0), **arguments)


def test_rnd_falls_where_it_was_and_stays_high_elsewhere():
    rnd, near, far = make(RND), wander(99), wander(98, centre=4.0)
    target, means = rnd.target.parameters.copy(), []
    for seed in range(150):
        rnd.remember(wander(seed), np.zeros(50))
        means.append((rnd.bonus(near).reward.mean(), rnd.bonus(far).reward.mean()))
    assert means[19][0] < 0.7 * means[0][0] and means[-1][0] < 0.05 * means[19][0]
    assert means[-1][1] > 20 * means[-1][0]
    assert (rnd.target.parameters == target).all()


def test_rnd_by_autograd():
    """The bonus and the gradient, from the two networks as torch modules in float64."""
    rnd = make(RND)
    known, episode = wander(0, scale=[1, 2, 3, 4, 50]), wander(7, scale=20.0)
    rnd.remember(known, np.zeros(50))
    states = known.observations[1:]
    seen = np.clip((episode.observations[1:] - states.mean(0)) / states.std(0), -5, 5)
    predictor = Twin(rnd.network)
    errors = (predictor(seen) - Twin(rnd.target)(seen).detach()).square().mean(dim=1)
    np.testing.assert_allclose(rnd.bonus(episode).reward, errors.detach(), rtol=1e-3, atol=1e-5)
    found, expected = rnd.gradient(seen.astype(np.float32)), predictor.gradient(errors.mean())
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


def test_icm_refuses_several_choices_at_once():
    spaces = Spaces("a test's", Box(-9, 9, (5,)), MultiDiscrete([2, 3]))
    with pytest.raises(ConfigError, match="Discrete and Box actions, not MultiDiscrete"):
        ICM(spaces, np.random.default_rng(0))


@pytest.mark.parametrize("actions", ACTIONS)
def test_icm_by_autograd(actions):
    """Its joint loss (equation 7) written out from its three networks, in float64."""
    icm, episode = make(ICM, actions, forward_weight=0.3, scale=4.0), wander(1, actions=actions)
    features, inverse_model, forward_model = twins = [
        Twin(network) for network in (icm.features, icm.inverse_model, icm.forward_model)
    ]
    seen = torch.from_numpy(np.clip(episode.observations, -5, 5)).double()
    before, after = features(seen[:-1]), features(seen[1:])
    guess = inverse_model(torch.cat([before, after], 1))
    if actions == "discrete":
        taken = torch.eye(3, dtype=torch.float64)[episode.actions]
        inverse = cross_entropy(guess, torch.from_numpy(episode.actions))
    else:  # as the environment took it: within its bounds
        taken = torch.from_numpy(episode.actions.clip(-1, 1))
        inverse = ((guess - taken) ** 2).sum() / 2 / len(taken)
    errors = ((forward_model(torch.cat([before, taken], 1)) - after) ** 2).sum(1) / 2
    np.testing.assert_allclose(icm.bonus(episode).reward, 4 * errors.detach(), rtol=1e-4)
    loss = 0.7 * inverse + 0.3 * errors.mean()
    expected = np.concatenate([twin.gradient(loss) for twin in twins])
    found = icm.gradient(icm.inputs(episode))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


def test_counts_are_those_of_sign_patterns():
    """Counted among all that was seen, in units of the first 120 states or more."""
    hashed, seen = make(HashCounts, bits=4, calibration_states=120), np.empty((0, 5))
    for seed in range(6):
        episode = wander(seed, centre=seed, scale=[1, 1, 5, 1, 100])
        first = seen[:150] if seed else np.zeros((1, 5))  # 3 · 50 ≥ 120
        seen = np.concatenate([seen, episode.observations[1:]])
        signs = ((seen - first.mean(0)) / (first.std(0) if seed else 1)) @ hashed.matrix.T > 0
        visits = [(signs[: n + 1] == signs[n]).all(1).sum() for n in range(len(seen))]
        expected = 1 / np.sqrt(visits[-50:])
        np.testing.assert_allclose(hashed.bonus(episode).reward, expected)
        hashed.remember(episode, np.zeros(50))
    assert sum(hashed.counts.values()) == 300


def paying(extrinsic_return: float) -> Episode:
    """An episode of which only its return is looked at."""
    return Episode(np.zeros((2, 1)), None, None, np.array([extrinsic_return]), True)


def test_random_is_uniform_from_its_own_generator():
    rule, found = RandomBeta(np.random.default_rng(5), low=0.2, high=0.7), []
    for _ in range(300):
        found.append(rule.next_beta())
        rule.next_episode(paying(1.0), np.zeros(1))
    assert found == np.random.default_rng(5).uniform(0.2, 0.7, 300).tolist()


@pytest.mark.parametrize("spread", [1000.0, 0.0])
@pytest.mark.parametrize(("window", "exploration"), [(90, 1.0), (5, 0.1), (4, 0.0)])
def test_bandit_equals_the_formula_on_its_whole_history(spread, window, exploration):
    """Two episodes in each rollout; the arm of a rollout is paid what the next one returned."""
    settings = {"window": window, "exploration": exploration, "epsilon": 0.2}
    bandit = Bandit(np.random.default_rng(7), arms=ARMS, **settings)
    returns = spread * np.random.default_rng(1).standard_normal((150, 2)) - 3
    draws, arms = np.random.default_rng(7), []
    for n, pair in enumerate(returns):
        if n < 4:
            arms.append(n)
        elif draws.random() < 0.2:
            arms.append(int(draws.integers(4)))
        else:
            seen, bounds = returns[:n], []
            shares = (seen - seen.min()).mean(1) / (np.ptp(seen) or 1.0)
            pulls = list(zip(arms[:-1], shares[1:], strict=True))[-window:]
            for arm in range(4):
                paid = [share for one, share in pulls if one == arm]
                new = -np.inf if arm == arms[-1] else np.inf
                bounds.append(np.mean(paid) + exploration * len(paid) ** -0.5 if paid else new)
            arms.append(bounds.index(max(bounds)))
        for value in pair:
            assert bandit.next_beta() == ARMS[arms[n]]
            bandit.next_episode(paying(value), np.zeros(1))
        bandit.end_rollout()
    assert set(arms) == {0, 1, 2, 3}
