"""Statistics, comparisons and scores: by hand, by enumeration, by loops and scipy."""

from functools import partial
from itertools import combinations, product

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from invented import QUICK, SEEDS, STUDY, expanded, table_for_scores, table_for_tables

from mace_rl.base.tables import read_made
from mace_study import results
from mace_study.compare import aggregate as a
from mace_study.compare import statistics as s
from mace_study.compare.comparisons import comparisons
from mace_study.measure.metrics import all_metrics

REPETITIONS = 5000
HOW = 0.95, REPETITIONS
FIVE = np.array([186.0, 201.0, 249.0, 140.0, 120.0])
OTHER = np.array([170.0, 230.0, 249.0, 150.0, 95.0])
TWELVE = np.array([3.0, 1, 4, 1, 5, 9, 2, 6, 5, 3, 5, 8])
NEVER = np.inf


def generator(seed=0):
    return np.random.default_rng(seed)


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


@pytest.mark.parametrize("seeds", [6, 20])  # by all sign patterns, and by random ones
def test_a_metric_that_is_not_tested_changes_no_other(seeds):
    differences = generator(1).normal(0.3, 1, (seeds, 3))
    every = s.paired_comparison(differences, *HOW, generator())
    some = s.paired_comparison(differences, *HOW, generator(), [True, False, True])
    expected = every._replace(p_value=np.where([1, 0, 1], every.p_value, np.nan))
    np.testing.assert_equal(some, expected)


def test_a_tie_is_one_whatever_rounding_makes_of_it():
    """Many sign patterns of whole numbers have the same small sum, in any unit."""
    whole = np.array([-40, 24, -4, -25, 14, -17, -25, -37, 10, -12, 13, 33, 4, 7, -39, 16, 9, 70])
    drawn = generator()
    s.draws(len(whole), 10_000, drawn)  # for the interval
    sums = s.signs(10_000, len(whole), drawn).astype(int) @ whole
    sides = np.sum(sums <= whole.sum()), np.sum(sums >= whole.sum())
    for unit in (1.0, 0.001, 1 / 3):
        found = s.paired_comparison(whole * unit, 0.95, 10_000, generator()).p_value
        assert found == pytest.approx(2 * (1 + min(sides)) / 10_001)


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
    pair = np.array(x * 5, float)[:, None], np.array(y * 5, float)[:, None]
    assert s.probability_of_improvement([pair], *HOW, generator()) == (expected,) * 3
    for few in ((pair[0][:9], pair[1]), (pair[0], pair[1][:9])):  # a certain 1 would be a lie
        value, *bounds = s.probability_of_improvement([few], *HOW, generator())
        assert value == expected and np.isnan(bounds).all()


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_against_a_loop(p):
    ordered, m = sorted(p), len(p)
    scaled = [(p_value, min(1, p_value * (m - i))) for i, p_value in enumerate(ordered)]
    expected = [max(one for smaller, one in scaled if smaller <= value) for value in p]
    assert s.holm(p).tolist() == pytest.approx(expected)


def observed_minus_expected(x, y):
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
        right_censored = scipy.stats.CensoredData.right_censored
        censored = [right_censored(np.minimum(v, 200), v == NEVER) for v in seen]
        expected = scipy.stats.logrank(*censored).pvalue
        assert s.logrank(*seen, 9999, generator()) == pytest.approx(expected, abs=0.02)
    for several in (y[:1], y):
        assert np.isnan(s.logrank(x[:1], several, 999, generator()))


METRICS = all_metrics(QUICK)
metrics = partial(table_for_tables, METRICS)
UNITS = {metric.name: metric.unit for metric in METRICS}
COMPARED = 0.95, 1000


def test_which_pairs_are_compared_where():
    frame = comparisons(metrics(variants=["ppo", "mace_full"]), QUICK)
    assert set(zip(frame["variant"], frame["baseline"], strict=True)) == {("mace_full", "ppo")}
    frame = comparisons(metrics(variants=["ppo"]), QUICK)
    assert frame.empty and "p_holm" in frame
    alone = comparisons(metrics(["CartPole-v1"]), QUICK)  # not repeated as all environments
    assert set(alone["env"]) == {"CartPole-v1"}
    frame = comparisons(metrics(seeds=1), QUICK)  # has differences and no p values
    assert frame[["low", "high", "p_value", "p_holm", "probability_low"]].isna().all(axis=None)
    assert frame["probability"].notna().all()
    assert frame.loc[frame["env"] != "all", "difference"].notna().all()


def test_comparisons_of_pairs():
    """Each is what the statistics above say of the seeds' pairs."""
    returns = {"ppo": range(9), "mace_fixed": range(40, 58, 2), "mace_full": [4] * 9}
    frame = metrics(["CartPole-v1", "Acrobot-v1"], seeds=9, final_return=returns)
    shuffled = frame.sample(frac=1, random_state=0)  # pairs are those of a seed, in any order
    result = comparisons(shuffled, QUICK)
    assert len(result) == 3 * sum(metric.compared for metric in METRICS) * 3
    assert "sample_efficiency_public_code" not in set(result["metric"])
    together = result[result["env"] == "all"]
    result = result.drop(together.index)
    assert comparisons(shuffled, QUICK, together=False).equals(result)
    for row in result.itertuples():
        runs = frame[frame["env"] == row.env].set_index("variant")[row.metric]
        x, y = (runs[name].to_numpy(float) for name in (row.variant, row.baseline))
        expected = s.paired_comparison(x - y, *COMPARED, generator())
        assert (row.difference, row.low, row.high) == pytest.approx(expected[:3])
        if UNITS[row.metric] == "episodes":
            p_value = s.logrank(x, y, COMPARED[1], generator())
            assert (row.test, row.p_value) == ("log-rank", p_value)
            x, y = -x, -y
        else:
            assert (row.test, row.p_value) == ("sign-flip", expected.p_value)
        assert row.probability == pytest.approx(scipy.stats.mannwhitneyu(x, y).statistic / 81)
        assert np.isnan([row.probability_low, row.probability_high]).all()  # of nine seeds
        assert (row.seeds, row.censored) == (9, 0)
    assert result["p_holm"].tolist() == pytest.approx(s.holm(result["p_value"].tolist()).tolist())
    # Over the environments together: the mean probability.
    untested = ["difference", "low", "high", "p_value", "p_holm"]
    assert together[untested].isna().all(axis=None)
    keys = ["metric", "variant", "baseline"]
    expected = result.groupby(keys)["probability"].mean()
    assert together.set_index(keys)["probability"].to_dict() == pytest.approx(expected.to_dict())


