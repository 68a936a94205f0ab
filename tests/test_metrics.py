"""Metrics on curves whose answers are known by hand, and against plain loops."""

from decimal import ROUND_CEILING, Decimal

import numpy as np
import pandas as pd
import pytest
from invented import CONFIG, noisy

from mace_rl.results import metrics as m


def ramp(flat_before, rise, flat_after):
    """0, …, 0, 1, 2, …, rise, rise, …"""
    return np.concatenate(
        [np.zeros(flat_before), np.arange(1.0, rise + 1), np.full(flat_after, float(rise))]
    )


def curve(returns, final=None, random=-1e9, goals=(), **settings):
    """What a metric gets; settings that are not given are those above."""
    returns, changed = np.asarray(returns), CONFIG.model_copy(update=settings)
    final = m.final_return(returns, 0.1) if final is None else final
    return m.LearningCurve(returns, final, random, changed, *goals)


def averages(returns, window):
    """Moving averages by episode number (from 1), from pandas."""
    rolling = pd.Series(returns).rolling(window).mean()
    return {t + 1: value for t, value in enumerate(rolling) if not np.isnan(value)}


def test_final_return_by_hand():
    assert m.final_return(np.arange(20.0), 0.1) == 18.5  # of 18 and 19
    assert m.final_return(np.arange(2000.0), 0.1) == np.mean(range(1800, 2000))
    assert m.final_return(np.array([1.0, 5.0]), 0.1) == 5
    assert m.final_return(np.array([1.0, 5.0]), 1.0) == 3


@pytest.mark.parametrize("fraction", ["0.1", "0.07"])
def test_the_last_part_is_rounded_up_in_decimal(fraction):
    """In doubles, 0.07 · 100 is 7.000000000000001, which would round up to 8 episodes."""
    for episodes in range(1, 101):
        last = int((Decimal(fraction) * episodes).to_integral_value(ROUND_CEILING))
        returns = 2.0 ** -np.arange(episodes)
        assert m.final_return(returns, float(fraction)) == np.mean(returns[episodes - last :])


def test_sample_efficiency_is_the_first_single_episode():
    returns = np.array([0, 10, 75, 20, 74, 100, 100, 100, 100, 100.0])
    assert m.sample_efficiency(curve(returns, final=100)) == (3, False)
    assert m.sample_efficiency(curve(returns, final=100, threshold=0.751)) == (6, False)


def test_sample_efficiency_bar_of_negative_returns_lies_above_the_final_return():
    returns = np.array([-500.0, -200.0, *[-85.0] * 18])
    assert m.sample_efficiency(curve(returns, final=-85)) == (20, True)  # the bar is -63.75
    returns[4] = -63.75
    assert m.sample_efficiency(curve(returns, final=-85)) == (5, False)
    # The last episode is not too late.
    assert m.sample_efficiency(curve([0.0, 0.0, 1.0], final=1)) == (3, False)


def test_convergence_is_where_a_ramp_has_left_both_windows_and_not_the_flat_start():
    # Flat from episode 300 on: both windows of 50 are flat at episode 300 + 99. The slope of
    # the average is 1 while both are on the ramp; k episodes into the flat part the difference
    # between them has lost k (k + 1) / 2 of 2500, and then 2500 - (99 - k)(100 - k) / 2.
    for flat_before in (0, 200):
        rise = curve(ramp(flat_before, 300 - flat_before, 1000), random=0)
        assert m.convergence_steps_steepest(rise) == (399, False)
        k = next(k for k in range(50, 100) if (99 - k) * (100 - k) / 2 <= 250)
        assert m.convergence_steps(rise) == (300 + k, False)
    assert m.convergence_steps_flattest(rise) == (100, False)  # the literal reading takes the start


def test_convergence_at_the_first_peak_after_the_steepest_rise():
    # Window 2: averages of pairs, slopes (m_t - m_{t-2}) / 2 for t = 4, 5, …
    returns = np.array([0, 0, 1, 1, 9, 9, 10, 8, 8, 9.0])
    averages_by_hand = [0, 0.5, 1, 5, 9, 9.5, 9, 8, 8.5]  # t = 2, …, 10
    slopes_by_hand = [0.5, 2.25, 4, 2.25, 0, -0.75, -0.25]  # t = 4, …, 10
    assert m.moving_average(returns, 2).tolist() == averages_by_hand
    assert m.slope(returns, 2).tolist() == slopes_by_hand
    run = curve(returns, random=0, moving_average=2)  # 75 % of the final 9 is reached at t = 6
    assert m.convergence_steps(run) == (8, False)
    assert m.convergence_steps_steepest(run) == (8, False)
    assert m.convergence_steps_flattest(run) == (8, False)
    slower = curve(returns, random=0, moving_average=2, convergence_slope=0.6)
    assert m.convergence_steps(slower) == (7, False)  # 2.25 ≤ 0.6 · 4


