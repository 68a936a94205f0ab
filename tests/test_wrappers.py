"""Curiosity for other agents: what is paid, as by the trainer's own bonus; β; checkers."""

import io

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Discrete
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from wrapped import BANDIT, ENVIRONMENTS, RANDOM, SMALL, play, step

import mace_rl.environments  # noqa: F401  (registers ours)
from mace_rl import wrappers
from mace_rl.beta.controller import BetaController
from mace_rl.beta.controls import RandomDraw
from mace_rl.bonus.curiosity import Curiosity
from mace_rl.bonus.novelty import Novelty
from mace_rl.config.beta import RandomBeta
from mace_rl.config.bonus import MemoryConfig, NoveltyConfig
from mace_rl.config.wrappers import MEMORY, NOVELTY
from mace_rl.environments.rollout import Episode
from mace_rl.finite import NonFiniteError
from mace_rl.runs.checkpoint import archive
from mace_rl.streams import Streams
from mace_rl.wrappers import CuriosityReward

# --- What is paid -------------------------------------------------------------------------------


class ByEpisodes:
    """What should be paid, computed when an episode is over, as the trainer appraises it."""

    def __init__(self, space, size: int, beta: BetaController | float, seed: int) -> None:
        self.beta = beta
        memory = MemoryConfig(**MEMORY | SMALL["memory"])
        novelty = NoveltyConfig(**NOVELTY | SMALL["novelty"])
        self.curiosity = Curiosity(memory, novelty, "torch", space, size, Streams(seed))
        self.sums = [[], []]  # discounted, of extrinsic rewards and of bonuses

    def pay(self, episode: Episode) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """β, the unit, and the bonus with its factors; then the episode is remembered."""
        bonus = self.curiosity.bonus(episode)
        beta = self.beta if isinstance(self.beta, float) else self.beta.beta
        unit = 0.0
        if self.sums[0]:
            extrinsic, intrinsic = (np.std(sums) for sums in self.sums)
            unit = max(extrinsic, 1.0) / intrinsic
        for sums, rewards in zip(self.sums, (episode.rewards, bonus.reward), strict=True):
            for t in range(len(episode)):
                sums.append(sum(0.99 ** (t - k) * rewards[k] for k in range(t + 1)))
        ahead = range(len(episode))
        returns = [sum(0.99 ** (k - t) * episode.rewards[k] for k in ahead[t:]) for t in ahead]
        self.curiosity.remember(episode, np.array(returns))
        if not isinstance(self.beta, float):
            self.beta.next_episode(episode, bonus.reward)
        return beta, unit, bonus


@pytest.mark.parametrize("beta", [0.3, RANDOM])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_pays_what_the_trainer_s_curiosity_gives_for_whole_episodes(name, beta):
    """From observations and rewards of an environment without a wrapper, episode by episode."""
    bare, steps = gymnasium.make(name), 700
    env = CuriosityReward(gymnasium.make(name), beta, seed=5, **SMALL)
    paid = play(env, steps)
    discrete = isinstance(bare.observation_space, Discrete)
    size = int(bare.observation_space.n) if discrete else bare.observation_space.shape[0]
    rule = beta if beta == 0.3 else RandomDraw(RandomBeta(**RANDOM), Streams(5)["beta"])
    expected = ByEpisodes(bare.observation_space, size, rule, seed=5)

    def vector(state):
        return np.eye(size, dtype=np.float32)[state] if discrete else np.float32(state)

    observation, _ = bare.reset(seed=0)
    states, rewards, episodes = [vector(observation)], [], 0
    for number in range(steps):
        observation, reward, terminated, truncated, _ = step(bare, number)
        states.append(vector(observation))
        rewards.append(float(reward))
        if not (terminated or truncated):
            continue
        length = len(rewards)
        unknown = np.zeros(length, np.float32)
        episode = Episode(np.array(states), unknown, unknown, np.array(rewards), terminated)
        beta_now, unit, bonus = expected.pay(episode)
        for t, (_, total, *_, info) in enumerate(paid[number + 1 - length : number + 1]):
            assert info["reward_extrinsic"] == rewards[t] and info["beta"] == beta_now
            found = [info[part] for part in ("curiosity", "novelty", "relevance")]
            by_episode = [bonus.reward[t], bonus.novelty[t], bonus.relevance[t]]
            np.testing.assert_allclose(found, by_episode, rtol=1e-4, atol=1e-5)
            added = beta_now * unit * info["curiosity"]
            assert info["reward_curiosity"] == pytest.approx(added, rel=1e-4, abs=1e-12)
            assert total == info["reward_extrinsic"] + info["reward_curiosity"]
        observation, _ = bare.reset()
        states, rewards, episodes = [vector(observation)], [], episodes + 1
    assert episodes >= 3
    kept, memory = expected.curiosity.memory, env.appraisal.curiosity.curiosity.memory
    assert (kept.usage == memory.usage).all() and (kept.number == memory.number).all()
    assert (kept.keys == memory.keys).all()


