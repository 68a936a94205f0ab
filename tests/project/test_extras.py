"""The plugins in extras/, loaded as docs/extending.md names them, and bonuses of one's own."""

import io
import math
import re
import sys

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from shared import ROOT, call, environment_of, finish, play, refused

from extras.icm import ICM
from mace_rl.base.errors import Refusal
from mace_rl.beta.schedule import Constant
from mace_rl.bonus.flag import FlagNovelty
from mace_rl.bonus.intrinsic import Bonus, IntrinsicReward
from mace_rl.config.agent import CompiledNetwork
from mace_rl.config.bonus import CuriosityBonus, CustomBonus
from mace_rl.config.reading import DEFAULTS
from mace_rl.config.section import ConfigError
from mace_rl.environments.episode import Episode
from mace_rl.numerics.finite import NonFiniteError
from mace_rl.runs import run
from mace_rl.runs.agent import load_agent
from mace_rl.runs.checkpoint import archive
from mace_rl.training.trainer import Trainer
from mace_rl.wrapping.wrappers import CuriosityReward
from mace_study.config.study import read_study

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
ENTRIES = [yaml.safe_load(one) for one in re.findall(r"`(\w+: \{kind: custom.*?extras.*\})`", PAGE)]
BASE = "prediction_error"  # of two of them
ARMS = [0.0, 0.1, 0.4, 1.0]
BANDIT = {"arms": ARMS, "window": 90, "exploration": 1.0, "epsilon": 0.1}


@pytest.mark.parametrize("entry", ENTRIES, ids=str)
@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_training_resumes_to_the_bit(run_config, environment, entry):
    """From the bytes of a checkpoint, in the middle, with several episodes in a rollout."""
    changes = entry | {"episodes": 6, "max_episode_steps": 60, "ppo": {"rollout_steps": 50}}
    config = run_config(environment, "mace_fixed", 3, **changes)
    whole = finish(config)
    assert all(0 < record.intrinsic_return < math.inf for record in whole.records)
    interrupted, resumed = Trainer(config), Trainer(config)
    next(interrupted.run())
    saved = io.BytesIO(archive(interrupted.state_dict()))
    resumed.load_state_dict(torch.load(saved, weights_only=True))
    assert archive(finish(resumed).state_dict()) == archive(whole.state_dict())


def test_the_page_names_every_plugin_and_readers_want_leave(trained, monkeypatch):
    named = {part.get("estimator", part.get("rule")) for one in ENTRIES for part in one.values()}
    files = {path.stem for path in (ROOT / "extras").glob("*.py")} - {"__init__", BASE}
    assert {name.split(":")[0].removeprefix("extras.") for name in named} == files
    run = trained("CartPole-v1", "mace_fixed", episodes=2, **ENTRIES[0])
    assert "code from outside mace_rl" in call(monkeypatch, "evaluate", str(run))[1]
    assert load_agent(run, trust=True)


def test_a_package_counts_as_a_whole(run_config, tmp_path, monkeypatch):
    (tmp_path / "own").mkdir()
    for name in ("__init__", "shared_part"):
        (tmp_path / "own" / f"{name}.py").touch()
    (tmp_path / "own/rule.py").write_text("from test_extras import Noted as Rule")
    monkeypatch.syspath_prepend(tmp_path)
    beta = {"kind": "custom", "rule": "own.rule:Rule"}
    config = run_config("CartPole-v1", "mace_fixed", beta=beta, episodes=1)
    run.run(config, tmp_path / "run")
    (tmp_path / "own" / "shared_part.py").write_text("x = 1\n")
    with refused(Refusal, r"holds a finished run of other code, in own\.rule:Rule"):
        run.run(config, tmp_path / "run")
    (tmp_path / "own" / "__init__.py").write_text("x =\n")
    del sys.modules["own"], sys.modules["own.rule"]
    with refused(ConfigError, "own.rule:Rule', which cannot be imported: SyntaxError: "):
        run.run(config, tmp_path / "run")


