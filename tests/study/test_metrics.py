"""Metrics on curves whose answers are known by hand, and against loops."""

from decimal import ROUND_CEILING, Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from invented import QUICK, averages, curve, noisy

from mace_rl.config.section import ConfigError
from mace_study.measure import metrics as m


def ramp(flat_before, rise, flat_after):
    """0, …, 0, 1, 2, …, rise, rise, …"""
    return [0] * flat_before + list(range(1, rise + 1)) + [rise] * flat_after


LUCKY = [0, 10, 75, 20, 74, 100, 100, 100, 100, 100]
NEGATIVE = [-500, -200, *[-85] * 18]  # 75 % of -85 is -63.75
# Window 2: averages of pairs 0, .5, 1, 5, 9, 9.5, 9, 8, 8.5 (t = 2, …) and slopes
# (m_t - m_{t-2}) / 2 of .5, 2.25, 4, 2.25, 0, -.75, -.25 (t = 4, …).
PEAK = [0, 0, 1, 1, 9, 9, 10, 8, 8, 9]
COLLAPSE = [*ramp(0, 300, 300), *[0] * 50, *[300] * 600]
LATE = [0] * 30 + [100] * 70  # window 10: 8 of 10 episodes at 100 are above 75
WORSE = [0] * 20 + [60] * 80
SMALL, WIDE = {"random": 0, "moving_average": 2}, {"moving_average": 10}
BAR = {"random": 0, "goals": (100.0,)} | WIDE
# From -500 to -100 with random -500: the bar is -200. Window 10: the average of k episodes at -100
# and 10 - k at -500 is -500 + 40 k, so 8 of them reach it.
RISE = ([-500] * 30 + [-100] * 70, {"random": -500} | WIDE)

CASES = [  # metric, returns, the curve's settings, episode, censored
    (m.sample_efficiency, LUCKY, {"final": 100}, 3, False),  # a single episode is enough
    (m.sample_efficiency, NEGATIVE, {}, 20, True),  # the bar lies above the final return
    (m.sample_efficiency, [*NEGATIVE[:4], -63.75, *NEGATIVE[5:]], {"final": -85}, 5, False),
    (m.sample_efficiency, [0, 0, 1], {"final": 1}, 3, False),  # the last is not too late
    # Both windows of 50 are flat at episode 300 + 99. The slope is 1 while both are on the ramp; k
    # episodes into the flat part the difference between them has lost k (k + 1) / 2 of 2500, and
    # then 2500 - (99 - k)(100 - k) / 2: a tenth is left at k = 78.
    (m.convergence_steps, ramp(0, 300, 1000), {"random": 0}, 378, False),
    (m.convergence_steps, ramp(200, 100, 1000), {"random": 0}, 378, False),  # not the flat start
    (m.convergence_steps, COLLAPSE, {"random": 0}, 378, False),
    (m.convergence_steps, np.ones(300), {"random": 0}, 100, False),  # there from the beginning
    (m.convergence_steps, PEAK, SMALL, 8, False),  # 75 % of the final 9 is reached at t = 6
    (m.convergence_steps, PEAK, SMALL | {"convergence_slope": 0.6}, 7, False),  # 2.25 ≤ 0.6 · 4
    (m.convergence_steps_public_code, np.ones(2000), {}, 586, False),  # its floor
    (m.convergence_steps_public_code, np.ones(60), {}, 60, True),
    (m.sample_efficiency_range, *RISE, 38, False),
    (m.sample_efficiency_range, [*[0] * 20, 100, *[0] * 29, *[100] * 50], BAR, 58, False),
    (m.sample_efficiency_range, WORSE, BAR, 28, False),  # a bar that falls with the end
    (m.sample_efficiency_common, LATE, BAR, 38, False),
    (m.sample_efficiency_common, WORSE, BAR, 100, True),  # one bar for all does not
    (m.sample_efficiency_common, LATE[::-1], BAR, 10, False),  # reached is reached
]