def test_nothing_is_paid_before_the_first_end():
    found = play(CuriosityReward(gymnasium.make("FrozenLake-v1")), 200)
    end = next(number for number, item in enumerate(found) if item[2] or item[3])
    first, later = ([item[4] for item in part] for part in (found[: end + 1], found[end + 1 :]))
    assert all(info["curiosity"] > 0 == info["reward_curiosity"] for info in first)
    assert any(info["reward_curiosity"] > 0 for info in later)


@pytest.mark.parametrize("name", ["CartPole-v1", "DeepSea10-v0"])
def test_without_relevance_the_bonus_is_the_novelty(name):
    env = CuriosityReward(gymnasium.make(name), relevance=False)
    for *_, info in play(env, 300):
        assert info["curiosity"] == info["novelty"] and info["relevance"] == 1
    assert env.appraisal.curiosity.curiosity.memory is None


def test_beta_0_leaves_every_reward_as_it_is():
    bare, env = gymnasium.make("Pendulum-v1"), gymnasium.make("Pendulum-v1")
    for one, other in zip(play(bare, 500), play(CuriosityReward(env, 0), 500), strict=True):
        assert one[1] == other[1] and (one[0] == other[0]).all()


def test_what_the_environment_tells_stays_in_info():
    found = play(CuriosityReward(gymnasium.make("FrozenLake-v1")), 20)
    assert all({*wrappers.PARTS, "prob"} == set(info) for *_, info in found)


@pytest.mark.parametrize("unit", [5.0, 1000.0])
def test_the_bonus_keeps_its_strength_when_the_unit_of_reward_changes(unit):
    """Above the floor of 1; relevance, by the return's place from worst to best, stays too."""

    def scaled(factor):
        return gymnasium.wrappers.TransformReward(
            gymnasium.make("Pendulum-v1"), lambda reward: factor * reward
        )

    one, other = (play(CuriosityReward(scaled(factor)), 1000) for factor in (1.0, unit))
    for (*_, small), (*_, large) in zip(one[200:], other[200:], strict=True):
        assert large["reward_curiosity"] == pytest.approx(unit * small["reward_curiosity"], 1e-3)


def test_an_episode_that_is_reset_early_is_not_learned_from():
    env = CuriosityReward(gymnasium.make("CartPole-v1"), seed=3)
    play(env, 300)
    before = archive(env.state_dict())
    after = []
    for _ in range(2):
        env.reset(seed=1)
        after.append([step(env, number)[1] for number in range(3)])
    assert after[0] == after[1]
    env.reset(seed=1)
    states = [torch.load(io.BytesIO(x)) for x in (before, archive(env.state_dict()))]
    for state in states:
        del state["recordings"], state["curiosity"]["read"]
    assert archive(states[0]) == archive(states[1])


