"""Bonuses besides the paper's: novelty alone, one of the user's own, and their settings."""

import math
from pathlib import Path

import numpy as np
import pytest
from shared import finish

from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.config.bonus import CuriosityBonus, CustomBonus
from mace_rl.config.section import ConfigError
from mace_rl.numerics.finite import NonFiniteError
from mace_rl.runs.checkpoint import archive
from mace_rl.study.config import read_study
from mace_rl.trainer import Trainer

CONFIG = Path(__file__).parents[1] / "config.yaml"
OWN = {"kind": "custom", "estimator": "test_bonuses:Fixed"}


@pytest.mark.parametrize("bonus", [OWN, {"kind": "curiosity", "relevance": False}])
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
    """A user's own: the number of actions, or of numbers in one, at every step."""

    def __init__(self, spaces, generator):
        self.value = float(spaces.action_size)

    def bonus(self, episode):
        return Bonus(np.full(len(episode), self.value))

    def remember(self, episode, returns):
        pass

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def test_a_bonus_of_one_s_own(run_config):
    config = run_config(variant="mace_fixed", bonus=OWN, episodes=3)
    assert config.memory is config.novelty is None
    trainer = finish(config)
    last = trainer.diagnostics[-1]
    assert np.isnan([last.novelty, last.relevance, last.similarity]).all() and last.bonus_share > 0
    assert all(r.intrinsic_return == 2 * r.length for r in trainer.records)
    assert config.references() == {"bonus.estimator": "test_bonuses:Fixed"}
    for value, text in ((-0.5, r"is -0.5, which is not in \[0, 1e\+12\]"), (math.inf, "is inf")):
        trainer = Trainer(config)
        trainer.curiosity.value = value
        with pytest.raises(NonFiniteError, match=f"episode 1: the curiosity bonus {text}"):
            finish(trainer)


# --- The settings -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bonus", "fragment"),
    [
        ("{kind: rnb}", "in variant_settings.x, bonus is {'kind': 'rnb'}, but"),
        ("{kind: rnd}", "'curiosity', 'custom', and extras/ has this one, as kind: custom"),
        ("{kind: curiosity, relevant: 3}", "unknown key 'bonus.relevant' (value 3); the nearest"),
        ("{kind: curiosity, relevance: 1}", "bonus.relevance is 1, but should be a valid boolean"),
        ("{kind: custom}", "the key 'bonus.estimator' is missing"),
        ("{kind: custom, estimator: 'no_such:Thing'}", "bonus.estimator has 'no_such:Thing'"),
        ("null", "the section 'bonus' is missing"),
        (
            "{kind: custom, estimator: 'test_bonuses:Fixed'}, memory: {capacity: 9}",
            "'memory', which a variant with bonus.kind 'custom'",
        ),
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
        "variants: [ppo, mace_fixed, other, alone]\n"
        "variant_settings:\n"
        "  other: {beta: {kind: constant, value: 1.0}, bonus: {kind: custom, arguments: {a: 2}}}\n"
        "  alone: {beta: {kind: constant, value: 1.0}, bonus: {kind: curiosity}}\n"
        "training: {bonus: {kind: custom, estimator: 'test_bonuses:Fixed', arguments: {b: 7}}}\n"
    )
    study = read_study([CONFIG, file])
    bonuses = {v: study.run_config("CartPole-v1", v, 0).bonus for v in study.variants}
    assert bonuses["ppo"] is None
    assert bonuses["other"] == CustomBonus(**OWN, arguments={"a": 2, "b": 7})
    assert bonuses["alone"] == CuriosityBonus(kind="curiosity")
    assert bonuses["mace_fixed"] == CustomBonus(**OWN, arguments={"b": 7})
