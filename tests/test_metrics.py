"""Metrics on curves whose answers are known by hand and against loops; the table of all runs."""

import sys
from decimal import ROUND_CEILING, Decimal
from itertools import product

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from invented import CONFIG, SETTINGS, frame, noisy

from mace_rl.config.section import ConfigError, check
from mace_rl.records import RecordError, read_table
from mace_rl.study.measure import metrics as m
from mace_rl.study.measure import run_metrics as t
from mace_rl.study.metrics_config import GOALS, MetricsConfig


def ramp(flat_before, rise, flat_after):
    """0, …, 0, 1, 2, …, rise, rise, …"""
    return [0] * flat_before + list(range(1, rise + 1)) + [rise] * flat_after


def curve(returns, final=None, random=-1e9, goals=(), **settings):
    """What a metric gets; settings that are not given are those above."""
    returns, changed = np.asarray(returns, float), CONFIG.model_copy(update=settings)
    final = m.final_return(returns, 0.1) if final is None else final
    return m.LearningCurve(returns, final, random, changed, *goals)


def averages(returns, window):
    """Moving averages by episode number (from 1), from pandas."""
    rolling = pd.Series(returns).rolling(window).mean()
    return {t + 1: value for t, value in enumerate(rolling) if not np.isnan(value)}


LUCKY = [0, 10, 75, 20, 74, 100, 100, 100, 100, 100]
NEGATIVE = [-500, -200, *[-85] * 18]  # 75 % of -85 is -63.75
# Window 2: averages of pairs 0, .5, 1, 5, 9, 9.5, 9, 8, 8.5 (t = 2, …) and slopes
# (m_t - m_{t-2}) / 2 of .5, 2.25, 4, 2.25, 0, -.75, -.25 (t = 4, …).
PEAK = [0, 0, 1, 1, 9, 9, 10, 8, 8, 9]
COLLAPSE = [*ramp(0, 300, 300), *[0] * 50, *[300] * 600]
DIP = [0] * 20 + [100] * 50 + [0] * 10 + [100] * 100
LATE = [0] * 30 + [100] * 70  # window 10: 8 of 10 episodes at 100 are above 75
WORSE = [0] * 20 + [60] * 80
SMALL, WIDE = {"random": 0, "moving_average": 2}, {"moving_average": 10}
BAR = {"random": 0, "goals": (100.0,)} | WIDE
# From -500 to -100 with random -500: the bar is -200. Window 10: the average of k episodes at -100
# and 10 - k at -500 is -500 + 40 k, so 8 of them reach it; within 40 of the end are 9 of 10.
RISE = ([-500] * 30 + [-100] * 70, {"random": -500} | WIDE)

