"""Curiosity for other agents: what is paid, as by the trainer's own bonus; states."""

import copy
import io
import math

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from gymnasium.spaces import Box, Dict, Text, Tuple, flatdim, flatten
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TransformObservation
from shared import BANDIT, play, step, vector_of
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import mace_rl.environments  # noqa: F401  (registers ours)
from extras.random_beta import RandomBeta
from mace_rl.base.rng import Streams
from mace_rl.beta.controller import BetaController
from mace_rl.beta.objectives import Score
from mace_rl.beta.schedule import Constant
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.config import wrappers
from mace_rl.config.beta import ConstantBeta
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.config.reading import merge, read_yaml
from mace_rl.config.wrappers import CuriosityConfig, defaults
from mace_rl.environments.episode import Episode
from mace_rl.run_settings import read_settings
from mace_rl.runs.checkpoint import archive
from mace_rl.training.factories import meta_adaptation
from mace_rl.wrapping.wrappers import PARTS, CuriosityReward, VectorCuriosityReward

# So small that buffer and memory get full within a test, and replace what they hold.
SMALL = {
    "memory": {"capacity": 60, "write_every": 3},
    "novelty": {"buffer_size": 120, "write_every": 2, "neighbours": [3, 8, 5], "refresh_every": 30},
}
LIMITS = {"low": 0.2, "high": 0.7}
RANDOM = {"kind": "custom", "rule": "extras.random_beta:RandomBeta", "arguments": LIMITS}
SCORE = {"kind": "score", "window": 2, "noise": 2.0, "lag": 30.0, "recent": 100}
OFTEN = {"kind": "meta", "initial": 0.4, "objective": SCORE}  # β is perturbed otherwise
NEXT, SAME, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


class ByEpisodes:
    """What should be paid, computed when an episode is over."""

    def __init__(self, space, size: int, beta: BetaController, seed: int) -> None:
        self.beta = beta
        memory = MemoryConfig(**defaults()["memory"] | SMALL["memory"])
        novelty = NoveltyConfig(**defaults()["novelty"] | SMALL["novelty"])
        self.curiosity = Curiosity(memory, novelty, space, size, Streams(seed))
        self.sums = [[], []]  # discounted, of extrinsic rewards and of bonuses
        self.bonuses = []

    def usual(self, bonus: np.ndarray) -> np.ndarray:
        """m before each step, [T]: of 20 steps the mean, then each weighs 19/20 of the next."""
        found = []
        for value in bonus:
            old = np.array(self.bonuses)
            recent = (19 / 20) ** np.arange(max(len(old) - 20, 0))[::-1] / 20
            first = old[:20].mean() if len(old) else 0.0
            found.append(first * (19 / 20) ** max(len(old) - 20, 0) + old[20:] @ recent)
            self.bonuses.append(value)
        return np.array(found)

    def pay(self, episode: Episode) -> tuple[float, float, np.ndarray, np.ndarray]:
        """β, unit, m of each step, and the bonus with its factors, [T, 3]; then it is kept."""
        bonus = self.curiosity.bonus(episode)
        beta, unit, usual = self.beta.next_beta(), 0.0, self.usual(bonus.reward)
        if self.sums[0]:
            size = math.sqrt((np.square(self.sums[1]).sum() + 100) / (len(self.sums[1]) + 100))
            unit = max(np.std(self.sums[0]), 1.0) / size
        for sums, rewards in zip(self.sums, (episode.rewards, bonus.reward - usual), strict=True):
            for t in range(len(episode)):
                sums.append(sum(0.99 ** (t - k) * rewards[k] for k in range(t + 1)))
        ahead = range(len(episode))
        returns = [sum(0.99 ** (k - t) * episode.rewards[k] for k in ahead[t:]) for t in ahead]
        self.curiosity.remember(episode, np.array(returns))
        self.beta.next_episode(episode, bonus.reward)
        return beta, unit, usual, np.stack(bonus[:3], axis=1)