def test_a_late_collapse_moves_the_steepest_rise_but_not_the_convergence():
    learned = ramp(0, 300, 300)
    collapse = np.concatenate([learned, np.zeros(50), np.full(600, 300.0)])
    for returns in (learned, collapse):
        assert m.convergence_steps(curve(returns, random=0)) == (378, False)  # k = 78, as above
    assert m.convergence_steps_steepest(curve(learned)) == (399, False)
    assert m.convergence_steps_steepest(curve(collapse)) == (750, False)


@pytest.mark.parametrize("seed", range(20))
def test_convergence_against_loops(seed):
    returns, window = noisy(seed), 25
    average = averages(returns, window)
    slopes = {t: average[t] - average[t - window] for t in average if t - window in average}
    run = curve(returns, random=-3.0, moving_average=window)
    bar, expected = -3 + 0.75 * (np.mean(returns[-40:]) + 3), None
    for t in slopes:
        so_far = max(slopes[earlier] for earlier in slopes if earlier <= t)
        come_far = any(average[earlier] >= bar for earlier in average if earlier <= t)
        if expected is None and come_far and slopes[t] <= 0.1 * so_far:
            expected = t
    assert m.convergence_steps(run) == (expected or 400, expected is None)
    slopes = {t: round(value, 9) for t, value in slopes.items()}
    steepest = max(slopes, key=lambda t: (slopes[t], -t))
    expected = next((t for t in slopes if t >= steepest and slopes[t] <= 0), None)
    assert m.convergence_steps_steepest(run) == (expected or 400, expected is None)
    flattest = min(slopes, key=lambda t: (abs(slopes[t]), t))
    assert m.convergence_steps_flattest(run) == (flattest, False)


@pytest.mark.parametrize(
    "returns",
    [np.full(300, 0.1), np.arange(300.0)[::-1], np.arange(300.0), np.arange(99.0), np.ones(1)],
    ids=["constant", "falling", "rising throughout", "two windows short", "one"],
)
def test_convergence_that_never_comes_is_censored(returns):
    assert m.convergence_steps_steepest(curve(returns)) == (len(returns), True)
    if returns[-1] >= returns[0]:  # which no better than random is, or rising to the end
        assert m.convergence_steps(curve(returns, random=returns[0])) == (len(returns), True)


def test_a_run_that_is_there_from_the_beginning_converges_after_two_windows():
    assert m.convergence_steps(curve(np.ones(300), random=0)) == (100, False)


def test_flattest_needs_two_windows():
    assert m.convergence_steps_flattest(curve(np.ones(99))) == (99, True)
    assert m.convergence_steps_flattest(curve(np.ones(100))) == (100, False)


@pytest.mark.parametrize("seed", range(20))
def test_public_code_against_a_loop(seed):
    returns = noisy(seed, 1000) * (1 + seed % 3)
    average = np.convolve(returns, np.ones(50) / 50, "valid")
    expected = (1000, True)
    for i in range(int(0.3 * len(average)), len(average) - 50):
        if abs(average[i + 50] - average[i]) / 50 < 0.05:
            expected = (i + 1, False)
            break
    assert m.convergence_steps_public_code(curve(returns)) == expected


def test_public_code_has_a_floor_and_is_censored_while_the_return_changes():
    assert m.convergence_steps_public_code(curve(np.ones(2000))) == (586, False)
    assert m.convergence_steps_public_code(curve(np.ones(6000))) == (1786, False)
    assert m.convergence_steps_public_code(curve(np.arange(2000.0))) == (2000, True)
    assert m.convergence_steps_public_code(curve(0.049 * np.arange(2000.0))) == (586, False)
    assert m.convergence_steps_public_code(curve(np.ones(60))) == (60, True)


def test_range_bar_of_negative_returns():
    # From -500 to -100 with random -500: the bar is -200, 75 % of the way. Window 10: the average
    # of k episodes at -100 and 10 - k at -500 is -500 + 40 k, so 8 of them reach it (-180).
    run = curve([-500.0] * 30 + [-100.0] * 70, -100, -500, moving_average=10)
    assert m.sample_efficiency_range(run) == (38, False)
    # Within 10 % of 400 of the final return, so at -140 or above: 9 of 10 episodes (-140).
    assert m.convergence_steps_range(run) == (39, False)


def test_one_lucky_episode_does_not_reach_the_range_bar():
    run = curve([0.0] * 20 + [100.0] + [0.0] * 29 + [100.0] * 50, 100, 0, moving_average=10)
    assert m.sample_efficiency(run) == (21, False)
    assert m.sample_efficiency_range(run) == (58, False)


