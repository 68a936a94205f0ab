"""The bonuses besides the paper's: what each one's own paper promises, and what all share."""

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from shared import Twin, finish
from torch.nn.functional import cross_entropy

from mace_rl.bonus.hashing import HashCounts
from mace_rl.bonus.icm import IntrinsicCuriosityModule
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.bonus.rnd import RandomNetworkDistillation
from mace_rl.config.bonus import HashCountsBonus, ICMBonus, RNDBonus
from mace_rl.config.section import ConfigError
from mace_rl.environments.rollout import Episode
from mace_rl.numerics.finite import NonFiniteError
from mace_rl.runs.checkpoint import archive
from mace_rl.study.config import read_study
from mace_rl.trainer import Trainer

CONFIG = Path(__file__).parents[1] / "config.yaml"
OTHERS = ["icm", "rnd", "hash_counts"]
SIZE, ACTIONS = 5, {"discrete": Discrete(3), "box": Box(-1, 1, (2,), np.float32)}


def wander(seed, centre=0.0, scale=1.0, length=50, size=SIZE, actions="discrete") -> Episode:
    rng = np.random.default_rng(seed)
    states = centre + scale * rng.standard_normal((length + 1, size))
    taken = rng.integers(3, size=length) if actions == "discrete" else rng.normal(size=(length, 2))
    zeros = np.zeros(length)
    return Episode(states.astype(np.float32), taken, zeros.astype(np.float32), zeros, False)


def make(kind: str, seed=0, actions="discrete", **settings) -> IntrinsicReward:
    space, generator = Box(-9, 9, (SIZE,)), np.random.default_rng(seed)
    if kind == "icm":
        config = ICMBonus(kind=kind, **settings)
        return IntrinsicCuriosityModule(config, space, ACTIONS[actions], SIZE, generator)
    if kind == "rnd":
        config = RNDBonus(kind=kind, **settings)
        return RandomNetworkDistillation(config, space, SIZE, generator)
    return HashCounts(HashCountsBonus(kind=kind, **settings), space, SIZE, generator)


# --- RND ----------------------------------------------------------------------------------------


def test_rnd_falls_where_it_was_and_stays_high_elsewhere():
    rnd, near, far = make("rnd"), wander(99), wander(98, centre=4.0)
    target = rnd.target.parameters.copy()
    means = []
    for seed in range(150):
        rnd.remember(wander(seed), np.zeros(50))
        means.append((rnd.bonus(near).reward.mean(), rnd.bonus(far).reward.mean()))
    assert means[19][0] < 0.7 * means[0][0] and means[-1][0] < 0.05 * means[19][0]
    assert means[-1][1] > 20 * means[-1][0]
    assert (rnd.target.parameters == target).all()


@pytest.mark.parametrize("kind", ["rnd", "icm"])
def test_an_episode_is_learned_once_in_minibatches_in_random_order(kind, monkeypatch):
    """Whitened with itself among what was seen, every step in one minibatch of at most 20."""
    bonus, parts = make(kind, batch_size=20), []
    bonus.remember(wander(0, scale=3.0), np.zeros(50))
    gradient = bonus.gradient
    monkeypatch.setattr(bonus, "gradient", lambda part: (parts.append(part), gradient(part))[1])
    episode, order = wander(1, centre=2.0), copy.deepcopy(bonus.generator).permutation(50)
    bonus.remember(episode, np.zeros(50))
    assert [len(part) for part in parts] == [17, 17, 16]
    seen = np.concatenate([wander(0, scale=3.0).observations[1:], episode.observations[1:]])
    np.testing.assert_allclose(bonus.normaliser.mean, seen.mean(0), atol=1e-5)
    np.testing.assert_array_equal(np.concatenate(parts), bonus.inputs(episode)[order])