@pytest.mark.parametrize(
    ("name", "beta"),
    [("CartPole-v1", RANDOM), ("Pendulum-v1", 0.3), ("FrozenLake-v1", RANDOM), ("Taxi-v4", 0.3)],
)
def test_pays_what_the_trainer_s_curiosity_gives_for_whole_episodes(name, beta):
    bare, steps = gymnasium.make(name), 700
    env = CuriosityReward(gymnasium.make(name), beta, seed=5, **SMALL)
    paid = play(env, steps)
    rule = Constant(ConstantBeta(kind="constant", value=0.3))
    if beta == RANDOM:
        rule = RandomBeta(Streams(5)["beta"], **LIMITS)
    space = bare.observation_space
    expected = ByEpisodes(space, flatdim(space), rule, seed=5)
    states, rewards, episodes = [bare.reset(seed=0)[0]], [], 0
    for number in range(steps):
        observation, reward, terminated, truncated, told = step(bare, number)
        states.append(observation)
        rewards.append(float(reward))
        assert set(paid[number][4]) == {*told, *PARTS}
        if not (terminated or truncated):
            continue
        length = len(rewards)
        unknown = np.zeros(length, np.float32)
        vectors = np.float32([flatten(space, state) for state in states])
        episode = Episode(vectors, unknown, unknown, np.array(rewards), terminated)
        beta_now, unit, usual, bonus = expected.pay(episode)
        for t, (_, total, *_, info) in enumerate(paid[number + 1 - length : number + 1]):
            assert info["reward_extrinsic"] == rewards[t] and info["beta"] == beta_now
            found = [info[part] for part in ("curiosity", "novelty", "relevance")]
            np.testing.assert_allclose(found, bonus[t], rtol=1e-4, atol=1e-5)
            added = beta_now * unit * (info["curiosity"] - usual[t])
            assert info["reward_curiosity"] == pytest.approx(added, rel=1e-3, abs=1e-5)
            assert total == info["reward_extrinsic"] + info["reward_curiosity"]
        states, rewards, episodes = [bare.reset()[0]], [], episodes + 1
    assert episodes >= 3
    kept, memory = expected.curiosity.memory, env.tracker.curiosity.memory
    assert (kept.usage == memory.usage).all() and (kept.number == memory.number).all()
    assert (kept.keys == memory.keys).all()


def test_an_episode_that_is_reset_early_is_not_learned_from_if_all_begins_afresh():
    env = CuriosityReward(gymnasium.make("CartPole-v1"), seed=3)
    play(env, 300)
    states = [env.state_dict()]
    one, other = ([item[1] for item in play(env, 3, seed=1)] for _ in range(2))
    assert one == other
    states.append(env.state_dict())
    for state in states:
        del state["recordings"], state["usual"], state["curiosity"]["memory"]["read"]
    assert archive(states[0]) == archive(states[1])


class InParts(TransformObservation):
    """CartPole's observations as a Tuple and a Dict, in which there are texts, too."""

    def __init__(self):
        own, rest = Box(-9e9, 9e9, (1,)), Dict(a=Box(-9e9, 9e9, (2,)), text=Text(9))
        rest["more"] = Tuple([Text(9)])
        space = Dict(p=Tuple([own, own]), rest=rest)
        super().__init__(gymnasium.make("CartPole-v1"), self.parts, space)

    def parts(self, numbers):
        rest = {"a": numbers[2:], "text": "abc", "more": ("de",)}
        return {"p": (numbers[:1], numbers[1:2]), "rest": rest}


@pytest.mark.parametrize("mode", AutoresetMode)
def test_observations_in_parts_earn_what_their_numbers_do(mode):
    flat = VectorCuriosityReward(vector_of("CartPole-v1", 2, mode), RANDOM, seed=2)
    parts = SyncVectorEnv([InParts] * 2, autoreset_mode=mode)
    made = VectorCuriosityReward(parts, RANDOM, seed=2)
    for env in (flat, made):
        env.reset(seed=0)
    for number in range(300):
        (_, paid, *ends, _), (_, own, *_) = (step(env, number) for env in (flat, made))
        np.testing.assert_array_equal(own, paid)
        if mode is DISABLED and (over := np.logical_or(*ends)).any():
            for env in (flat, made):
                env.reset(options={"reset_mask": over})


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1"])
def test_vector_form_of_one_equals_the_single_form(name, mode):
    """However it is reset: where that takes a step of its own, nothing is paid for it."""
    expected = play(CuriosityReward(gymnasium.make(name), RANDOM, seed=2), 300)
    env = VectorCuriosityReward(vector_of(name, 1, mode), RANDOM, seed=2)
    env.reset(seed=0)
    reset = False  # by the next step
    for number, (_, reward, terminated, truncated, info) in enumerate(expected):
        if reset:
            _, paid, *_, told = env.step(np.zeros(1, np.int64))
            assert paid == 0 and not any(told[f"_{part}"] or told[part] for part in PARTS)
        found = step(env, number)
        assert [part[0] for part in found[1:4]] == [reward, terminated, truncated]
        for part in PARTS:
            assert found[4][part] == info[part] and found[4][f"_{part}"]
        ended = terminated or truncated
        reset = ended and mode is NEXT
        if ended and mode is DISABLED:
            env.reset(options={"reset_mask": np.array([True])})