@pytest.mark.parametrize("case", CASES)
def test_an_episode_by_hand(case):
    metric, returns, how, episode, censored = case
    assert metric(curve(returns, **how)) == (episode, censored)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_every_reading_against_loops(seed):
    returns, window, random = noisy(seed), 25, -3.0
    average, final = averages(returns, window), np.mean(returns[-40:])
    before = {t: average[t - window] for t in average if t - window in average}
    slopes = {t: round(average[t] - before[t], 9) for t in before}
    run = curve(returns, random=random, moving_average=window)
    bar, fifty = random + 0.75 * (final - random), [*averages(returns, 50).values()]

    def first(episodes):
        found = next(iter(episodes), None)
        return found or 400, found is None

    expected = {
        m.sample_efficiency_range: first(t for t in average if average[t] >= bar),
        m.convergence_steps: first(
            t
            for t in slopes
            if any(average[u] >= bar for u in average if u <= t)
            and slopes[t] <= 0.1 * max(slopes[u] for u in slopes if u <= t)
        ),
        m.convergence_steps_public_code: first(
            i + 1 for i in range(105, 301) if abs(fifty[i + 50] - fifty[i]) / 50 < 0.05
        ),
    }
    assert {metric: metric(run) for metric in expected} == expected


@pytest.mark.parametrize("fraction", ["0.1", "0.07"])
def test_the_last_part_is_rounded_up_in_decimal(fraction):
    """In doubles, 0.07 · 100 is 7.000000000000001, which would round up to 8 episodes."""
    for episodes in range(1, 101):
        last = int((Decimal(fraction) * episodes).to_integral_value(ROUND_CEILING))
        returns = 2.0 ** -np.arange(episodes)
        assert m.final_return(returns, float(fraction)) == np.mean(returns[episodes - last :])
    assert m.final_return(np.arange(20.0), 0.1) == 18.5  # of 18 and 19
    assert m.early_return(curve(np.arange(40))) == 1.5  # of 0 to 3
    assert m.solved(curve(np.arange(40), None, 0.0, (np.nan, 37.0))) == 0.75  # 36 to 39


READINGS = [m.sample_efficiency, m.sample_efficiency_range, m.convergence_steps]


@pytest.mark.parametrize("metric", READINGS)
def test_a_run_no_better_than_random_reaches_nothing(metric):
    returns = [-20] * 40 + [0] * 160
    for random in (0.0, 1.0):  # 75 % of 0 is reached in episode 41
        assert metric(curve(returns, random=random)) == (200, True)
    assert not metric(curve(returns, random=-1.0)).censored


def test_better_than_random_is_more_than_two_standard_errors():
    returns = [0] * 180 + [2, 0] * 10  # the last 20: mean 1, error 1 / √20
    assert curve(returns, random=1 - 2.01 / np.sqrt(20)).learned
    assert not curve(returns, random=1 - 1.99 / np.sqrt(20)).learned


def test_moving_averages_of_equal_windows_are_equal_to_the_bit():
    assert len(set(m.moving_average(np.full(1000, 0.1), 50).tolist())) == 1
    assert len(m.moving_average(np.ones(49), 50)) == 0
    found = dict(enumerate(m.moving_average(noisy(0), 25), start=25))
    assert found == pytest.approx(averages(noisy(0), 25))


@pytest.mark.parametrize(
    ("episodes", "count"), [(20, 4), (49, 4), (50, 2), (99, 2), (101, 1), (120, 1), (121, 0)]
)
def test_what_a_short_training_cannot_reach_is_known_before(episodes, count):
    """Not even one that is good from the beginning, or once it has risen."""
    good = np.full(episodes, 500.0)
    found = [curve(own, random=-1e4, goals=(500.0,)) for own in (good, np.r_[-1e4, good[1:]])]
    counted = [one for one in m.all_metrics(QUICK) if one.unit == "episodes"]
    never = [one.name for one in counted if all(one.function(run).censored for run in found)]
    assert m.out_of_reach(QUICK, episodes) == never
    assert len(never) == count


def late(given: m.LearningCurve) -> float:
    return float((given.returns >= given.solved).mean())


NEEDY = m.Metric("late", "Late", "share", late, "solved_return")
ODD = m.Metric("odd", "Odd", "share", late, "solved_returns")


def test_a_metric_of_the_user_s_own_is_left_out_without_its_goal_too():
    own = {"custom": ["test_metrics:NEEDY"]}
    for goal in ({}, {"solved_return": {"CartPole-v1": 475.0}}):
        found = m.all_metrics(QUICK.model_copy(update=own | {"solved_return": {}} | goal))
        assert (NEEDY in found) == bool(goal)
    with pytest.raises(ConfigError, match="needs 'solved_returns', but should need"):
        m.all_metrics(QUICK.model_copy(update={"custom": ["test_metrics:ODD"]}))