def test_rnd_by_autograd():
    """The bonus and the gradient, from the two networks as torch modules in float64."""
    rnd = make("rnd")
    known, episode = wander(0, scale=[1, 2, 3, 4, 50]), wander(7, scale=20.0)
    rnd.remember(known, np.zeros(50))
    states = known.observations[1:]
    seen = np.clip((episode.observations[1:] - states.mean(0)) / states.std(0), -5, 5)
    predictor = Twin(rnd.network)
    errors = (predictor(seen) - Twin(rnd.target)(seen).detach()).square().mean(dim=1)
    np.testing.assert_allclose(rnd.bonus(episode).reward, errors.detach(), rtol=1e-3, atol=1e-5)
    found, expected = rnd.gradient(seen.astype(np.float32)), predictor.gradient(errors.mean())
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


# --- ICM ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("actions", ACTIONS)
def test_icm_by_autograd(actions):
    """Its joint loss (equation 7) written out from its three networks, in float64."""
    icm = make("icm", actions=actions, forward_weight=0.3, scale=4.0)
    episode = wander(1, actions=actions)
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


# --- Counts of hashes ---------------------------------------------------------------------------


def test_counts_are_those_of_sign_patterns():
    """Counted by a dictionary of all that was seen, in units of the first 120 states or more."""
    hashed = make("hash_counts", bits=4, calibration_states=120)
    seen: list[np.ndarray] = []
    for seed in range(6):
        episode = wander(seed, centre=seed, scale=[1, 1, 5, 1, 100])
        first = np.concatenate(seen[:3]) if seen else np.zeros((1, SIZE))  # 3 · 50 ≥ 120
        mean, std = (first.mean(0), first.std(0)) if seen else (0.0, 1.0)
        counts: dict[tuple, int] = {}

        def visit(state, counts=counts, mean=mean, std=std) -> int:
            pattern = tuple(row @ ((state - mean) / std) > 0 for row in hashed.matrix)
            counts[pattern] = counts.get(pattern, 0) + 1
            return counts[pattern]

        for state in np.concatenate(seen) if seen else ():
            visit(state)
        expected = [1 / math.sqrt(visit(state)) for state in episode.observations[1:]]
        np.testing.assert_allclose(hashed.bonus(episode).reward, expected)
        hashed.remember(episode, np.zeros(50))
        seen.append(episode.observations[1:].astype(np.float64))
    assert sum(hashed.counts.values()) == 300


def test_discrete_states_are_counted_one_by_one(run_config):
    bonus = {"kind": "hash_counts", "bits": 40}
    trainer = finish(run_config("FrozenLake-v1", "mace_fixed", 3, bonus=bonus, episodes=9))
    codes = set(trainer.curiosity.codes(np.eye(16)))
    assert len(codes) == 16 and codes >= set(trainer.curiosity.counts)
    assert trainer.curiosity.normaliser.count == 0  # one-hot states as they are
    assert sum(trainer.curiosity.counts.values()) == trainer.records[-1].env_steps


# --- What all share -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_training(run_config, environment, kind):
    changes = {"bonus": {"kind": kind}, "episodes": 4, "max_episode_steps": 60}
    config = run_config(environment, "mace_fixed", 3, **changes)
    assert config.memory is config.novelty is None
    trainer = finish(config)
    assert all(0 < record.intrinsic_return < math.inf for record in trainer.records)
    last = trainer.diagnostics[-1]
    assert np.isnan([last.novelty, last.relevance, last.similarity]).all() and last.bonus_share > 0
    interrupted, resumed = Trainer(config), Trainer(config)
    next(interrupted.run())
    resumed.load_state_dict(interrupted.state_dict())
    assert archive(finish(resumed).state_dict()) == archive(trainer.state_dict())


@pytest.mark.parametrize(
    "bonus", [*({"kind": kind} for kind in OTHERS), {"kind": "curiosity", "relevance": False}]
)
@pytest.mark.parametrize("environment", ["CartPole-v1", "FrozenLake-v1", "Pendulum-v1"])
def test_beta_0_equals_ppo_to_the_bit(run_config, environment, bonus):
    changes = {"episodes": 6, "max_episode_steps": 60, "ppo": {"rollout_steps": 70}}
    plain = finish(run_config(environment, "ppo", 3, **changes))
    changes |= {"beta": {"kind": "constant", "value": 0}, "bonus": bonus}
    zero = finish(run_config(environment, "mace_fixed", 3, **changes))
    for name in ("actor", "extrinsic"):
        states = [archive(run.ppo.learner.optimisers[name].state_dict()) for run in (zero, plain)]
        assert states[0] == states[1]
    returns = [[record.extrinsic_return for record in run.records] for run in (zero, plain)]
    assert returns[0] == returns[1] and plain.curiosity is None
    assert sum(record.intrinsic_return for record in zero.records) > 0.1


