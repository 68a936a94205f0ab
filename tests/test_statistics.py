"""Statistics against hand calculations, exhaustive enumeration and scipy."""

from itertools import combinations, product

import numpy as np
import pytest
import scipy.stats

from mace_rl.results import statistics as s

REPETITIONS = 5000
FIVE = np.array([186.0, 201.0, 249.0, 140.0, 120.0])
OTHER = np.array([170.0, 230.0, 249.0, 150.0, 95.0])
TWELVE = np.array([3.0, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8])


def generator(seed=0):
    return np.random.default_rng(seed)


def interval(values, seed=0):
    return s.mean_interval(values, 0.95, REPETITIONS, generator(seed))


def test_below_ten_seeds_the_interval_is_students():
    assert s.interval_kind(9) == "t"
    expected = scipy.stats.t.interval(0.95, 4, FIVE.mean(), scipy.stats.sem(FIVE))
    np.testing.assert_allclose(interval(FIVE), expected, rtol=1e-12)
    # By hand: 0 and 2 have mean 1, standard error 1 and t of one degree of freedom 12.706.
    np.testing.assert_allclose(interval(np.array([0.0, 2.0])), (1 - 12.7062, 1 + 12.7062), 1e-4)


def test_from_ten_seeds_on_the_interval_is_the_expanded_bootstrap():
    assert s.interval_kind(10) == "bootstrap"
    expected = scipy.stats.bootstrap(
        (TWELVE,),
        np.mean,
        n_resamples=REPETITIONS,
        method="percentile",
        confidence_level=1 - 2 * scipy.stats.norm.cdf(-np.sqrt(12 / 11) * 2.200985),  # t, 11
        rng=generator(1),
    ).confidence_interval
    np.testing.assert_allclose(interval(TWELVE), expected, atol=0.1)


@pytest.mark.parametrize("seeds", [5, 12])
def test_curves_are_treated_point_by_point(seeds, monkeypatch):
    values = generator(3).normal(size=(seeds, 50))
    monkeypatch.setattr(s, "CHUNK", 7 * seeds * REPETITIONS)  # 7 points at a time
    low, high = interval(values)
    assert low.shape == high.shape == (50,)
    for point in (0, 6, 7, 49):
        np.testing.assert_allclose((low[point], high[point]), interval(values[:, point]))


@pytest.mark.parametrize("seeds", [5, 15])
def test_intervals_cover_the_true_mean_about_as_often_as_they_say(seeds):
    draws = generator(4)
    hits = 0
    for _ in range(300):
        low, high = s.mean_interval(draws.normal(size=seeds), 0.9, 500, draws)
        hits += bool(low <= 0 <= high)
    assert 0.82 <= hits / 300 <= 0.95


def test_one_seed_allows_no_interval():
    assert np.isnan(interval(np.array([5.0]))).all()
    assert np.isnan(interval(np.ones((1, 3)))).all()


def test_equal_seeds_give_an_interval_of_no_width():
    for seeds in (2, 9, 10, 30):
        low, high = interval(np.full(seeds, 2000.0))
        assert low == high == 2000


def test_paired_comparison_against_scipy_and_enumeration():
    result = s.paired_comparison(FIVE, OTHER, 0.95, REPETITIONS, generator())
    difference = FIVE - OTHER
    assert result.difference == pytest.approx(sum(difference) / 5)
    assert (result.low, result.high) == pytest.approx(
        scipy.stats.ttest_rel(FIVE, OTHER).confidence_interval(0.95)
    )
    flips = [abs(np.dot(signs, difference)) for signs in product((-1, 1), repeat=5)]
    assert result.p_value == np.mean(np.array(flips) >= abs(difference.sum()))


def test_pairing_finds_a_small_difference_behind_large_seed_effects():
    noise = generator(5).normal(size=8) * 1000
    shifted = noise + 1 + generator(6).normal(size=8) * 0.1
    result = s.paired_comparison(shifted, noise, 0.95, REPETITIONS, generator())
    assert result.low > 0.8
    assert result.p_value == 2 / 2**8  # no smaller p value exists for eight seeds
    assert scipy.stats.ttest_ind(shifted, noise).pvalue > 0.9


def test_paired_comparison_at_its_limits():
    assert s.paired_comparison(FIVE, FIVE, 0.95, REPETITIONS, generator()) == (0, 0, 0, 1)
    for n in (2, 5):
        shifted = s.paired_comparison(FIVE[:n] + 1, FIVE[:n], 0.95, REPETITIONS, generator())
        assert shifted == (1, 1, 1, 2 / 2**n)
    one = s.paired_comparison(FIVE[:1], OTHER[:1], 0.95, REPETITIONS, generator())
    assert one.difference == 16
    assert np.isnan(one[1:]).all()


def expanded(resampled: list[float], seeds: int) -> np.ndarray:
    """Bounds that a t interval of as many seeds would have, if `resampled` were normal."""
    factor = scipy.stats.t.ppf(0.975, seeds - 1) / scipy.stats.norm.ppf(0.975)
    z = scipy.stats.norm.ppf(0.975) * factor * np.sqrt(seeds / (seeds - 1))
    return np.quantile(resampled, scipy.stats.norm.cdf([-z, z]))


