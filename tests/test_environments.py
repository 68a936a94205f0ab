"""Environments outside the paper train from configuration alone: config/environments.yaml."""

from pathlib import Path

import numpy as np
import pytest
from shared import finish

from mace_rl.config.study import read_study

ROOT = Path(__file__).parents[1]
STUDY = read_study([ROOT / "config.yaml", ROOT / "config" / "environments.yaml"])
PAPER = {"Acrobot-v1", "CartPole-v1", "HopperBulletEnv-v0"}


def test_they_are_twelve_and_not_the_paper_s():
    assert len(STUDY.environments) == 12 and not PAPER & set(STUDY.environments)
    assert {STUDY.run_config(*run).episodes for run in STUDY.runs()} == {20}
    assert sum("Bullet" in name for name in STUDY.environments) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("run", STUDY.runs(), ids=lambda run: f"{run[0]}-{run[1]}")
def test_trains(run):
    config = STUDY.run_config(*run)
    records = finish(config).records
    assert len(records) == 20
    numbers = np.array([(one.extrinsic_return, one.intrinsic_return) for one in records])
    assert np.isfinite(numbers).all()
    betas = {one.beta for one in records}
    assert betas == {0.0} if config.variant == "ppo" else len(betas) > 1