class Fixed(IntrinsicReward):
    """A user's own: the number of actions at every step."""

    def __init__(self, size, action_space, generator):
        self.value = float(action_space.n)

    def bonus(self, episode):
        return Bonus(np.full(len(episode), self.value))

    def remember(self, episode, returns):
        pass

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def test_a_bonus_of_one_s_own(run_config):
    bonus = {"kind": "custom", "estimator": "test_bonuses:Fixed"}
    config = run_config(variant="mace_fixed", bonus=bonus, episodes=3)
    trainer = finish(config)
    assert all(r.intrinsic_return == 2 * r.length for r in trainer.records)
    assert config.references() == {"bonus.estimator": "test_bonuses:Fixed"}
    for value, text in ((-0.5, r"is -0.5, which is not in \[0, inf\]"), (math.inf, "is inf")):
        trainer = Trainer(config)
        trainer.curiosity.value = value
        with pytest.raises(NonFiniteError, match=f"episode 1: the curiosity bonus {text}"):
            finish(trainer)


# --- The settings -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bonus", "fragment"),
    [
        ("{kind: rnb}", "in variant_settings.x, bonus is {'kind': 'rnb'}, but"),
        ("{kind: rnd, feature_unit: 3}", "unknown key 'bonus.feature_unit' (value 3); the nearest"),
        ("{kind: rnd, relevance: true}", "unknown key 'bonus.relevance'"),
        ("{kind: icm, forward_weight: 1.5}", "bonus.forward_weight is 1.5, but should be less"),
        ("{kind: hash_counts, bits: 63}", "bonus.bits is 63, but should be less than or equal"),
        ("{kind: curiosity, relevance: 1}", "bonus.relevance is 1, but should be a valid boolean"),
        ("{kind: custom}", "the key 'bonus.estimator' is missing"),
        ("{kind: custom, estimator: 'no_such:Thing'}", "bonus.estimator has 'no_such:Thing'"),
        ("null", "the section 'bonus' is missing"),
        ("{kind: rnd}, memory: {capacity: 9}", "'memory', which a variant with bonus.kind 'rnd'"),
        (
            "{kind: curiosity, relevance: false}, memory: {capacity: 9}",
            "variant_settings.x has the section 'memory', which a variant with bonus.relevance",
        ),
    ],
)
def test_mistake_is_named_in_one_line(tmp_path, bonus, fragment):
    beta = "{kind: exponential, initial: 0.4, decay: 0.9, floor: 0.1}"
    file = tmp_path / "over.yaml"
    file.write_text(f"variant_settings: {{x: {{beta: {beta}, bonus: {bonus}}}}}\n")
    with pytest.raises(ConfigError) as caught:
        read_study([CONFIG, file])
    assert fragment in str(caught.value) and "\n" not in str(caught.value)


def test_a_variant_s_bonus_goes_over_that_of_training(tmp_path):
    """Of the same kind it changes some keys; of another it leaves nothing of it."""
    file = tmp_path / "over.yaml"
    file.write_text(
        "variants: [ppo, mace_fixed, icm, rnd]\n"
        "variant_settings:\n"
        "  icm: {beta: {kind: constant, value: 1.0}, bonus: {kind: icm, scale: 2.0}}\n"
        "  rnd: {beta: {kind: constant, value: 1.0}, bonus: {kind: rnd}}\n"
        "training: {bonus: {kind: icm, hidden_units: 7}}\n"
    )
    study = read_study([CONFIG, file])
    bonuses = {v: study.run_config("CartPole-v1", v, 0).bonus for v in study.variants}
    assert bonuses["ppo"] is None
    assert bonuses["icm"] == ICMBonus(kind="icm", hidden_units=7, scale=2.0)
    assert bonuses["rnd"] == RNDBonus(kind="rnd")
    assert bonuses["mace_fixed"] == ICMBonus(kind="icm", hidden_units=7)