def test_what_one_environment_has_seen_is_known_to_the_others():
    """Three chains side by side, whose episodes of 10 steps end together, one after the other."""
    env = VectorCuriosityReward(vector_of("DeepSea10-v0", 3, SAME))
    assert all(info["novelty"].tolist() == [1, 1, 1] for *_, info in play(env, 10))
    again = step(env, 0)
    count = sum(0.9995**k for k in (1, 2, 3))  # of the state that the first steps led to
    assert again[4]["novelty"] == pytest.approx(np.full(3, 1 / (count + 1)))
    # One step in 10 of these 30, and the last of each episode.
    assert len(env.tracker.curiosity.memory) == 3 + 3


def test_environments_that_end_at_other_times_keep_their_own_episodes(monkeypatch):
    env = VectorCuriosityReward(vector_of("CartPole-v1", 3, NEXT))
    remembered, remember = [], env.tracker.curiosity.remember

    def noted(*given):
        remembered.append(given)
        remember(*given)

    monkeypatch.setattr(env.tracker.curiosity, "remember", noted)
    found = play(env, 300)
    ends = sum(terminated + truncated for _, _, terminated, truncated, _ in found)
    assert (ends > 5).all() and len(remembered) == ends.sum()
    assert len({episode.observations[0].tobytes() for episode, _ in remembered}) == ends.sum()
    for episode, returns in remembered:  # 1 a step: (1 - γ^n) / (1 - γ) with n steps to go
        to_go = np.arange(len(episode), 0, -1)
        np.testing.assert_allclose(returns, (1 - 0.99**to_go) / (1 - 0.99))
        moved = np.diff(episode.observations[:, 0])  # 0.02 s at the velocity before the step
        np.testing.assert_allclose(moved, 0.02 * episode.observations[:-1, 1], atol=1e-6)


def test_a_learned_beta_is_what_the_network_makes_of_the_same_episodes():
    """The network in PyTorch, shown whole episodes one after the other, as by the trainer."""
    env = CuriosityReward(gymnasium.make("CartPole-v1"), "learned", seed=5)
    config, spaces = env.tracker.config, env.tracker.spaces
    network = meta_adaptation(config.beta, config.meta, spaces, "torch", Streams(5))
    draws, betas = np.random.default_rng(0), []
    observation, _ = env.reset(seed=0)
    for _ in range(120):
        expected, states, steps, over = network.next_beta(), [observation], [], False
        while not over:
            action = int(draws.integers(2))
            observation, _, terminated, truncated, info = env.step(action)
            assert info["beta"] == pytest.approx(expected, rel=1e-3)
            states.append(observation)
            steps.append((action, info["reward_extrinsic"], info["curiosity"]))
            over = terminated or truncated
        actions, rewards, bonus = map(np.array, zip(*steps, strict=True))
        unknown = np.full(len(steps), np.nan, np.float32)
        network.next_episode(
            Episode(np.stack(states), actions, unknown, rewards, terminated), bonus
        )
        observation, _ = env.reset()
        betas.append(expected)
    assert np.std(betas[:50]) > 0.01 and betas[0] == pytest.approx(0.4)


