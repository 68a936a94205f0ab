"""What went wrong or got lost in silence: bonuses that punish, replaced studies, learned state.

Each by a small input; the bonus's means are of a random agent and computed here.
"""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import Autoreset, TimeLimit
from PIL import Image
from shared import ROOT, refused, vector_of

from mace_rl import CuriosityReward, VectorCuriosityReward
from mace_rl.beta.schedule import Constant
from mace_rl.config.beta import ConstantBeta
from mace_rl.config.section import ConfigError
from mace_rl.runs.checkpoint import CheckpointError
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.watch import as_bytes, film

WINDOWS = [(1000, 2000), (2000, 5000), (1000, 5000)]


def balance(added: np.ndarray) -> list[float]:
    """The mean over the mean of absolute values, in each window of steps."""
    return [abs(part.mean()) / np.abs(part).mean() for part in (added[a:b] for a, b in WINDOWS)]


@pytest.mark.parametrize(
    "name", ["FrozenLake-v1", "CliffWalking-v1", "CartPole-v1", "Acrobot-v1", "Taxi-v4"]
)
def test_a_random_agent_is_neither_punished_nor_paid_for_its_steps(name):
    env, added = CuriosityReward(gymnasium.make(name, max_episode_steps=200)), []
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(5000):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        added.append(reward - info["reward_extrinsic"])
        if terminated or truncated:
            env.reset()
    assert max(balance(np.array(added))) < 0.1 and np.abs(added).mean() > 1e-3


@pytest.mark.parametrize("mode", AutoresetMode)
def test_nor_are_several_side_by_side(mode):
    env, added = VectorCuriosityReward(vector_of("FrozenLake-v1", 3, mode)), []
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(2000):
        _, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
        added += (rewards - infos["reward_extrinsic"])[infos["_beta"]].tolist()
        if mode is AutoresetMode.DISABLED and (over := terminated | truncated).any():
            env.reset(options={"reset_mask": over})
    assert max(balance(np.array(added))) < 0.1


class OneStep(gymnasium.Env):
    """Two random numbers, then a reward of 0 or 1, and the end."""

    observation_space, action_space = Box(-9, 9, (2,), np.float32), Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.standard_normal(2).astype(np.float32), {}

    def step(self, action):
        state = self.np_random.standard_normal(2).astype(np.float32)
        return state, float(self.np_random.integers(2)), True, False, {}


@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize("name", [None, "FrozenLake-v1", "Blackjack-v1", "DeepSea10-v0"])
def test_the_bonus_begins_at_the_size_of_beta(name, centred):
    sizes = []
    for seed in range(20):
        made = OneStep() if name is None else gymnasium.make(name)
        env = CuriosityReward(made, 0.4, seed=seed, centred=centred)
        env.action_space.seed(seed)
        env.reset(seed=seed)
        episodes = 0
        while episodes < 20:
            _, _, terminated, truncated, info = env.step(env.action_space.sample())
            sizes.append(abs(info["reward_curiosity"]))
            if terminated or truncated:
                episodes += 1
                env.reset()
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
        assert str(player.environment.memory()) == str(state)
        before = str(player.environment.memory())
        evaluate(folder, 2, 0, trust=True)
        if "gymnasium" in wrapper:  # evaluating teaches it nothing
            player.environment.reset()
            assert str(player.environment.memory()) == before


def test_an_agent_without_such_wrappers_is_what_it_was(trained):
    state = torch.load(trained("CartPole-v1", "ppo", 0, episodes=3) / "agent.pt", weights_only=True)
    assert "environment" not in state


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (np.full((2, 2, 3), 0.5), 128),
        (np.ones((2, 2), np.float32), 255),
        (np.ones((2, 2), bool), 255),
        (np.full((2, 2, 3), 200.0), 200),
        (np.full((2, 2, 3), 7, np.int64), 7),
        (np.full((2, 2), 300), None),
        (np.full((2, 2), -0.5), None),
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


class Fractions(OneStep):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def render(self):
        return np.full((20, 20, 3), 0.5)


def test_a_film_of_fractions_is_not_black(trained, register):
    name = register("Fractions-v0", Fractions, 5)
    shown = film(trained(name, "ppo", 0, episodes=3), trust=True)
    grey = np.asarray(shown.pictures[0].resize((9, 9), Image.Resampling.BOX))[1]
    assert np.abs(grey.astype(int) - 128).max() < 3


class Unplain(Constant):
    def __init__(self, generator, value):
        super().__init__(ConstantBeta(kind="constant", value=0.4))
        self.value = np.mean([0.5]) if value == "number" else np.zeros(2)

    def state_dict(self):
        return {"value": self.value}


@pytest.mark.parametrize("value", ["number", "array"])
def test_a_state_that_torch_would_not_read_is_refused_when_it_is_asked_for(value):
    rule = {"kind": "custom", "rule": "test_silence:Unplain", "arguments": {"value": value}}
    env = CuriosityReward(gymnasium.make("CartPole-v1"), rule)
    with refused(CheckpointError, "the state.controller.value is"):
        env.state_dict()


class FourValues(OneStep):
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
        (lambda: CuriosityReward(FourValues()), "not .observation, reward, terminated"),
        (lambda: CuriosityReward(TimeLimit(FourValues(), 9)), "not .observation, reward, term"),
        (lambda: CuriosityReward(Autoreset(OneStep())), "Autoreset belongs outside"),
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


STUDY = """
results: made
environments: [CartPole-v1]
variants: [ppo]
seeds: [0]
training: {{episodes: 3, ppo: {{clip: {clip}}}}}
"""
RUN = "made/runs/CartPole-v1/ppo/seed0"


@pytest.mark.slow
def test_a_study_does_not_replace_the_runs_of_another(tmp_path):
    """Unless that is said; and what is replaced is set aside."""

    def snakemake(clip: float, *words: str, results: str = "made") -> tuple[int, str]:
        (tmp_path / "study.yaml").write_text(STUDY.format(clip=clip))
        command = [sys.executable, "-m", "snakemake", "-j1", "-s", str(ROOT / "Snakefile")]
        target = RUN.replace("made", results) + "/episodes.csv"
        command += [target, "--configfile", "study.yaml", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout + done.stderr

    def clips() -> list[str]:
        records = sorted((tmp_path / RUN).rglob("run.json"))
        return [part.split(",")[0] for r in records for part in r.read_text().split('"clip": ')[1:]]

    assert snakemake(0.2)[0] == 0 and clips() == ["0.2"]
    code, said = snakemake(0.1)
    assert code == 1 and clips() == ["0.2"]
    assert "ppo.clip was 0.2 and is 0.1" in said and "--config results=NAME" in said
    other = "--config", "results=other"
    assert snakemake(0.1, *other, results="other")[0] == 0 and clips() == ["0.2"]
    assert snakemake(0.1, "--config", "replace=true")[0] == 0 and clips() == ["0.2", "0.1"]
    assert snakemake(0.3, "-F")[0] == 0 and sorted(clips()) == ["0.1", "0.2", "0.3"]