def test_a_rule_is_told_when_the_policy_changes(run_config):
    """By trainer and wrapper: each of the bandit's arms in turn, for one rollout."""
    beta = {"kind": "custom", "rule": "extras.bandit:Bandit", "arguments": BANDIT}
    ppo = {"rollout_steps": 50}
    config = run_config("CartPole-v1", "mace_fixed", beta=beta, ppo=ppo, episodes=12)
    rounds = [{record.beta for record in records} for records in Trainer(config).run()]
    assert rounds[:4] == [{arm} for arm in ARMS[: len(rounds)]]
    env = CuriosityReward(gymnasium.make("CartPole-v1"), beta, **ppo)
    steps, arm = 0, 0
    for episode in range(9):
        env.reset(seed=episode)
        over = False
        while not over:
            *_, over, _, told = env.step(0)
            assert told["beta"] == ARMS[arm]
            steps += 1
        if steps >= 50:
            steps, arm = 0, arm + 1
    assert arm == 1


@pytest.mark.parametrize("clips", [True, False])
def test_icm_sees_actions_as_the_environment_took_them(clips):
    environment = environment_of("Pendulum-v1")
    environment.clips_actions = clips
    states, actions = np.zeros((3, 3), np.float32), np.array([[3.0], [-0.5]], np.float32)
    episode = Episode(states, actions, np.zeros(2), np.zeros(2), False)
    found = ICM(environment, np.random.default_rng(0)).inputs(episode)[:, -1]
    assert found.tolist() == [2.0 if clips else 3.0, -0.5]


@pytest.mark.parametrize(
    ("plugin", "arguments", "message"),
    [
        ("icm:ICM", {"forward_weight": 1.5}, "forward_weight is 1.5, but should be less"),
        ("rnd:RND", {"feature_unit": 3}, "unknown key 'feature_unit' .* 'feature_units'"),
        ("rnd:RND", {"learning_rate": "fast"}, "learning_rate is 'fast', but should be a valid"),
        ("hashing:HashCounts", {"bits": 63}, "bits is 63, but should be less than or equal to 62"),
        ("random_beta:RandomBeta", {"low": 0.8, "high": 0.7}, "high is 0.7, .* than low, 0.8"),
        ("random_beta:RandomBeta", {"low": 0.8}, "the key 'high' is missing"),
        ("bandit:Bandit", BANDIT | {"arms": []}, r"arms is \[\], but .* at least 1 item"),
        ("bandit:Bandit", BANDIT | {"arms": [0, 2]}, "arms.1 is 2, but .* less than or equal to 1"),
        ("bandit:Bandit", BANDIT | {"arms": [0, 0]}, r"arms is \[0, 0\], but .* each β once"),
        ("bandit:Bandit", BANDIT | {"window": 3}, "window is 3, .* hold each of the 4 arms"),
    ],
)
def test_wrong_arguments_get_one_line(run_config, plugin, arguments, message):
    bonus = plugin.startswith(("icm", "rnd", "hashing"))
    section, key = ("bonus", "estimator") if bonus else ("beta", "rule")
    entry = {"kind": "custom", key: f"extras.{plugin}", "arguments": arguments}
    config = run_config("CartPole-v1", "mace_fixed", **{section: entry})
    place = f"{section}.{key} has 'extras.{plugin}': arguments: "
    with refused(ConfigError, place + message):
        Trainer(config)


# --- Bonuses of the user's own --------------------------------------------------------------------

OWN = {"kind": "custom", "estimator": "test_extras:Fixed"}


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
    assert config.references() == {"bonus.estimator": "test_extras:Fixed"}
    for value, text in ((-0.5, r"is -0.5, which is not in \[0, 1e\+12\]"), (math.inf, "is inf")):
        trainer = Trainer(config)
        trainer.curiosity.value = value
        with pytest.raises(NonFiniteError, match=f"episode 1: the curiosity bonus {text}"):
            finish(trainer)


class Bare(Fixed):
    def bonus(self, episode):
        return np.ones(len(episode))


