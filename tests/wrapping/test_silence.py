"""What went wrong or got lost in silence: bonuses that punish, what wrappers learn, dark frames.

Each by a small input; the bonus's means are of a random agent and computed here.
"""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import Autoreset, TimeLimit
from shared import Bonanza, play, refused, vector_of

from mace_rl import CuriosityReward, VectorCuriosityReward
from mace_rl.beta.schedule import Constant
from mace_rl.config.beta import ConstantBeta
from mace_rl.config.section import ConfigError
from mace_rl.runs.checkpoint import CheckpointError
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.watch import as_bytes


def alone(name: str) -> CuriosityReward:
    return CuriosityReward(gymnasium.make(name, max_episode_steps=200))


def side_by_side(mode: AutoresetMode) -> VectorCuriosityReward:
    return VectorCuriosityReward(vector_of("FrozenLake-v1", 3, mode))


NAMES = ["FrozenLake-v1", "CliffWalking-v1", "CartPole-v1", "Acrobot-v1", "Taxi-v4"]
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]


@pytest.mark.parametrize(
    ("form", "kind"), [*((alone, name) for name in NAMES), *((side_by_side, own) for own in MODES)]
)
def test_a_random_agent_is_neither_punished_nor_paid_for_its_steps(form, kind):
    added = []
    for _, reward, *_, info in play(form(kind), 5000):
        there = info.get("_beta", True)  # of several, those in which it is no reset
        added += np.extract(there, reward - info["reward_extrinsic"]).tolist()
    mean, size = np.mean(added[1000:]), np.mean(np.abs(added[1000:]))
    assert abs(mean) < 0.1 * size and size > 1e-3


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("name", [None, "FrozenLake-v1", "Blackjack-v1", "DeepSea10-v0"])
def test_the_bonus_begins_at_the_size_of_beta(name, centred):
    """Without a name in episodes of one step."""
    sizes = []
    for seed in range(20):
        made = gymnasium.make(name) if name else TimeLimit(Bonanza(), 1)
        env = CuriosityReward(made, 0.4, seed=seed, centred=centred)
        played = play(env, 100, seed, first=100 * seed)
        sizes += [abs(info["reward_curiosity"]) for *_, info in played]
    assert 0.04 < max(sizes) < 4


class Learns(gymnasium.ObservationWrapper):
    """Shifts observations by what it has seen, and says so, or not, by `offers`."""

    offers = True

    def __init__(self, env):
        super().__init__(env)
        self.shift, self.seen = np.zeros(4), 0.0

    def observation(self, observation):
        self.seen += 1.0
        self.shift = 0.99 * self.shift + 0.01 * observation
        return (observation - self.shift).astype(np.float32)


class Offers(Learns):
    def state_dict(self):
        return {"shift": self.shift.tolist(), "seen": self.seen}

    def load_state_dict(self, state):
        self.shift, self.seen = np.array(state["shift"]), state["seen"]


def plain(state):
    """Its tensors and arrays as lists."""
    return {name: np.asarray(value).tolist() for name, value in state.items()}


@pytest.mark.parametrize(
    ("wrapper", "said"),
    [
        ("gymnasium.wrappers:NormalizeObservation", ""),
        ("gymnasium.wrappers:NormalizeReward", ""),
        ("test_silence:Offers", ""),
        (
            "test_silence:Learns",
            "what test_silence:Learns.* learned in training is not in agent.pt",
        ),
    ],
)
def test_what_a_wrapper_learned_is_there_for_who_plays(trained, caplog, wrapper, said):
    """The wrapper after training and after loading are alike; or a line says that it is not."""
    folder = trained("CartPole-v1", "ppo", 1, episodes=6, environment_wrappers=[wrapper])
    state = torch.load(folder / "agent.pt", weights_only=True).get("environment", {})
    assert state
    from mace_rl.runs.agent import Player
    from mace_rl.runs.finished import FinishedRun

    caplog.clear()
    player = Player.of(FinishedRun(folder, trust=True))
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == bool(said) and all(said.split(".*")[0] in line for line in lines)
    if not said:
        before = plain(player.environment.memory())
        assert before == plain(state)
        evaluate(folder, 2, 0, trust=True)
        if "gymnasium" in wrapper:  # evaluating teaches it nothing
            player.environment.reset()
            assert plain(player.environment.memory()) == before


def test_an_agent_without_such_wrappers_is_what_it_was(trained):
    state = torch.load(trained("CartPole-v1", "ppo", 0, episodes=3) / "agent.pt", weights_only=True)
    assert "environment" not in state


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (np.full((2, 2, 3), 0.5), 128),
        (np.ones((2, 2), bool), 255),
        (np.full((2, 2, 3), 200.0), 200),
        (np.full((2, 2, 3), 7, np.int64), 7),
        (np.full((2, 2), 300), None),
        (np.full((2, 2), np.nan), None),
        (np.full((2, 2), "x"), None),
    ],
)
def test_frames_of_other_numbers_are_scaled_or_refused(frame, expected):
    if expected is None:
        with pytest.raises(ValueError, match="outside 0 to 255"):
            as_bytes(frame)
    else:
        found = as_bytes(frame)
        assert found.dtype == np.uint8 and (found == expected).all()


class Unplain(Constant):
    def __init__(self, generator):
        super().__init__(ConstantBeta(kind="constant", value=0.4))

    def state_dict(self):
        return {"value": np.float64(0.5)}


def test_a_state_that_torch_would_not_read_is_refused_when_it_is_asked_for():
    env = CuriosityReward(
        gymnasium.make("CartPole-v1"), {"kind": "custom", "rule": "test_silence:Unplain"}
    )
    with refused(CheckpointError, "the state.controller.value is"):
        env.state_dict()


class FourValues(Bonanza):
    def step(self, action):
        return super().step(action)[:4]


class WithoutFinal(gymnasium.vector.VectorWrapper):
    def step(self, actions):
        *found, infos = super().step(actions)
        return *found, {key: value for key, value in infos.items() if "final" not in key}


class InfosAsList(gymnasium.vector.VectorWrapper):
    def step(self, actions):
        *found, _ = super().step(actions)
        return *found, [{}, {}]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CuriosityReward(TimeLimit(FourValues(), 9)), "not .observation, reward, term"),
        (lambda: CuriosityReward(Autoreset(Bonanza())), "Autoreset belongs outside"),
        (
            lambda: VectorCuriosityReward(
                WithoutFinal(vector_of("CartPole-v1", 2, AutoresetMode.SAME_STEP))
            ),
            "declares AutoresetMode.SAME_STEP, but .* no 'final_obs'",
        ),
        (
            lambda: VectorCuriosityReward(
                InfosAsList(vector_of("CartPole-v1", 2, AutoresetMode.NEXT_STEP))
            ),
            "gave list as infos",
        ),
    ],
)
def test_borders_get_one_line(make, message):
    with refused(ConfigError, message):
        env = make()
        env.action_space.seed(0)
        env.reset(seed=0)
        for _ in range(100):
            env.step(env.action_space.sample())
