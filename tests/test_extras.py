"""The plugins in extras/, loaded as docs/extending.md names them: as a user's own are."""

import io
import math
import re
from pathlib import Path

import gymnasium
import pytest
import torch
import yaml
from shared import call, finish

from mace_rl.config.section import ConfigError
from mace_rl.runs.agent import load_agent
from mace_rl.runs.checkpoint import archive
from mace_rl.runs.provenance import identity
from mace_rl.trainer import Trainer
from mace_rl.wrappers import CuriosityReward

ROOT = Path(__file__).parents[1]
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
    """What two plugins share is code that a run depends on."""
    (tmp_path / "own").mkdir()
    for name in ("__init__", "rule", "shared_part"):
        (tmp_path / "own" / f"{name}.py").touch()
    monkeypatch.chdir(tmp_path)
    beta = {"kind": "custom", "rule": "own.rule:Rule"}
    config = run_config("CartPole-v1", "mace_fixed", beta=beta)
    before = identity(config)["sources"]
    (tmp_path / "own" / "shared_part.py").write_text("x = 1\n")
    assert identity(config)["sources"] != before


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
        (
            "bandit:Bandit",
            BANDIT | {"window": 3},
            "window is 3, .* hold each of the 4 arms",
        ),
    ],
)
def test_wrong_arguments_get_one_line(run_config, plugin, arguments, message):
    section, key = (
        ("beta", "rule") if "be" in plugin or "bandit" in plugin else ("bonus", "estimator")
    )
    entry = {"kind": "custom", key: f"extras.{plugin}", "arguments": arguments}
    config = run_config("CartPole-v1", "mace_fixed", **{section: entry})
    place = f"{section}.{key} has 'extras.{plugin}': arguments: "
    with pytest.raises(ConfigError, match=place + message) as caught:
        Trainer(config)
    assert "\n" not in str(caught.value)
