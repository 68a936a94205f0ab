"""A finished run's agent: torch modules that act as the trainer does, alone or in `evaluate`."""

import json
import shutil

import gymnasium
import numpy as np
import pytest
import torch
from shared import LAYER_NORM, call, finish, likeliest

from mace_rl.config.reading import merge
from mace_rl.config.section import ConfigError
from mace_rl.runs.agent import load_agent
from mace_rl.runs.evaluate import evaluate
from mace_rl.runs.finished import FinishedRun


@pytest.mark.parametrize(
    ("environment", "changes"),
    [
        ("CartPole-v1", {}),
        ("Pendulum-v1", {}),
        ("FrozenLake-v1", {"engine": "torch"}),
        ("Pendulum-v1", {"ppo": {"network": LAYER_NORM}}),
    ],
)
def test_agent_is_torch_modules_that_act_as_the_trainer_does(
    run_config, trained, environment, changes
):
    """From observations as they are; Pendulum's are normalised, and what the critics get."""
    box = environment == "Pendulum-v1"
    changes = merge(changes, {"episodes": 3, "ppo": {"normalise_observations": box}})
    config = run_config(environment, "mace_full", 0, **changes)
    agent = load_agent(trained(environment, "mace_full", **changes), trust=True)
    trainer, rng = finish(config), np.random.default_rng(0)
    space = trainer.environment.observation_space
    space.seed(0)
    rows = np.stack([trainer.environment.encode(space.sample()) for _ in range(50)])
    noise = rng.standard_normal((50, 1)) if box else rng.random(50)
    acting, policy = trainer.ppo.acting_policy(), agent.policy(rows)
    drawn = [acting.act(*pair) for pair in zip(rows, noise, strict=True)]
    actions, log_probs = (np.array(parts) for parts in zip(*drawn, strict=True))
    found = policy.log_prob(torch.from_numpy(actions)).detach()
    np.testing.assert_allclose(found, log_probs, rtol=1e-4, atol=1e-4)
    if box:
        expected = policy.mean + policy.stddev * torch.from_numpy(noise)
        np.testing.assert_allclose(actions, expected.detach(), rtol=1e-4, atol=1e-5)
    else:
        expected = (torch.from_numpy(noise)[:, None] >= policy.probs.cumsum(1)).sum(1)
        assert (actions == expected.numpy()).all()
    one = agent.policy(rows[0]).log_prob(torch.from_numpy(actions)[0])
    torch.testing.assert_close(one, policy.log_prob(torch.from_numpy(actions))[0])
    assert (agent.policy.mean != 0).any() == box
    for kind, critic in trainer.ppo.critics.items():
        values = agent.critics[kind](torch.from_numpy(rows)).detach()
        np.testing.assert_allclose(values[:, 0], critic.outputs(rows)[:, 0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("deterministic", [False, True])
def test_an_agent_plays_as_at_the_end_of_its_training(
    trained, monkeypatch, tmp_path, capsys, deterministic
):
    """Its return is that of its torch modules in the library's own environment."""
    shutil.copytree(trained("HopperBulletEnv-v0", episodes=6), tmp_path, dirs_exist_ok=True)
    policy, env = load_agent(tmp_path).policy, gymnasium.make("HopperBulletEnv-v0")
    noise = np.random.default_rng(5).standard_normal((1000, 3)) * (not deterministic)
    env.reset(seed=5)  # an environment's first reset is thrown away
    env.reset(seed=5)
    observation, _ = env.reset()
    total, ends = 0.0, [False]
    for row in torch.from_numpy(noise):
        with torch.no_grad():
            distribution = policy(observation)
            action = (distribution.mean + distribution.stddev * row).clip(-1, 1)
        observation, reward, *ends, _ = env.step(action.float().numpy())
        total += reward
        if any(ends):
            break
    assert any(ends)
    assert evaluate(tmp_path, 1, 5, deterministic)[0] == pytest.approx(total, rel=1e-3)
    assert evaluate(tmp_path, 1, 5, not deterministic)[0] != pytest.approx(total, rel=1e-3)
    capsys.readouterr()
    assert call(monkeypatch, "evaluate", str(tmp_path), "--episodes", "3") == (0, "")
    assert capsys.readouterr().out.startswith("3 episodes: mean return ")


def test_an_agent_plays_whatever_version_of_the_method_trained_it(trained, tmp_path):
    """What playing does not need may have other settings; what it needs may not."""
    folder = trained("CartPole-v1", episodes=3)
    expected = evaluate(folder, 2, 5)
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    record["config"] |= {"meta": {"hidden_units": 128, "prior": 0.1}, "beta": {"kind": "older"}}
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert (evaluate(tmp_path, 2, 5) == expected).all()
    with pytest.raises(ConfigError, match=r"run\.json: the key .meta\.pretrained"):
        _ = FinishedRun(tmp_path).config
    record["config"]["ppo"]["clpi"] = 0.2
    (tmp_path / "run.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=r"unknown key .ppo\.clpi"):
        evaluate(tmp_path, 2, 5)


def test_without_chance_discrete_actions_are_the_most_probable(trained):
    folder = trained("CartPole-v1", episodes=3, engine="torch")
    expected = likeliest(load_agent(folder).policy, 3, 5)
    assert evaluate(folder, 3, 5, deterministic=True).tolist() == expected
