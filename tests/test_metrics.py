"""Metrics on curves whose answers are known by hand, and against plain loops."""

import importlib.util
import re
import sys
from decimal import ROUND_CEILING, Decimal
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mace_rl.config.results import MetricsConfig
from mace_rl.config.section import ConfigError, check
from mace_rl.results import metrics as m
from mace_rl.results.records import RecordError

ROOT = Path(__file__).parents[1]
SETTINGS = {
    "final_fraction": 0.1,
    "threshold": 0.75,
    "moving_average": 50,
    "convergence_slope": 0.1,
    "convergence_band": 0.1,
    "confidence": 0.95,
    "bootstrap_repetitions": 1000,
    "bootstrap_seed": 0,
    "comparisons": [],
    "random_return": {"CartPole-v1": 22.1, "Acrobot-v1": -499.1},
    "reference_return": {"CartPole-v1": 400.0, "Acrobot-v1": -200.0},
    "solved_return": {"CartPole-v1": 475.0, "Acrobot-v1": -100.0},
}
CONFIG = check(MetricsConfig, SETTINGS, "test")
ROW = {  # of metrics.csv, for 200 episodes of return 20 and 800 of 500
    "env": "CartPole-v1",
    "variant": "ppo",
    "seed": 4,
    "episodes": 1000,
    "env_steps": 9000,
    "final_return": 500.0,
    "sample_efficiency": 201,
    "convergence_steps": 295,  # the slope has come down from 480 / 50 to a tenth of that
    "area_under_curve": 404.0,
    "early_return": 20.0,
    "solved": 1.0,
    "sample_efficiency_common": 230,  # 22.1 + 0.75 · 377.9 = 305.5: 30 of 50 episodes at 500
    "sample_efficiency_range": 238,  # 22.1 + 0.75 · 477.9 = 380.5: 38 of 50 episodes at 500
    "convergence_steps_range": 246,  # 500 - 47.79: 46 of 50
    "convergence_steps_steepest": 300,  # both windows of 50 at 500: episodes 201 to 300
    "convergence_steps_flattest": 100,
    "convergence_steps_public_code": 286,  # its floor: int(0.3 · 951) + 1
    "sample_efficiency_censored": 0,
    "convergence_steps_censored": 0,
    "sample_efficiency_common_censored": 0,
    "sample_efficiency_range_censored": 0,
    "convergence_steps_range_censored": 0,
    "convergence_steps_steepest_censored": 0,
    "convergence_steps_flattest_censored": 0,
    "convergence_steps_public_code_censored": 0,
}
COLUMNS = list(ROW)
ENVIRONMENTS, VARIANTS, SEEDS = ["CartPole-v1", "Acrobot-v1"], ["ppo", "mace_full"], [3, 1]
WANTED = list(product(ENVIRONMENTS, VARIANTS, SEEDS))


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


def noisy(seed, episodes=400):
    """A learning curve with noise, rounded so that equal values occur."""
    generator = np.random.default_rng(seed)
    level = 100 / (1 + np.exp(-(np.arange(episodes) - generator.integers(50, 300)) / 20))
    return np.round(level + generator.normal(size=episodes) * 10)


def averages(returns, window):
    """Moving averages by episode number (from 1), from pandas."""
    rolling = pd.Series(returns).rolling(window).mean()
    return {t + 1: value for t, value in enumerate(rolling) if not np.isnan(value)}


def frame(returns, length=1):
    episodes = np.arange(1, len(returns) + 1)
    return pd.DataFrame({"extrinsic_return": returns, "env_steps": episodes * length})


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
    learnt = ramp(0, 300, 300)
    collapse = np.concatenate([learnt, np.zeros(50), np.full(600, 300.0)])
    for returns in (learnt, collapse):
        assert m.convergence_steps(curve(returns, random=0)) == (378, False)  # k = 78, as above
    assert m.convergence_steps_steepest(curve(learnt)) == (399, False)
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


def test_the_reading_of_table_1_is_steady_and_sees_a_delay(monkeypatch):
    """What docs/metrics.md chooses it by, with fewer curves."""
    path = ROOT / "tools" / "convergence_simulation.py"
    spec = importlib.util.spec_from_file_location("convergence_simulation", path)
    spec.loader.exec_module(tool := importlib.util.module_from_spec(spec))
    monkeypatch.setattr(tool, "REPEATS", 30)
    named = {reading: name for name, reading in tool.READINGS.items()}
    for shape in tool.SHAPES:
        cells = dict(zip(tool.READINGS, tool.column(shape), strict=True))
        spread, order = (
            {name: float(re.split("±|,", cell)[part]) for name, cell in cells.items()}
            for part in (1, 2)
        )
        chosen = named[m.convergence_steps]
        assert spread[chosen] < 3.5 and order[chosen] > 98
        assert order[named[m.convergence_steps_public_code]] < 60 or shape == "two steps"
        if shape in ("CartPole", "Hopper"):  # late collapses, drift
            assert spread[named[m.convergence_steps_steepest]] > 4 * spread[chosen]


