"""Statistics against hand calculations, exhaustive enumeration and scipy."""

from itertools import combinations, product

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from invented import expanded

from mace_rl.study.compare import statistics as s

REPETITIONS = 5000
FIVE = np.array([186.0, 201.0, 249.0, 140.0, 120.0])
OTHER = np.array([170.0, 230.0, 249.0, 150.0, 95.0])
TWELVE = np.array([3.0, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8])
NEVER = np.inf


def generator(seed=0):
    return np.random.default_rng(seed)


HOW = 0.95, REPETITIONS


def interval(values, seed=0):
    return s.mean_interval(values, *HOW, generator(seed))


def paired(x, y):
    return s.paired_comparison(x - y, *HOW, generator())


def test_below_ten_seeds_the_interval_is_students_and_then_the_expanded_bootstrap():
    assert (s.interval_kind(9), s.interval_kind(10)) == ("t", "bootstrap")
    expected = scipy.stats.t.interval(0.95, 4, FIVE.mean(), scipy.stats.sem(FIVE))
    np.testing.assert_allclose(interval(FIVE), expected, rtol=1e-12)
    # By hand: 0 and 2 have mean 1, standard error 1 and t of one degree of freedom 12.706.
    np.testing.assert_allclose(interval(np.array([0.0, 2.0])), (1 - 12.7062, 1 + 12.7062), 1e-4)
    resampled = generator(1).choice(TWELVE, (10**5, 12)).mean(axis=1)
    found = s.mean_interval(TWELVE, 0.95, 10**5, generator())
    np.testing.assert_allclose(found, expanded(resampled, 12), atol=0.03)


@pytest.mark.parametrize("seeds", [5, 12])
def test_curves_are_treated_point_by_point(seeds, monkeypatch):
    values = generator(3).normal(size=(seeds, 50))
    monkeypatch.setattr(s, "CHUNK", 7 * seeds * REPETITIONS)  # 7 points at a time
    low, high = interval(values)
    assert low.shape == high.shape == (50,)
    for point in (0, 6, 7, 49):
        np.testing.assert_allclose((low[point], high[point]), interval(values[:, point]))


def test_one_seed_allows_no_interval_and_equal_seeds_one_of_no_width():
    assert np.isnan(interval(np.array([5.0]))).all()
    assert np.isnan(interval(np.ones((1, 3)))).all()
    for seeds in (2, 9, 10, 30):
        low, high = interval(np.full(seeds, 2000.0))
        assert low == high == 2000


def test_paired_comparison_against_scipy_and_enumeration():
    result, difference = paired(FIVE, OTHER), FIVE - OTHER
    assert result.difference == pytest.approx(sum(difference) / 5)
    expected = scipy.stats.ttest_rel(FIVE, OTHER).confidence_interval(0.95)
    assert (result.low, result.high) == pytest.approx(expected)
    flips = [abs(np.dot(signs, difference)) for signs in product((-1, 1), repeat=5)]
    assert result.p_value == np.mean(np.array(flips) >= abs(difference.sum()))
    assert paired(FIVE, FIVE) == (0, 0, 0, 1)
    for n in (2, 5):
        assert paired(FIVE[:n] + 1, FIVE[:n]) == (1, 1, 1, 2 / 2**n)
    one = paired(FIVE[:1], OTHER[:1])
    assert one.difference == 16 and np.isnan(one[1:]).all()


def test_stratified_comparison():
    draws = generator()
    strata = [draws.normal(1.0, 1, 20), draws.normal(0.2, 3, 12)]
    found = s.stratified_comparison(strata, 0.95, 10_000, generator())
    assert found.difference == pytest.approx(np.mean([values.mean() for values in strata]))
    means = [draws.choice(v, (10_000, len(v))).mean(axis=1) for v in strata]
    expected = expanded(np.mean(means, axis=0), 12)  # as for the smaller stratum
    np.testing.assert_allclose((found.low, found.high), expected, atol=0.05 * np.ptp(expected))
    signs = [draws.choice([-1, 1], (20_000, len(values))) for values in strata]
    flipped = np.mean([(x * v).mean(axis=1) for x, v in zip(signs, strata, strict=True)], axis=0)
    assert found.p_value == pytest.approx(np.mean(abs(flipped) >= found.difference), abs=0.02)
    one = s.paired_comparison(strata[0], 0.95, 1000, generator(3))
    assert s.stratified_comparison(strata[:1], 0.95, 1000, generator(3)) == one


def test_equivalence_is_two_one_sided_sign_flip_tests():
    """Of one stratum and of two that weigh alike, against all sign patterns."""
    rng = np.random.default_rng(5)
    for sizes, margin in product([(7,), (4, 6)], (0.3, 2.0)):
        strata = [rng.normal(0.2, 0.5, size) for size in sizes]
        worst = 0.0
        for shift, side in ((margin, 1), (-margin, -1)):
            weighted = [side * (values + shift) / len(values) for values in strata]
            values = np.concatenate(weighted)
            signs = np.array(list(product((-1, 1), repeat=len(values))))
            worst = max(worst, np.mean(signs @ values >= values.sum() - 1e-9))
        assert s.equivalence(strata, margin, 2000, generator()) == pytest.approx(worst)
    assert np.isnan(s.equivalence([np.array([0.1])], 1.0, 2000, generator()))


