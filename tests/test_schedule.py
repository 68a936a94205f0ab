"""β by a fixed schedule."""

import math

import pytest

from mace_rl.beta.schedule import ExponentialSchedule
from mace_rl.config.beta import ExponentialBeta


def test_exponential_schedule_by_hand():
    config = ExponentialBeta(kind="exponential", initial=0.4, decay=0.5, floor=0.06)
    schedule = ExponentialSchedule(config)
    betas = []
    for _ in range(6):
        betas.append(schedule.beta)
        schedule.next_episode(None, None)
    assert betas == pytest.approx([0.4, 0.2, 0.1, 0.06, 0.06, 0.06])
    assert not schedule.learns


def test_the_paper_s_schedules_start_where_the_variant_says(run_config):
    for variant, initial in (("mace_fixed", 0.4), ("mace_fixed_0.2", 0.2), ("mace_fixed_0.6", 0.6)):
        schedule = ExponentialSchedule(run_config("CartPole-v1", variant).beta)
        assert schedule.beta == initial
        for _ in range(1000):
            schedule.next_episode(None, None)
        assert schedule.beta == pytest.approx(initial * math.exp(1000 * math.log(0.999)))
        schedule.load_state_dict({"episodes": 100_000})
        assert schedule.beta == 0.01