def test_a_bonus_that_gives_an_array_is_told_what_to_give(run_config):
    bonus = {"kind": "custom", "estimator": "test_extras:Bare"}
    with refused(ConfigError, r"Bare.bonus is .*, but should be a mace_rl.bonus.intrinsic.Bonus"):
        finish(run_config("CartPole-v1", "mace_fixed", 0, bonus=bonus, episodes=2))


def test_a_variant_s_bonus_goes_over_that_of_training(tmp_path):
    """Of the same kind it changes some keys; of another it leaves nothing of it."""
    file = tmp_path / "over.yaml"
    file.write_text(
        "variants: [ppo, mace_fixed, other, alone]\n"
        "variant_settings:\n"
        "  other: {beta: {kind: constant, value: 1.0}, bonus: {kind: custom, arguments: {a: 2}}}\n"
        "  alone: {beta: {kind: constant, value: 1.0}, bonus: {kind: curiosity}}\n"
        "  third: {beta: {kind: constant, value: 1.0}, bonus: {estimator: 'test_extras:Fixed2'}}\n"
        "  back: {beta: {kind: none}, ppo: {network: {kind: mlp}}}\n"
        "training:\n"
        "  engine: torch\n"
        "  bonus: {kind: custom, estimator: 'test_extras:Fixed', arguments: {b: 7}}\n"
        "  ppo: {network: {kind: torch, module: 'torch.nn:Linear'}}\n"
    )
    study = read_study([DEFAULTS, file])
    bonuses = {v: study.run_config("CartPole-v1", v, 0).bonus for v in study.variants}
    assert bonuses["ppo"] is None
    assert bonuses["other"] == CustomBonus(**OWN, arguments={"a": 2, "b": 7})
    assert bonuses["alone"] == CuriosityBonus(kind="curiosity")
    third = study.run_config("CartPole-v1", "third", 0).bonus
    assert (third.estimator, third.arguments) == ("test_extras:Fixed2", {})
    assert study.run_config("CartPole-v1", "back", 0).ppo.network == CompiledNetwork(kind="mlp")
    assert bonuses["mace_fixed"] == CustomBonus(**OWN, arguments={"b": 7})


RULE = {"kind": "custom", "rule": "test_extras:Noted"}


class Noted(Constant):
    def __init__(self, generator, beta=0.5, learns=False):
        self.beta, self.learns, self.shown = beta, learns, []

    def next_beta(self):
        return self.beta

    def next_episode(self, *shown):
        self.shown.append(shown)


class Everything(FlagNovelty):
    def __init__(self, size, generator, value):
        self.value = float(value)  # NaN is no argument, but as text

    def __call__(self, states):
        return np.full(len(states), self.value)


def test_a_rule_of_the_user_s_own_sees_whole_episodes():
    env = CuriosityReward(gymnasium.make("Pendulum-v1"), RULE)
    found = play(env, 450)
    (first, bonus), (second, _) = env.tracker.controller.shown
    assert len(first) == len(second) == 200 and not first.terminated
    assert first.actions.shape == (200, 1) and first.actions.dtype == np.float32
    assert bonus.tolist() == [info["curiosity"] for *_, info in found[:200]]
    assert first.rewards.tolist() == [info["reward_extrinsic"] for *_, info in found[:200]]
    assert (first.observations[1:] == [item[0] for item in found[:200]]).all()
    env = CuriosityReward(gymnasium.make("Pendulum-v1"), RULE | {"arguments": {"beta": 10.5}})
    with pytest.raises(NonFiniteError, match=r"β is 10\.5"):
        env.reset()


@pytest.mark.parametrize("value", [0.25, 1.25, -0.5, np.nan])
def test_a_novelty_of_the_user_s_own_is_asked_for_every_state(value):
    own = {"estimator": "test_extras:Everything", "arguments": {"value": str(value)}}
    settings = {"novelty": {"kind": "custom", **own}, "relevance": False}
    env = CuriosityReward(gymnasium.make("CartPole-v1"), **settings)
    if value == 0.25:
        assert {info["curiosity"] for *_, info in play(env, 100)} == {0.25}
        assert env.tracker.curiosity.memory is None
        return
    with pytest.raises(NonFiniteError, match=f"the curiosity bonus is {value}"):
        play(env, 1)