# --- β ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "beta",
    [
        1.0,
        {"kind": "constant", "value": 0.25},
        {"kind": "exponential", "initial": 0.5, "decay": 0.5, "floor": 0.1},
        RANDOM,
        BANDIT,
    ],
)
def test_beta_holds_for_an_episode(beta):
    env = CuriosityReward(gymnasium.make("CartPole-v1"), beta)
    betas, episode = [], set()
    for _, _, terminated, truncated, info in play(env, 400):
        episode.add(info["beta"])
        if terminated or truncated:
            assert len(episode) == 1
            betas.append(episode.pop())
    if beta == 1.0:
        assert set(betas) == {1.0}
    elif beta is RANDOM:
        assert betas == Streams(0)["beta"].uniform(0.2, 0.7, len(betas)).tolist()
    elif beta is BANDIT:
        assert betas[:2] == [0.1, 0.5] and set(betas) == {0.1, 0.5}
    elif beta["kind"] == "exponential":
        assert betas == [max(0.1, 0.5 * 0.5**n) for n in range(len(betas))]


class Learner(BetaController):
    """A rule of the user's own that asks for policy gradients."""

    learns = True
    beta = 0.5

    def __init__(self, generator):
        pass

    def next_episode(self, episode, bonus):
        pass

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


class Obedient(Learner):
    """One that does not; it notes what it is shown."""

    learns = False

    def __init__(self, generator, beta):
        self.beta, self.shown = beta, []

    def next_episode(self, episode, bonus):
        self.shown.append((episode, bonus))


def test_a_rule_of_the_user_s_own_sees_whole_episodes():
    rule = {"kind": "custom", "rule": "test_wrappers:Obedient", "arguments": {"beta": 0.5}}
    env = CuriosityReward(gymnasium.make("Pendulum-v1"), rule)
    found = play(env, 450)
    (first, bonus), (second, _) = env.appraisal.controller.shown
    assert len(first) == len(second) == 200 and not first.terminated
    assert first.actions.shape == (200, 1) and first.actions.dtype == np.float32
    assert bonus.tolist() == [info["curiosity"] for *_, info in found[:200]]
    assert first.rewards.tolist() == [info["reward_extrinsic"] for *_, info in found[:200]]
    assert (first.observations[1:] == [item[0] for item in found[:200]]).all()
    rule["arguments"]["beta"] = 1.5
    with pytest.raises(NonFiniteError, match=r"β is 1\.5"):
        play(CuriosityReward(gymnasium.make("Pendulum-v1"), rule), 1)


class Everything(Novelty):
    """A novelty of the user's own."""

    def __init__(self, size, generator, value):
        self.value = value

    def __call__(self, states):
        return np.full(len(states), self.value)

    def observe(self, states):
        pass

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


def test_a_novelty_of_the_user_s_own_is_asked_for_every_state():
    def settings(value):
        own = {"estimator": "test_wrappers:Everything", "arguments": {"value": value}}
        return {"novelty": {"kind": "custom", **own}, "relevance": False}

    env = CuriosityReward(gymnasium.make("CartPole-v1"), **settings(0.25))
    assert {info["curiosity"] for *_, info in play(env, 100)} == {0.25}
    for value in (1.25, -0.5, np.nan):
        env = CuriosityReward(gymnasium.make("CartPole-v1"), **settings(value))
        with pytest.raises(NonFiniteError, match=f"the curiosity bonus is {value}"):
            play(env, 1)


# --- Gymnasium's and stable-baselines3's rules --------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*(unwrapped version|infinity|We recommend|we recommend)")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "DeepSea10-v0"])
@pytest.mark.parametrize("played", [0, 450])
def test_checkers_pass(name, played):
    """The warnings let through are about the environment's own spaces, and that it is wrapped."""
    env = CuriosityReward(gymnasium.make(name))
    if played:
        play(env, played)
    check_env(env)
    sb3_check_env(env)


def test_spec_makes_the_same_again():
    env = CuriosityReward(gymnasium.make("CartPole-v1"), BANDIT, seed=4, **SMALL)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, CuriosityReward)
    for one, other in zip(play(env, 300), play(again, 300), strict=True):
        np.testing.assert_equal(one, other)


def test_step_before_reset_and_after_the_end_is_an_error():
    env = CuriosityReward(gymnasium.make("CartPole-v1", disable_env_checker=True).unwrapped)
    env.reset(seed=0)
    while not env.step(0)[2]:
        pass
    env.env.steps_beyond_terminated = None  # no warning of the environment's own
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        env.step(0)