CASES = [  # metric, returns, the curve's settings, episode, censored
    (m.sample_efficiency, LUCKY, {"final": 100}, 3, False),  # a single episode is enough
    (m.sample_efficiency, LUCKY, {"final": 100, "threshold": 0.751}, 6, False),
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
    (m.convergence_steps, np.arange(300), {"random": 0}, 300, True),
    (m.convergence_steps_steepest, [0, 0, 1, 1, 1, 1, 2, 2, 2, 2], SMALL, 6, False),  # the first
    (m.convergence_steps_steepest, COLLAPSE, {}, 750, False),  # moved by a late collapse
    (m.convergence_steps_steepest, np.arange(300)[::-1], {}, 300, True),
    (m.convergence_steps_steepest, np.arange(99), {}, 99, True),  # two windows short
    (m.convergence_steps_flattest, np.ones(99), {}, 99, True),
    (m.convergence_steps_public_code, np.ones(2000), {}, 586, False),  # its floor
    (m.convergence_steps_public_code, np.arange(2000), {}, 2000, True),
    (m.convergence_steps_public_code, 0.049 * np.arange(2000), {}, 586, False),
    (m.convergence_steps_public_code, np.ones(60), {}, 60, True),
    (m.sample_efficiency_range, *RISE, 38, False),
    (m.convergence_steps_range, *RISE, 39, False),
    (m.convergence_steps_range, DIP, {"final": 100, "random": 0} | WIDE, 89, False),
    (m.sample_efficiency_range, [*[0] * 20, 100, *[0] * 29, *[100] * 50], BAR, 58, False),
    (m.sample_efficiency_range, np.full(20, 100), {"random": 0}, 20, True),  # within a window
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

    steepest = max(slopes, key=lambda t: (slopes[t], -t))
    near = [t for t in average if abs(average[t] - final) <= 0.1 * (final - random)]
    expected = {
        m.sample_efficiency_range: first(t for t in average if average[t] >= bar),
        m.convergence_steps_range: first(t for t in near if set(range(t, 401)) <= set(near)),
        m.convergence_steps_steepest: first(t for t in slopes if t >= steepest and slopes[t] <= 0),
        m.convergence_steps_flattest: (min(slopes, key=lambda t: (abs(slopes[t]), t)), False),
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
READINGS += [m.convergence_steps_range, m.convergence_steps_steepest, m.convergence_steps_flattest]


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


def test_stagnation_goes_with_the_beta_of_the_next_episode():
    """A β that is made of it is correlated perfectly, and an episode away from it less."""
    returns, window = np.random.default_rng(0).normal(size=300), 5
    average = pd.Series(returns).rolling(window).mean()
    rise = (average - average.shift(window)).to_numpy()  # from episode 2 · window on
    stagnation = np.full(300, 7.0)
    stagnation[2 * window :] = -rise[2 * window - 1 : -1]  # of the episode before
    betas = [np.roll(0.4 + 0.1 * stagnation, shift) for shift in (0, -1, 1)]
    found = [m.stagnation_correlation(returns, beta, window) for beta in betas]
    assert found[0] == pytest.approx(1) and max(found[1:]) < 0.9
    assert m.stagnation_correlation(returns, 0.4 - 0.1 * stagnation, window) == pytest.approx(-1)
    assert m.stagnation_correlation(returns, np.full(300, 0.4), window) == 0


def by_hand(returns, betas, window, episodes):
    """Stagnation after each of these episodes, over halves of what there is, with the next β."""
    pairs = []
    for episode in episodes:
        h = min(window, episode // 2)
        before, last = returns[episode - 2 * h : episode][:h], returns[episode - h : episode]
        pairs.append([round((np.mean(before) - np.mean(last)) / h, 9), betas[episode]])
    return pd.DataFrame(pairs).corr(method="spearman").iloc[0, 1]


@pytest.mark.parametrize("window", [10, 25])
def test_stagnation_before_and_after_the_bar_from_the_first_windows_on(window):
    returns = noisy(3)
    betas = np.repeat(np.random.default_rng(1).random(100), 4)  # in steps

    def found(betas, goal=100.0):
        run = curve(returns[: len(betas)], random=0, goals=(goal,), moving_average=window)
        return m.stagnation_correlations(run, betas)

    reached = min(t for t, mean in averages(returns, window).items() if mean >= 75)
    first = 2 * ((window + 9) // 10)
    assert first + 20 < reached < 380
    before = by_hand(returns, betas, window, range(first, reached))
    after = by_hand(returns, betas, window, range(reached, 400))
    assert found(betas) == pytest.approx((before, after)) and abs(before - after) > 0.01
    # A bar never reached, one reached at the end, β that is constant before it, a short run.
    whole = by_hand(returns, betas, window, range(first, 400))
    assert found(betas, goal=1000.0) == pytest.approx((whole, 0))
    assert found(betas[:reached]) == pytest.approx((before, 0))
    assert found(np.where(np.arange(400) < reached, 0.4, betas)) == pytest.approx((0, after))
    assert found(betas[:1]) == found(betas[:first]) == (0, 0)


@pytest.mark.parametrize("metric", [one for one in m.METRICS if one.unit == "episodes"])
def test_no_run_is_earlier_than_a_metric_can_be(metric):
    """And one that is good from the beginning is as early, or once it has risen at all."""
    at_once, risen = np.full(400, 500.0), np.array([-1e4, *[500.0] * 399])
    curves = [noisy(seed) for seed in range(20)] + [at_once, risen]
    found = [metric.function(curve(own, random=-1e4, goals=(500.0,))).number for own in curves]
    assert 0 <= min(found) - metric.earliest(50, 400) <= 1


# --- metrics.csv ----------------------------------------------------------------------------------

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
}
EPISODES = [metric.name for metric in m.METRICS if metric.unit == "episodes"]
ROW |= dict.fromkeys((f"{name}_censored" for name in EPISODES), 0)
COLUMNS = list(ROW)
ENVIRONMENTS, VARIANTS, SEEDS = ["CartPole-v1", "Acrobot-v1"], ["ppo", "mace_full"], [3, 1]
WANTED = [(*run, 400) for run in product(ENVIRONMENTS, VARIANTS, SEEDS)]


def runs():
    keys = enumerate(product(ENVIRONMENTS, VARIANTS, SEEDS))
    return {key: frame(noisy(i) - 300 * (key[0] == "Acrobot-v1"), length=7) for i, key in keys}


def table(settings=CONFIG):
    return t.metrics_table(runs(), settings)


def test_a_row_holds_each_metric_under_its_name():
    returns = np.concatenate([np.full(200, 20.0), np.full(800, 500.0)])
    row = t.metrics_of_run(frame(returns, 9), ("CartPole-v1", "ppo", 4), CONFIG)
    assert row == ROW
    assert list(row) == COLUMNS


def test_the_table_has_every_run_and_counts_censored_ones():
    result = table()
    assert list(result[COLUMNS[:4]].itertuples(index=False, name=None)) == WANTED
    assert not result.isna().any(axis=None)
    acrobot = result[result["env"] == "Acrobot-v1"]  # the bar is above the final return
    assert (acrobot[["sample_efficiency", "sample_efficiency_censored"]] == [400, 1]).all(axis=None)


def test_betas_are_measured_like_returns(tmp_path):
    beta = np.linspace(0.2, 0.6, 400)[::-1]
    found = {run: own.assign(beta=beta) for run, own in runs().items()}
    result = t.betas_table(found, CONFIG)
    shown = result[["beta_end", "beta_lowest", "beta_highest"]]
    assert np.allclose(shown, [beta[-40:].mean(), 0.2, 0.6])
    for run, correlation in zip(found, result["stagnation_correlation"], strict=True):
        average = found[run]["extrinsic_return"].rolling(50).mean()
        stagnation = (average.shift(50) - average).shift(1).round(9)  # ties
        expected = stagnation.corr(pd.Series(beta), method="spearman")
        assert correlation == pytest.approx(expected)
    without = t.betas_table(found, CONFIG.model_copy(update={"reference_return": {}}))
    pd.testing.assert_frame_equal(without, result.iloc[:, :-2])  # no bar, nothing before it
    result.to_csv(tmp_path / "betas.csv", index=False)
    read = read_table(tmp_path / "betas.csv", t.betas_columns(CONFIG))
    pd.testing.assert_frame_equal(read, result)


def change(row, column, value):
    def damage(lines):
        cells = lines[row].split(",")
        cells[COLUMNS.index(column)] = value
        lines[row] = ",".join(cells)

    return damage


DAMAGE = {
    "a run lost": (lambda lines: lines.pop(3), "line 4: the run .*1, 400. stands where .*3, 400. "),
    "a run twice": (lambda lines: lines.append(lines[1]), "line 10: the run .* where None belongs"),
    "rows swapped": (lambda lines: lines.insert(1, lines.pop(2)), "line 2: the run .*1, 400. stan"),
    "another budget": (change(8, "episodes", "401"), "line 9: the run .*1, 401. stands where"),
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
        t.read_metrics(path, WANTED, CONFIG)
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
    read = t.read_metrics(tmp_path / "metrics.csv", WANTED, settings)
    pd.testing.assert_frame_equal(read, result, check_exact=True)
    with pytest.raises(RecordError, match="line 1: the column 'positive'"):
        t.read_metrics(tmp_path / "metrics.csv", WANTED, CONFIG)


NOT_FINITE = "is nan, but should be a finite number"
NO_METRIC = [  # what is given, and what is said of it
    (3, "is no mace_rl.study.measure.metrics.Metric but of type int"),
    (m.Metric("seed", "S", "return", min), "has the name 'seed', but metrics.csv has such"),
    (m.Metric("x", "X", "episodes", min), "has the name 'x', but metrics.csv has such"),
    (m.Metric("sample_efficiency_censored", "S", "return", min), "but metrics.csv has such"),
    (m.Metric("a,b", "A", "return", min), "has the name 'a,b', but a column's name should"),
    (m.Metric("s", "S", "steps", min), "has the unit 'steps', but should have one of episodes"),
    (m.Metric("y", "Y", "return", lambda curve: np.nan), NOT_FINITE),
    (m.Metric("y", "Y", "return", lambda curve: m.Attained(1, False)), "should be a finite number"),
    (m.Metric("y", "Y", "episodes", lambda curve: 3.5), r"y of the run \(.*, 3\) is 3.5"),
    (m.Metric("y", "Y", "episodes", lambda curve: m.Attained(0, False)), "y is 0 of 400 episodes"),
    (m.Metric("y", "Y", "episodes", lambda curve: m.Attained(9, True)), "y is 9 of .*censored = 1"),
]


@pytest.mark.parametrize(("own", "problem"), NO_METRIC)
def test_what_is_no_metric_is_refused(own, problem, custom):
    with pytest.raises((ConfigError, RecordError), match=problem):
        table(settings=custom(m.Metric("x_censored", "X", "return", lambda curve: 0.0), own))


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
    chosen = {"constants": {"learned": "mace_full", "fixed": ["ppo", "beta_1"]}}
    drawn = check(MetricsConfig, SETTINGS | chosen, "test")
    lines = drawn.incomplete([*ENVIRONMENTS, "Other-v0"], VARIANTS)
    assert [line.split()[0].partition(".")[2] for line in lines] == [*GOALS, "constants"]
    assert [line.split()[-1] for line in lines] == ["Other-v0", "Other-v0", "beta_1"]
    assert CONFIG.incomplete(ENVIRONMENTS, []) == CONFIG.incomplete(["Other-v0"], []) == []
    assert drawn.within(ENVIRONMENTS, VARIANTS).constants is None
    assert drawn.within(ENVIRONMENTS, ["ppo", "beta_1", "mace_full"]).constants == drawn.constants


def test_a_goal_that_random_actions_attain_is_refused():
    settings = check(MetricsConfig, SETTINGS | {"solved_return": {"CartPole-v1": 22.1}}, "test")
    problem = r"metrics\.solved_return\.CartPole-v1 is 22\.1, but should be greater than .*, 22\.1"
    with pytest.raises(ConfigError, match=problem):
        settings.within(ENVIRONMENTS, VARIANTS)
