"""`mace-rl evaluate` and `watch`: an agent plays as at the end of its training."""

import gymnasium
import numpy as np
import pytest
import torch
from shared import GOOD, call

from mace_rl.runs.agent import load_agent
from mace_rl.runs.evaluate import evaluate


def test_an_agent_plays_as_at_the_end_of_its_training(monkeypatch, tmp_path, capsys):
    """Its return is that of its torch modules in the library's own environment."""
    options = GOOD | {"--env": "HopperBulletEnv-v0", "--episodes": "6", "--out": str(tmp_path)}
    assert call(monkeypatch, "train", *sum(options.items(), ())) == (0, "")
    assert call(monkeypatch, "evaluate", str(tmp_path), "--episodes", "3") == (0, "")
    assert capsys.readouterr().out.startswith("3 episodes: mean return ")
    policy, env = load_agent(tmp_path).policy, gymnasium.make("HopperBulletEnv-v0")
    noise = torch.from_numpy(np.random.default_rng(5).standard_normal((1000, 3)))
    env.reset(seed=5)  # an environment's first reset is thrown away
    env.reset(seed=5)
    observation, _ = env.reset()
    total = 0.0
    for row in noise:
        distribution = policy(observation)
        action = (distribution.mean + distribution.stddev * row).detach().clip(-1, 1)
        observation, reward, *ends, _ = env.step(action.float().numpy())
        total += reward
        if any(ends):
            break
    assert evaluate(tmp_path, 1, 5)[0] == pytest.approx(total, rel=1e-3)
    (tmp_path / "agent.pt").write_bytes((tmp_path / "agent.pt").read_bytes()[:-7])
    code, message = call(monkeypatch, "evaluate", str(tmp_path))
    assert code == 1 and "agent.pt" in message and "cut off" in message


@pytest.mark.parametrize("engine", ["compiled", "torch"])
@pytest.mark.parametrize(
    ("environment", "action"),
    [
        ("CartPole-v1", lambda policy: int(policy.probs.argmax())),
        ("HopperBulletEnv-v0", lambda policy: policy.mean.numpy().clip(-1, 1)),
    ],
)
def test_without_chance_an_agent_takes_its_most_probable_actions(
    monkeypatch, tmp_path, environment, action, engine
):
    """As torch's distribution has them, in the library's own environment."""
    options = GOOD | {"--env": environment, "--engine": engine, "--out": str(tmp_path)}
    assert call(monkeypatch, "train", *sum(options.items(), ())) == (0, "")
    policy, env = load_agent(tmp_path).policy, gymnasium.make(environment)
    env.reset(seed=5)  # an environment's first reset is thrown away
    env.reset(seed=5)
    expected = []
    for _ in range(3):
        observation, _ = env.reset()
        expected.append(0.0)
        ends = [False]
        while not any(ends):
            with torch.no_grad():
                chosen = action(policy(observation))
            observation, reward, *ends, _ = env.step(chosen)
            expected[-1] += reward
    assert evaluate(tmp_path, 3, 5, deterministic=True) == pytest.approx(expected, rel=1e-3)
    assert evaluate(tmp_path, 3, 5).tolist() != pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("command", ["evaluate", "watch"])
@pytest.mark.parametrize("folder", ["nope", "unfinished", "a file"])
def test_without_a_finished_run_nothing_is_played(monkeypatch, tmp_path, command, folder):
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "unfinished/checkpoint.pt").touch()
    (tmp_path / "a file").touch()
    path = tmp_path / folder
    expected = f"mace-rl: no finished run in {path}: it has no run.json"
    assert call(monkeypatch, command, str(path)) == (1, expected)
