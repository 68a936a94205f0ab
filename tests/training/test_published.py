"""The world of the public code: `trainer: published`; and what `config/plain.yaml` asks of ours."""

import copy
import re
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from shared import learned, refused
from torch.nn import functional

from mace_rl import published
from mace_rl.config.published import PublishedConfig
from mace_rl.config.section import ConfigError
from mace_rl.environments.episode import Episode
from mace_rl.library import settings
from mace_rl.published import PublishedTrainer
from mace_rl.runs import run
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.finished import FinishedRun
from mace_rl.runs.verify import repeat
from mace_rl.training.experience import Rollout
from mace_rl.training.trainer import Trainer

CONFIG = Path(__file__).parents[2] / "config"
BOX = "MountainCarContinuous-v0"  # which has actions beyond their bounds cost something
SHARED = ("normalise_returns", "clip_actions")  # settings of ppo


def make(environment="CartPole-v1", variant="mace_full", world="published", **changes):
    changes = {"episodes": 4, "max_episode_steps": 25} | changes
    return settings(environment, variant, config=CONFIG / f"{world}.yaml", **changes)


def outcome(config):
    trainer = (PublishedTrainer if config.trainer else Trainer)(config)
    assert sum(len(round_) for round_ in trainer.run()) == config.episodes
    return str([trainer.records, trainer.diagnostics])


@pytest.mark.parametrize("environment", ["CartPole-v1", BOX])
def test_an_update_is_the_plain_formula(environment):
    trainer = PublishedTrainer(make(environment, "ppo", published={"dropout": False}))
    [item] = rollout = trainer.collect()
    episode = item.episode
    actor, critic = copy.deepcopy((trainer.ppo.actor, trainer.ppo.critic))
    trainer.ppo_update(rollout)

    returns = torch.zeros(len(episode))
    for t in range(len(episode)):
        returns[t] = sum(0.99**k * r for k, r in enumerate(episode.rewards[t:].tolist()))
    returns = (returns - returns.mean()) / (returns.std() + 1e-7)
    states, actions = map(torch.from_numpy, (episode.observations[:-1], episode.actions))

    def value(state):  # over a sequence of one, attention is what it makes of the value
        features, attention = critic.backbone(state) + critic.around(state), critic.attention
        weight, bias = attention.in_proj_weight[256:], attention.in_proj_bias[256:]
        return critic.head(attention.out_proj(functional.linear(features, weight, bias)))[:, 0]

    def policy(state):
        if environment == "CartPole-v1":
            return torch.distributions.Categorical(actor(state).softmax(-1))
        return torch.distributions.MultivariateNormal(actor(state), torch.tensor([[0.36]]))

    old = policy(states).log_prob(actions).detach()
    assert torch.allclose(old, torch.from_numpy(episode.log_probs), atol=1e-5)
    parts = [
        {"params": actor.parameters(), "lr": 3e-4},
        {"params": critic.parameters(), "lr": 1e-3},
    ]
    adam = torch.optim.Adam(parts)
    for _ in range(4):
        now, said = policy(states), value(states)
        ratio, advantage = (now.log_prob(actions) - old).exp(), returns - said.detach()
        worse = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
        error = functional.mse_loss(said, returns)
        adam.zero_grad()
        (0.5 * error - worse.mean() - 0.01 * now.entropy().mean()).backward()
        adam.step()
    for mine, plain in ((trainer.ppo.actor, actor), (trainer.ppo.critic, critic)):
        for left, right in zip(mine.parameters(), plain.parameters(), strict=True):
            assert torch.allclose(left, right, atol=5e-5)  # Adam lifts what rounds to nearly 0


def test_the_bonus_of_ten_steps_by_hand(monkeypatch):
    monkeypatch.setattr(published, "CAPACITY", 3)
    spaces = SimpleNamespace(observation_size=1, action_space=gymnasium.spaces.Discrete(2))
    curiosity = published.PublishedCuriosity(PublishedConfig(), spaces)
    states = np.array([[0], [1], [3], [0], [3.25], [7], [7], [1], [0.5], [5], [0]], np.float32)
    rewards = np.array([1, 1, -2, 0, 1, -1, 1, 1, 1, 0.0])
    actions, log_probs = np.zeros(10, np.int64), np.zeros(10, np.float32)
    bonus = curiosity.bonus(Episode(states, actions, log_probs, rewards, True))
    # The nearest one of: none; 0; 0 1; 0 1 3; 0 0 3; 3.25 0 3; 3.25 7 3; 3.25 7 7; 1 7 7; 1 0.5 7.
    relevance = [1, 1, 1 / 2, 1e6, 4, 1 / 3.75, 1e6, 1 / 2.25, 2, 1 / 2]
    assert bonus.relevance == pytest.approx(relevance, rel=1e-5)
    # The fourth, seventh and eighth state come a second time: 1/3, not 1/2. Then times |r|, or 0.1.
    reward = [1 / 2, 1 / 2, 2 / 4, 0.1, 1, 1 / 7.5, 1, 1 / 6.75, 1, 0.1 / 4]
    assert bonus.reward == pytest.approx(reward, rel=1e-5)
    assert curiosity.keys.tolist() == [[1], [0.5], [5]]
    assert curiosity.usage.tolist() == [11, 12, 13]