def test_probability_of_improvement_against_a_loop_and_scipy():
    probability, low, high = s.probability_of_improvement(
        [(FIVE, OTHER[:4])], 0.95, REPETITIONS, generator()
    )
    wins = [(x > y) + 0.5 * (x == y) for x in FIVE for y in OTHER[:4]]
    assert probability == sum(wins) / 20
    u = scipy.stats.mannwhitneyu(FIVE, OTHER[:4], alternative="greater").statistic
    assert probability == u / 20  # rliable's formula
    draws = generator(7)
    resampled = []
    for _ in range(REPETITIONS):
        x, y = draws.choice(FIVE, 5), draws.choice(OTHER[:4], 4)
        resampled.append(np.mean([(a > b) + 0.5 * (a == b) for a in x for b in y]))
    np.testing.assert_allclose((low, high), expanded(resampled, 4), atol=0.051)


def test_probability_of_improvement_over_several_environments():
    pairs = [(TWELVE, TWELVE[::-1] ** 2 / 5), (TWELVE - 1, TWELVE)]
    alone = [s.probability_of_improvement([p], 0.95, REPETITIONS, generator()) for p in pairs]
    probability, low, high = s.probability_of_improvement(pairs, 0.95, REPETITIONS, generator())
    assert probability == pytest.approx(np.mean([one[0] for one in alone]))
    draws, resampled = generator(7), []
    for _ in range(REPETITIONS):  # stratified: every environment's runs among themselves
        drawn = [(draws.choice(x, len(x)), draws.choice(y, len(y))) for x, y in pairs]
        resampled.append(np.mean([np.heaviside(np.subtract.outer(*d), 0.5).mean() for d in drawn]))
    np.testing.assert_allclose((low, high), expanded(resampled, 12), atol=0.03)


def test_probability_of_improvement_at_its_limits():
    def probability(x, y):
        return s.probability_of_improvement(
            [(np.array(x, float), np.array(y, float))], 0.95, REPETITIONS, generator()
        )

    assert probability([2, 3], [0, 1]) == (1, 1, 1)
    assert probability([0, 1], [2, 3]) == (0, 0, 0)
    assert probability([1, 1], [1, 1]) == (0.5, 0.5, 0.5)
    value, *bounds = probability([2], [1, 3])
    assert value == 0.5
    assert np.isnan(bounds).all()


def test_holm_by_hand():
    # Sorted: 0.005 · 4, 0.01 · 3, 0.03 · 2, 0.04 · 1 = 0.02, 0.03, 0.06, then at least 0.06.
    np.testing.assert_allclose(s.holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(s.holm([0.5, 0.9]), [1, 1])
    assert s.holm([0.05]).tolist() == [0.05]
    assert s.holm([]).tolist() == []


@pytest.mark.parametrize("p", [[-0.1], [1.1, 0.5], [float("nan")]])
def test_holm_refuses_what_is_no_p_value(p):
    with pytest.raises(ValueError, match=r"in \[0, 1\]"):
        s.holm(p)


NEVER = np.inf


def observed_minus_expected(x, y):
    """The log-rank statistic of x, event by event."""
    everything, result = [*x, *y], 0.0
    for time in sorted({time for time in everything if time < NEVER}):
        at_risk = sum(t >= time for t in everything)
        expected = everything.count(time) * sum(t >= time for t in x) / at_risk
        result += list(x).count(time) - expected
    return result


@pytest.mark.parametrize(
    ("x", "y"),
    [
        ([1, 2, 3], [4, 5, 6]),
        ([186, 201, NEVER, 140], [201, NEVER, NEVER]),
        ([10, 10, 20, NEVER], [10, 30, 30, NEVER, NEVER]),
        ([5, 40, NEVER], [10, 20, 20, 30, 50, NEVER, NEVER]),
        ([60, 70], [10, 20, 30, 40, 60, NEVER]),
    ],
)
def test_logrank_against_enumeration(x, y):
    n, everything = len(x), [*x, *y]
    outcomes = []
    for chosen in combinations(range(len(everything)), n):
        rest = [t for place, t in enumerate(everything) if place not in chosen]
        outcomes.append(observed_minus_expected([everything[place] for place in chosen], rest))
    outcomes, found = np.array(outcomes), observed_minus_expected(x, y)
    tails = np.mean(outcomes >= found - 1e-9), np.mean(outcomes <= found + 1e-9)
    expected = min(1, 2 * min(tails))
    assert s.logrank(np.array(x, float), np.array(y, float), 9999, generator()) == pytest.approx(
        expected
    )


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


def test_logrank_at_its_limits():
    same = np.array([100.0, NEVER])
    assert s.logrank(np.full(3, NEVER), np.full(3, NEVER), 999, generator()) == 1
    assert s.logrank(same, same, 999, generator()) == 1
    assert np.isnan(s.logrank(same[:1], same[1:], 999, generator()))