@pytest.mark.parametrize("seed", range(20))
def test_range_metrics_against_loops(seed):
    returns, window, random_mean = noisy(seed), 25, -3.0
    final = m.final_return(returns, 0.1)
    average = averages(returns, window)
    bar = random_mean + 0.75 * (final - random_mean)
    reached = next((t for t in average if average[t] >= bar), None)
    run = curve(returns, final, random_mean, moving_average=window)
    assert m.sample_efficiency_range(run) == (reached or 400, reached is None)
    near = [t for t in average if abs(average[t] - final) <= 0.1 * (final - random_mean)]
    settled = [t for t in near if set(range(t, 401)) <= set(near)]
    expected = (min(settled), False) if settled else (400, True)
    assert m.convergence_steps_range(run) == expected


def test_a_collapse_delays_the_convergence_without_floor():
    returns = [0.0] * 20 + [100.0] * 50 + [0.0] * 10 + [100.0] * 100
    # Flat again once the window of 10 holds no collapsed episode (9 of 10 at 100 is 90: near).
    assert m.convergence_steps_range(curve(returns, 100, 0, moving_average=10)) == (89, False)


NEEDS_LEARNING = [
    *(m.sample_efficiency, m.sample_efficiency_range, m.convergence_steps),
    *(m.convergence_steps_range, m.convergence_steps_steepest, m.convergence_steps_flattest),
]


@pytest.mark.parametrize("metric", NEEDS_LEARNING)
def test_a_run_no_better_than_random_reaches_nothing(metric):
    returns = np.array([-20.0] * 40 + [0.0] * 160)
    for random in (0.0, 1.0):  # 75 % of 0 is reached in episode 41
        assert metric(curve(returns, random=random)) == (200, True)
    assert not metric(curve(returns, random=-1.0)).censored


def test_better_than_random_is_more_than_two_standard_errors():
    returns = np.array([0.0] * 180 + [2.0, 0.0] * 10)  # the last 20: mean 1, error 1 / √20
    assert curve(returns, random=1 - 2.01 / np.sqrt(20)).learned
    assert not curve(returns, random=1 - 1.99 / np.sqrt(20)).learned


def test_of_runs_that_act_at_random_nearly_all_are_censored():
    """That the mean of the last episodes is not above random would let half of them pass."""
    draws = np.random.default_rng(0).gamma(4, 22.1 / 4, size=(1000, 500))
    ends = [m.final_return(returns, 0.1) for returns in draws]
    assert np.mean(np.array(ends) > 22.1) == pytest.approx(0.5, abs=0.05)
    runs = [m.sample_efficiency(curve(returns, random=22.1)) for returns in draws]
    assert np.mean([run.censored for run in runs]) > 0.96


def test_one_bar_for_all_does_not_fall_when_a_run_ends_worse():
    # Window 10, random 0, reference 100: 8 of 10 episodes at 100 are above 75.
    good = np.array([0.0] * 30 + [100.0] * 70)
    worse = np.array([0.0] * 20 + [60.0] * 80)
    found = [
        [
            metric(curve(returns, None, 0.0, (100.0,), moving_average=10))
            for returns in (good, worse)
        ]
        for metric in (m.sample_efficiency_range, m.sample_efficiency_common)
    ]
    assert found == [[(38, False), (28, False)], [(38, False), (100, True)]]
    # Reached is reached, whatever comes after.
    assert m.sample_efficiency_common(
        curve(good[::-1], None, 0.0, (100.0,), moving_average=10)
    ) == (10, False)


def test_solved_is_a_share_of_the_last_episodes():
    run = curve(np.arange(40.0), None, 0.0, (np.nan, 37.0))
    assert m.solved(run) == 0.75  # 37, 38 and 39 of 36 to 39


def test_the_early_return_is_that_of_the_first_tenth():
    assert m.early_return(curve(np.arange(40.0))) == 1.5  # of 0 to 3
    assert m.early_return(curve(np.arange(2000.0))) == np.mean(range(200))


def test_a_run_shorter_than_the_window_is_censored():
    run = curve(np.full(20, 100.0), 100, 0)
    assert m.sample_efficiency_range(run) == (20, True)
    assert m.convergence_steps_range(run) == (20, True)


def test_moving_averages_of_equal_windows_are_equal_to_the_bit():
    average = m.moving_average(np.full(1000, 0.1), 50)
    assert len(set(average.tolist())) == 1
    assert len(m.moving_average(np.ones(49), 50)) == 0
    np.testing.assert_allclose(
        m.moving_average(noisy(0), 25), pd.Series(noisy(0)).rolling(25).mean().dropna()
    )