def test_strata_of_few_seeds_have_students_interval_with_the_freedom_of_the_smallest():
    draws = generator()
    strata = [draws.normal(1.0, 1, 5), draws.normal(0.2, 3, 12), draws.normal(0, 2, 12)]
    found = s.stratified_comparison(strata, 0.95, 1000, generator())
    error = np.sqrt(sum(scipy.stats.sem(values) ** 2 for values in strata)) / 3
    centre = np.mean([values.mean() for values in strata])
    expected = scipy.stats.t.interval(0.95, 4, centre, error)
    assert (found.low, found.high) == pytest.approx(expected)


def test_probability_of_improvement_against_a_loop_and_scipy():
    """The mean over environments, resampled within each."""
    pairs = [(TWELVE, TWELVE[:10] ** 2 / 5), (TWELVE - 1, TWELVE)]
    columns = [(x[:, None], y[:, None]) for x, y in pairs]
    probability, low, high = s.probability_of_improvement(columns, *HOW, generator())
    u = [scipy.stats.mannwhitneyu(x, y).statistic / (len(x) * len(y)) for x, y in pairs]
    assert probability == pytest.approx(np.mean(u))  # rliable's formula
    draws, resampled = generator(7), []
    for _ in range(REPETITIONS):
        drawn = [(draws.choice(x, len(x)), draws.choice(y, len(y))) for x, y in pairs]
        resampled.append(np.mean([np.heaviside(np.subtract.outer(*d), 0.5).mean() for d in drawn]))
    np.testing.assert_allclose((low[0], high[0]), expanded(resampled, 10), atol=0.03)


@pytest.mark.parametrize(
    ("x", "y", "expected"), [([2, 3], [0, 1], 1), ([0, 1], [2, 3], 0), ([1, 1], [1, 1], 0.5)]
)
def test_probability_of_improvement_at_its_limits(x, y, expected):
    pair = np.array(x, float)[:, None], np.array(y, float)[:, None]
    assert s.probability_of_improvement([pair], *HOW, generator()) == (expected,) * 3
    value, *bounds = s.probability_of_improvement([(pair[0][:1], pair[1])], *HOW, generator())
    assert value == expected and np.isnan(bounds).all()


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_against_a_loop(p):
    # By hand: 0.005 · 4, 0.01 · 3, 0.03 · 2, 0.04 · 1 = 0.02, 0.03, 0.06, then at least 0.06.
    np.testing.assert_allclose(s.holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    ordered, m = sorted(p), len(p)
    expected = [
        max(min(1, ordered[i] * (m - i)) for i in range(m) if ordered[i] <= value) for value in p
    ]
    assert s.holm(p).tolist() == pytest.approx(expected)


def observed_minus_expected(x, y):
    """The log-rank statistic of x, event by event."""
    everything, result = [*x, *y], 0.0
    for time in sorted({time for time in everything if time < NEVER}):
        at_risk = sum(t >= time for t in everything)
        expected = everything.count(time) * sum(t >= time for t in x) / at_risk
        result += list(x).count(time) - expected
    return result


times = st.lists(st.sampled_from([10, 20, 20, 30, 40, NEVER]), min_size=2, max_size=4)


@settings(max_examples=30, deadline=None)
@given(times, st.lists(st.sampled_from([10, 20, 25, 30, NEVER]), min_size=2, max_size=5))
def test_logrank_against_enumeration(x, y):
    everything, outcomes = [*x, *y], []
    for chosen in combinations(range(len(everything)), len(x)):
        rest = [t for place, t in enumerate(everything) if place not in chosen]
        outcomes.append(observed_minus_expected([everything[place] for place in chosen], rest))
    outcomes, found = np.array(outcomes), observed_minus_expected(x, y)
    tails = np.mean(outcomes >= found - 1e-9), np.mean(outcomes <= found + 1e-9)
    p_value = s.logrank(np.array(x, float), np.array(y, float), 9999, generator())
    assert p_value == pytest.approx(min(1, 2 * min(tails)))


def test_logrank_of_many_runs_is_near_scipys_approximation():
    draws = generator(8)
    for shift in (0, 40, 80):
        x, y = draws.exponential(100, 40), shift + draws.exponential(100, 40)
        seen = [np.where(values < 200, values, NEVER) for values in (x, y)]
        censored = [
            scipy.stats.CensoredData.right_censored(np.minimum(v, 200), v == NEVER) for v in seen
        ]
        expected = scipy.stats.logrank(*censored).pvalue
        assert s.logrank(*seen, 9999, generator()) == pytest.approx(expected, abs=0.02)
    assert np.isnan(s.logrank(x[:1], y[:1], 999, generator()))