# rows, the table, the file


def runs():
    return {
        run: frame(noisy(i) - 300 * (run[0] == "Acrobot-v1"), length=7)
        for i, run in enumerate(product(ENVIRONMENTS, VARIANTS, SEEDS))
    }


def table(**changed):
    return m.metrics_table(**{"runs": runs(), "wanted": WANTED, "settings": CONFIG} | changed)


def test_a_row_holds_each_metric_under_its_name():
    returns = np.concatenate([np.full(200, 20.0), np.full(800, 500.0)])
    row = m.metrics_of_run(frame(returns, 9), ("CartPole-v1", "ppo", 4), CONFIG)
    assert row == ROW
    assert list(row) == COLUMNS


def test_the_table_is_in_the_configured_order_and_counts_censored_runs():
    result = table()
    found = list(zip(result["env"], result["variant"], result["seed"], strict=True))
    assert found == WANTED
    assert not result.isna().any(axis=None)
    acrobot = result[result["env"] == "Acrobot-v1"]
    assert (acrobot["sample_efficiency_censored"] == 1).all()  # the bar is above the final return
    assert (acrobot["sample_efficiency"] == 400).all()


def test_a_missing_run_is_an_error_and_never_a_smaller_n():
    fewer = runs()
    del fewer["Acrobot-v1", "ppo", 1]
    with pytest.raises(RecordError, match="the run Acrobot-v1, ppo, seed 1 is missing"):
        table(runs=fewer)
    with pytest.raises(RecordError, match="seed 1 in the records is not in the configuration"):
        table(wanted=[run for run in WANTED if run[2] == 3])
    shorter = runs()
    shorter["Acrobot-v1", "ppo", 1] = frame(noisy(0, 399))
    with pytest.raises(RecordError, match=r"Acrobot-v1, ppo have different .* \[399, 400\]"):
        table(runs=shorter)


def change(row, column, value):
    def damage(lines):
        cells = lines[row].split(",")
        cells[COLUMNS.index(column)] = value
        lines[row] = ",".join(cells)

    return damage