def kaplan_meier_mean(values, flags, end):
    """∫₀ᴱ S(t) dt by scipy's estimate of S."""
    sample = scipy.stats.CensoredData.right_censored(values, flags)
    survival = scipy.stats.ecdf(sample).sf
    steps = np.r_[0, survival.quantiles[survival.quantiles < end], end]
    return float(np.sum(np.diff(steps) * np.r_[1, survival.evaluate(steps[1:-1])]))


@pytest.mark.parametrize("budgets", [(2000, 2000), (2000, 1000)], ids=["one budget", "two"])
def test_censoring_is_respected(budgets):
    ends = dict(zip(("mace_full", "ppo"), budgets, strict=True))
    times = {
        "mace_full": [900, 950, 1300, 1800, 2000, 2000, 100, 2000],
        "ppo": [700, 980, 990, ends["ppo"], ends["ppo"], 300, ends["ppo"], 400],
    }
    flags = {"mace_full": [0, 0, 0, 0, 0, 1, 0, 1], "ppo": [0, 0, 0, 1, 1, 0, 1, 0]}
    values = {"sample_efficiency": times, "sample_efficiency_censored": flags}
    values["episodes"] = {name: [ends[name]] * 8 for name in ends}
    frame = metrics(["CartPole-v1"], list(times), seeds=8, **values)
    result = comparisons(frame, QUICK).set_index("metric").loc["sample_efficiency"]
    end, restricted, events = min(budgets), {}, {}
    for name in times:
        late = np.array(flags[name], bool) | (np.array(times[name]) > end)
        restricted[name] = kaplan_meier_mean(np.minimum(times[name], end), late, end)
        events[name] = np.where(late, np.inf, times[name])
    assert result["difference"] == pytest.approx(restricted["mace_full"] - restricted["ppo"])
    assert result["low"] < result["difference"] < result["high"]
    p_value = s.logrank(events["mace_full"], events["ppo"], COMPARED[1], generator())
    assert (result["test"], result["p_value"]) == ("log-rank", p_value)
    assert result["censored"] == sum(np.isinf(values).sum() for values in events.values())


def test_aggregate_against_a_loop():
    """Scores between random (0) and the best run (1), resampled within environments."""
    frame = table_for_scores(SEEDS)
    score = a.scores(frame, STUDY.metrics)
    for (env, metric), own in score.groupby(["env", "metric"]):
        returns = frame.loc[frame["env"] == env, metric]
        random = STUDY.metrics.random_return_in(env)
        expected = (returns - random) / (returns.max() - random)
        assert own["score"].tolist() == pytest.approx(expected.tolist())
    found = a.aggregate(frame, STUDY.metrics).set_index(["metric", "variant"])
    runs = score[(score["metric"] == "final_return") & (score["variant"] == "ppo")]
    row = found.loc["final_return", "ppo"]
    assert (row["runs"], row["mean"]) == (22, pytest.approx(runs["score"].mean()))
    assert row["iqm"] == pytest.approx(runs["score"].sort_values().iloc[5:17].mean())
    draws, resampled = np.random.default_rng(9), []
    strata = [group["score"].to_numpy() for _, group in runs.groupby("env")]
    for _ in range(4000):
        drawn = np.concatenate([draws.choice(values, len(values)) for values in strata])
        resampled.append(np.mean(np.sort(drawn)[5:17]))
    expected = expanded(resampled, 10)
    bounds = [row["iqm_low"], row["iqm_high"]]
    np.testing.assert_allclose(bounds, expected, atol=0.1 * np.ptp(expected))


def test_nobody_better_than_random_counts_as_zero_and_nine_seeds_have_no_interval():
    frame = table_for_scores(SEEDS)
    hopper = frame["env"] == "HopperBulletEnv-v0"
    frame.loc[hopper, list(a.SCORED)] = -3.0
    found = a.aggregate(frame, STUDY.metrics).set_index(["metric", "variant"])["mean"]
    other = a.scores(frame[~hopper], STUDY.metrics)
    for key, runs in other.groupby(["metric", "variant"]):
        assert found[key] == pytest.approx(runs["score"].sum() / 22)
    few = a.aggregate(table_for_scores({"CartPole-v1": 9}), STUDY.metrics)
    assert few["mean"].notna().all()
    assert few[["mean_low", "mean_high", "iqm_low", "iqm_high"]].isna().all(axis=None)


def test_without_a_variant_in_all_environments_the_aggregate_is_a_head_alone(tmp_path):
    frame = table_for_scores(SEEDS)
    apart = frame[(frame["env"] == "CartPole-v1") == (frame["variant"] == "ppo")]
    results.write_table(tmp_path / "aggregate.csv", a.aggregate(apart, STUDY.metrics))
    back = read_made(tmp_path / "aggregate.csv")
    columns = a.aggregate(frame, STUDY.metrics).columns
    assert back.empty and list(back.columns) == list(columns)