def test_beta_is_set_every_tenth_episode():
    trainer = PublishedTrainer(make(variant="mace_fixed", episodes=23, max_episode_steps=2))
    betas = [record.beta for [record] in trainer.run()]
    wanted = [0.4] * 11 + [0.4 * 0.999**10] * 10 + [0.4 * 0.999**20] * 2
    assert betas == pytest.approx(wanted, rel=1e-5)


CASES = [("published", "published", name) for name in PublishedConfig.model_fields]
CASES += [(world, "ppo", name) for world in ("published", "plain") for name in SHARED]


@pytest.mark.parametrize(("world", "section", "name"), CASES)
def test_each_named_setting_changes_a_result(monkeypatch, world, section, name):
    monkeypatch.setattr(published, "CAPACITY", 20)
    box = name in (*SHARED, "bonus_times_reward", "novelty_buffer_fills")
    environment = BOX if box else "CartPole-v1"
    now = make(environment, world=world)
    change = {section: {name: not getattr(getattr(now, section), name)}}
    assert outcome(now) != outcome(make(environment, world=world, **change))


@pytest.mark.parametrize("environment", ["CartPole-v1", BOX])
def test_it_resumes_and_repeats_to_the_bit(
    tmp_path, monkeypatch, checkpoint_every, completes, environment
):
    monkeypatch.setattr(published, "CAPACITY", 20)
    monkeypatch.setattr(run, "PROGRESS_SECONDS", 0.0)
    config, folder = make(environment, published={"novelty_buffer_fills": True}), tmp_path / "run"

    def interrupt(progress):
        if progress["episode"] == 2:
            raise KeyboardInterrupt

    checkpoint_every(1)
    with pytest.raises(KeyboardInterrupt):
        run.run(config, folder, interrupt)
    (interruption,) = completes(config, folder)["interruptions"]
    assert interruption["after_episode"] > 0 and interruption["environment_replayed"]
    assert repeat(FinishedRun(folder))[0]
    first, again = (evaluate(folder, 2, 7) for _ in range(2))
    assert first.tolist() == again.tolist()


BOOTSTRAPPED = {"bootstrap_at_time_limit": True, "normalise_returns": False}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"engine": "compiled"}, ["engine is 'compiled'", '"torch"']),
        ({"ppo": {"max_gradient_norm": 0.5}}, ["ppo.max_gradient_norm is 0.5", "null"]),
        ({"ppo": BOOTSTRAPPED}, ["bootstrap_at_time_limit is True", "false"]),
        ({"bonus": {"kind": "curiosity"}}, ["bonus is ", "null", "trainer: published"]),
        ({"beta": {"kind": "custom", "rule": "a:B"}}, ["beta.kind is 'custom'"]),
        ({"trainer": None}, ["published is ", "null"]),
    ],
)
def test_what_it_would_ignore_is_refused(changes, words):
    with refused(ConfigError, re.escape(words[0])) as caught:
        make(**changes)
    assert all(word in str(caught.value) for word in words)


def test_what_its_network_does_not_learn_is_refused_where_it_is_asked_for():
    with pytest.raises(ConfigError, match="objective is 'evidence'"):
        PublishedTrainer(make(beta=learned()))


@pytest.mark.parametrize("engine", ["compiled", "torch"])
def test_plain_ppo_keeps_its_deviation_and_normalises_the_total_return(engine):
    trainer = Trainer(make(BOX, "mace_fixed", "plain", engine=engine))
    [item] = trainer.collect()
    assert abs(item.episode.actions).max() < 10
    total = item.extrinsic.returns + item.beta * item.intrinsic.returns
    assert total.mean() == pytest.approx(0) and total.std(ddof=1) == pytest.approx(1)
    before = trainer.ppo.policy.parameters.copy()
    trainer.ppo_update(Rollout([item]))
    assert trainer.ppo.policy.log_std.tolist() == pytest.approx([np.log(0.6)])
    assert not np.array_equal(before, trainer.ppo.policy.parameters)