DAMAGE = {
    "a run lost": (lambda lines: lines.pop(3), "mace_full, seed 3 is missing"),
    "a run twice": (lambda lines: lines.append(lines[1]), "seed 3 stands more than once"),
    "rows swapped": (lambda lines: lines.insert(1, lines.pop(2)), "line 2: .*seed 1 stands where"),
    "another seed": (change(8, "seed", "7"), "seed 1 is missing"),
    "another variant": (change(1, "variant", "ppO"), "ppo, seed 3 is missing"),
    "a column lost": (lambda lines: lines.__setitem__(0, lines[0][:-9]), "line 1: the column"),
    "NaN": (change(5, "final_return", "nan"), "line 6: final_return is 'nan'"),
    "empty": (change(5, "convergence_steps", ""), "line 6: convergence_steps is ''"),
    "episode 0": (change(5, "sample_efficiency", "0"), "line 6: sample_efficiency is 0 of 400"),
    "beyond E": (change(2, "sample_efficiency", "401"), "line 3: sample_efficiency is 401 of 400"),
    "a flag of 2": (change(2, "convergence_steps_censored", "2"), "line 3: convergence_steps"),
    "a flag too much": (change(2, "sample_efficiency_censored", "1"), "line 3: sample_efficiency"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_metrics_file_is_refused(damage, tmp_path):
    spoil, named = DAMAGE[damage]
    path = tmp_path / "metrics.csv"
    lines = table().to_csv(index=False).splitlines()
    spoil(lines)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordError, match=named) as refusal:
        m.read_metrics(path, WANTED, CONFIG)
    assert str(path) in str(refusal.value)


# metrics of the user's own


@pytest.fixture
def custom(monkeypatch):
    """`custom(*metrics)`: the settings with these, as if this file were the user's."""

    def make(*metrics):
        names = [f"OWN_{number}" for number in range(len(metrics))]
        for name, metric in zip(names, metrics, strict=True):
            monkeypatch.setattr(sys.modules[__name__], name, metric, raising=False)
        references = [f"{__name__}:{name}" for name in names]
        return check(MetricsConfig, SETTINGS | {"custom": references}, "test")

    return make


def test_metrics_of_the_users_own_follow_in_metrics_csv(custom, tmp_path):
    settings = custom(
        m.Metric("positive", "Positive", "episodes", lambda curve: curve.first(curve.returns > 0)),
        m.Metric("worst", "Worst", "return", lambda curve: curve.returns.min()),
    )
    result = table(settings=settings)
    added = ["positive", "worst", "positive_censored"]
    assert list(result.columns) == [*COLUMNS[:17], *added[:2], *COLUMNS[17:], added[2]]
    pd.testing.assert_frame_equal(result[COLUMNS], table())
    for row, run in zip(result[added].itertuples(index=False), runs().values(), strict=True):
        returns = run["extrinsic_return"].tolist()
        first = next((t for t, value in enumerate(returns, start=1) if value > 0), None)
        assert tuple(row) == (first or 400, min(returns), first is None)
    result.to_csv(tmp_path / "metrics.csv", index=False)
    read = m.read_metrics(tmp_path / "metrics.csv", WANTED, settings)
    pd.testing.assert_frame_equal(read, result, check_exact=True)
    with pytest.raises(RecordError, match="line 1: the column 'positive'"):
        m.read_metrics(tmp_path / "metrics.csv", WANTED, CONFIG)


@pytest.mark.parametrize(
    ("own", "problem"),
    [
        (3, "is no mace_rl.results.metrics.Metric but of type int"),
        (m.Metric("seed", "S", "return", min), "has the name 'seed', but metrics.csv has such"),
        (m.Metric("x", "X", "episodes", min), "has the name 'x', but metrics.csv has such"),
        (m.Metric("sample_efficiency_censored", "S", "return", min), "but metrics.csv has such"),
        (m.Metric("a,b", "A", "return", min), "has the name 'a,b', but a column's name should"),
        (m.Metric("s", "S", "steps", min), "has the unit 'steps', but should have one of episodes"),
    ],
)
def test_what_is_no_metric_is_refused(own, problem, custom):
    refusal = rf"metrics\.custom has '{__name__}:OWN_1', which .*{problem}"
    with pytest.raises(ConfigError, match=refusal):
        m.all_metrics(custom(m.Metric("x_censored", "X", "return", min), own))


@pytest.mark.parametrize(
    ("unit", "value", "error", "problem"),
    [
        ("return", np.nan, ConfigError, "is nan, but should be a finite number"),
        ("return", m.Episode(1, False), ConfigError, "but should be a finite number"),
        ("episodes", 3.5, ConfigError, r"x of the run CartPole-v1, ppo, seed 3 is 3\.5, but"),
        ("episodes", m.Episode(0, False), RecordError, "x is 0 of 400 episodes"),
        ("episodes", m.Episode(9, True), RecordError, "x is 9 of 400 episodes with x_censored = 1"),
    ],
)
def test_what_no_metric_can_be_is_refused(unit, value, error, problem, custom):
    with pytest.raises(error, match=problem):
        table(settings=custom(m.Metric("x", "X", unit, lambda curve: value)))


REFUSED = {
    "final_fraction": (0, 1.1),
    "threshold": (1.0,),
    "moving_average": (0, 50.5),
    "convergence_band": (-0.1,),
    "confidence": (95,),
    "bootstrap_repetitions": (99,),
    "bootstrap_seed": (-1,),
    "convergence_slope": (-0.1, 1.0),
    "regret": ({"variant": "mace_full", "constants": []},),
    "random_return": (22.1, *({"CartPole-v1": value} for value in (np.nan, np.inf, "22", True))),
    "custom": (["own_metrics.POSITIVE"], ["own metrics:POSITIVE"]),
}


@pytest.mark.parametrize("key", REFUSED)
def test_a_setting_that_cannot_be_is_refused(key):
    for value in REFUSED[key]:
        with pytest.raises(ConfigError, match=rf"test: {key}(\.CartPole-v1|\.0|\.constants)? is "):
            check(MetricsConfig, SETTINGS | {key: value}, "test")


def test_a_study_has_the_metrics_whose_goals_all_its_environments_have():
    def names(environments, **changes):
        settings = check(MetricsConfig, SETTINGS | changes, "test").within(environments, ["ppo"])
        return [metric.name for metric in m.all_metrics(settings) if metric.needs]

    assert names(ENVIRONMENTS) == ["solved", "sample_efficiency_common"]
    assert names(["CartPole-v1", "Other-v0"]) == []
    assert names(ENVIRONMENTS, solved_return={"CartPole-v1": 475.0}) == ["sample_efficiency_common"]
    assert names(["CartPole-v1"], reference_return={}) == ["solved"]
    columns = table(settings=CONFIG.within([*ENVIRONMENTS, "Other-v0"], VARIANTS)).columns
    assert not {"solved", "sample_efficiency_common_censored"} & set(columns)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            {"solved_return": {"CartPole-v1": 22.1}},
            r"metrics\.solved_return\.CartPole-v1 is 22\.1, but should be greater than .*, 22\.1",
        ),
        (
            {"regret": {"variant": "mace_full", "constants": ["ppo", "beta_0.1"]}},
            r"metrics\.regret has 'beta_0\.1', which is not in variants",
        ),
    ],
)
def test_what_does_not_fit_the_study_is_refused(change, problem):
    with pytest.raises(ConfigError, match=problem):
        check(MetricsConfig, SETTINGS | change, "test").within(ENVIRONMENTS, VARIANTS)


def test_every_metric_is_in_the_documentation():
    text = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)`.*?\| (\w+) \|", text, re.MULTILINE)
    units = {"episodes": "episode"}
    listed = {metric.name: units.get(metric.unit, metric.unit) for metric in m.METRICS}
    assert listed.items() <= dict(rows).items()