@pytest.mark.parametrize("mode", [NEXT, SAME])
def test_what_the_network_learns_of_an_episode_has_its_own_beta(monkeypatch, mode):
    """And perturbation, though others have begun and ended since it was asked for."""
    learned, signs, after = [], [], Score.after_episode

    def noted(objective, played):
        learned.append((played.beta, played.extrinsic_return))
        before = objective.trace
        lesson = after(objective, played)
        signs.append((objective.trace - before) * objective.config.lag + before)
        own = math.log(played.beta / (1 - played.beta)) - math.log(0.4 / 0.6) - played.output
        assert own == pytest.approx(2 * signs[-1], abs=1e-3)
        return lesson

    monkeypatch.setattr(Score, "after_episode", noted)
    env = VectorCuriosityReward(vector_of("CartPole-v1", 3, mode), OFTEN)
    sums, played = np.zeros(3), []
    for _, _, terminated, truncated, info in play(env, 600):
        sums += info["reward_extrinsic"]
        for i in np.flatnonzero(terminated | truncated):
            played.append((info["beta"][i], sums[i]))
            sums[i] = 0
    assert len(played) > 30 and played[0][0] == pytest.approx(0.4)
    # Of the first, which begin before any has ended, β is given.
    assert learned == [one for one in played if one[0] != played[0][0]]


@pytest.mark.filterwarnings("ignore:.*(unwrapped version|infinity|We recommend|we recommend)")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
@pytest.mark.parametrize("played", [0, 450])
def test_checkers_pass(name, played):
    """The warnings let through are about the environment's own spaces, and that it is wrapped."""
    env = CuriosityReward(gymnasium.make(name))
    play(env, played)
    check_env(env)
    sb3_check_env(env)


def test_spec_makes_the_same_again():
    env = CuriosityReward(gymnasium.make("CartPole-v1"), BANDIT, seed=4, **SMALL)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, CuriosityReward)
    np.testing.assert_equal(play(env, 300), play(again, 300))
    while not any(env.step(0)[2:4]):
        pass
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        env.step(0)


@pytest.mark.parametrize("steps", [0, 7, 333])
@pytest.mark.parametrize(
    ("name", "mode", "beta"),
    [
        ("CartPole-v1", None, 0.4),
        ("Pendulum-v1", None, RANDOM),
        ("DeepSea10-v0", None, BANDIT),
        ("CartPole-v1", NEXT, RANDOM),
        ("FrozenLake-v1", SAME, 0.4),
        ("CartPole-v1", None, "learned"),
        ("FrozenLake-v1", NEXT, "learned"),
    ],
)
def test_saved_midway_it_continues_to_the_bit(name, mode, beta, steps):
    """Through a file's bytes; and the state stays as it was while the original goes on."""
    bare = vector_of(name, 3, mode) if mode else gymnasium.make(name)
    form = VectorCuriosityReward if mode else CuriosityReward
    original = form(bare, beta, seed=1, **SMALL)
    play(original, steps)
    state = original.state_dict()
    saved = archive(state)
    restored = form(copy.deepcopy(bare), beta, seed=99, **SMALL)
    restored.load_state_dict(torch.load(io.BytesIO(saved), weights_only=True))
    one, other = (play(env, 400, seed=None, first=steps) for env in (original, restored))
    for first, second in zip(one, other, strict=True):
        np.testing.assert_equal(first[:4], second[:4])
        np.testing.assert_equal(*([item[4][part] for part in PARTS] for item in (first, second)))
    assert archive(original.state_dict()) == archive(restored.state_dict()) != saved
    assert archive(state) == saved
    original.load_state_dict(state)
    play(original, 300)
    assert archive(state) == saved


def test_defaults_are_the_study_s(run_config):
    settings = run_config(variant="mace_fixed").settings()
    config = CuriosityReward(gymnasium.make("CartPole-v1"), seed=np.int64(0)).tracker.config
    sections = {name: settings[name] for name in ("memory", "novelty")}
    assert config == CuriosityConfig(beta=0.4, **sections)
    assert config.discount == settings["ppo"]["discount"]


def test_a_learned_beta_is_that_of_mace_full_wherever_it_is_set(tmp_path, monkeypatch, request):
    path = tmp_path / "config.yaml"
    own = {"meta": {"hidden_units": 48}, "memory": {"neighbours": 3}}
    layers = read_yaml(wrappers.DEFAULTS), {"variant_settings": {"mace_full": own}}
    path.write_text(yaml.safe_dump(merge(*layers)))
    request.addfinalizer(defaults.cache_clear)
    defaults.cache_clear()
    monkeypatch.setattr(wrappers, "DEFAULTS", path)
    config = CuriosityConfig(beta="learned")
    expected = read_settings([path]).run_config("CartPole-v1", "mace_full", 0)
    assert (expected.meta.hidden_units, expected.memory.neighbours) == (48, 3)
    for section in ("memory", "novelty", "meta", "beta"):
        assert getattr(config, section) == getattr(expected, section)
