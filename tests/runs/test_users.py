"""What users bring works: environments without limits, actions of any kind, wrappers by name."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, MultiBinary, MultiDiscrete
from shared import call, finish, provenance_of, refusal, refused

from mace_rl import CuriosityReward
from mace_rl.config.plugins import call_of
from mace_rl.config.section import ConfigError
from mace_rl.environments import environment as environments
from mace_rl.runs.agent import load_agent
from mace_rl.runs.evaluate import evaluate

SPACES = {
    "MultiDiscrete": MultiDiscrete([3, 2]),
    "MultiBinary": MultiBinary(3),
    "Matrix": Box(-1, 1, (2, 2), np.float32),
    "Scalar": Box(-1, 1, (), np.float32),
}


class Copies(gymnasium.Env):
    """Pays for each part of an action that is its largest choice, or number above 0; 8 steps."""

    observation_space = Box(-1, 1, (2,), np.float32)

    def __init__(self, kind):
        self.action_space = SPACES[kind]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        best = getattr(self.action_space, "nvec", 2) - 1
        right = action > 0 if isinstance(self.action_space, Box) else action == best
        return np.zeros(2, np.float32), float(np.mean(right)), self.steps == 8, False, {}


@pytest.mark.parametrize("engine", ["compiled", "torch"])
@pytest.mark.parametrize("kind", SPACES)
def test_actions_of_every_kind_are_learned(run_config, register, kind, engine):
    name = register("Copies-v0", Copies, None, kind=kind)
    settings = {"actor_learning_rate": 0.003, "initial_log_std": -1.0, "rollout_steps": 32}
    changes = {"episodes": 250, "engine": engine, "ppo": settings | {"entropy_coefficient": 0.02}}
    records = finish(run_config(name, "mace_full", 0, **changes)).records
    returns = [record.extrinsic_return for record in records]
    first, last = np.mean(returns[:20]), np.mean(returns[-20:])
    assert last > first + 2


@pytest.mark.parametrize("kind", SPACES)
def test_who_plays_with_such_an_agent_gets_such_actions(trained, register, kind):
    name = register(f"Copies{kind}-v0", Copies, None, kind=kind)
    folder = trained(name, "mace_fixed", 0, episodes=3)
    assert len(evaluate(folder, 2, 0, trust=True)) == 2
    returns = evaluate(folder, 2, 0, deterministic=True, trust=True)
    assert returns[0] == returns[1]
    policy = load_agent(folder, trust=True).policy
    distribution = policy(np.zeros((4, 2)))
    actions = distribution.sample()
    assert actions.shape[0] == 4 and distribution.log_prob(actions).shape == (4,)
    env = CuriosityReward(gymnasium.make(name))
    env.reset(seed=0)
    for _ in range(8):
        env.step(env.action_space.sample())


def test_an_environment_that_ends_by_itself_needs_no_limit(run_config, register):
    assert len(finish(run_config("Blackjack-v1", "mace_fixed", 0, episodes=20)).records) == 20
    name = register("Copies-v0", Copies, None, kind="MultiBinary")
    assert {r.length for r in finish(run_config(name, "ppo", 0, episodes=5)).records} == {8}


def test_one_that_does_not_end_is_told_after_many_steps(run_config, monkeypatch):
    monkeypatch.setattr(environments, "UNLIMITED", 50)
    with refused(ConfigError, "goes on after 50 steps: in training --max-episode-steps"):
        finish(run_config("CliffWalking-v1", "ppo", 0, episodes=5))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("m:C", ("m:C", {})),
        ("m:C()", ("m:C", {})),
        (
            'm:C(a=["x"], b=(1, 2), c=-0.5, d=None)',
            ("m:C", {"a": ["x"], "b": (1, 2), "c": -0.5, "d": None}),
        ),
        *(
            (wrong, None)
            for wrong in ("m:C(1)", "m:C(a=f())", "m:C(a=1", "m:C(**{})", "m:C(a=b)", "C(a=1)(b=2)")
        ),
        *((wrong, None) for wrong in ("m:C(a={[1]: 2})", "m:C(a=1, a=2)")),
    ],
)
def test_arguments_by_name_are_literals(text, expected):
    if expected is None:
        with pytest.raises(ValueError, match="it should be a name"):
            call_of(text)
    else:
        assert call_of(text) == expected


def test_arguments_on_the_command_line(monkeypatch, tmp_path):
    words = ["train", "--variant", "ppo", "--episodes", "2", "--out", str(tmp_path / "run")]
    env = "FrozenLake-v1(is_slippery=False)"
    reshaped = "gymnasium.wrappers:ReshapeObservation(shape=[2, 2])"
    assert call(monkeypatch, *words, "--env", env)[0] == 0
    config = provenance_of(tmp_path / "run")["config"]
    assert config["environment"] == "FrozenLake-v1"
    assert config["environment_arguments"] == {"is_slippery": False}
    words[-1] = str(tmp_path / "other")
    assert call(monkeypatch, *words, "--env", "CartPole-v1", "--wrapper", reshaped)[0] == 0
    kept = provenance_of(tmp_path / "other")["config"]["environment_wrappers"]
    assert kept == [
        {"wrapper": "gymnasium.wrappers:ReshapeObservation", "arguments": {"shape": [2, 2]}}
    ]
    said = refusal(monkeypatch, *words, "--env", "CartPole-v1(x)")
    assert "--env is 'CartPole-v1(x)', but it should be a name" in said
