"""Comparisons and scores from small frames, against scipy, enumeration and loops."""

from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from invented import SEEDS, expanded, table_for_scores, table_for_tables

from mace_rl.study.compare import aggregate as a
from mace_rl.study.compare.comparisons import comparisons
from mace_rl.study.compare.statistics import logrank, probability_of_improvement
from mace_rl.study.config import Study, read_study
from mace_rl.study.measure.metrics import all_metrics

SETTINGS = read_study([Path(__file__).parents[1] / "config.yaml"]).metrics.model_copy(
    update={"bootstrap_repetitions": 1000}
)
METRICS = all_metrics(SETTINGS)
metrics = partial(table_for_tables, METRICS)
UNITS = {metric.name: metric.unit for metric in METRICS}
HOW = (0.95, SETTINGS.bootstrap_repetitions)


def generator():
    return np.random.default_rng(SETTINGS.bootstrap_seed)


def test_which_pairs_are_compared_where():
    frame = comparisons(metrics(variants=["ppo", "mace_full"]), SETTINGS)
    assert set(zip(frame["variant"], frame["baseline"], strict=True)) == {("mace_full", "ppo")}
    frame = comparisons(metrics(variants=["ppo"]), SETTINGS)
    assert frame.empty and "p_holm" in frame
    alone = comparisons(metrics(["CartPole-v1"]), SETTINGS)  # not repeated as all environments
    assert set(alone["env"]) == {"CartPole-v1"}


def test_comparisons_against_scipy_and_enumeration():
    frame = metrics(
        ["CartPole-v1", "Acrobot-v1"],
        seeds=9,
        final_return={"ppo": range(9), "mace_fixed": range(40, 58, 2), "mace_full": [4] * 9},
    )
    shuffled = frame.sample(frac=1, random_state=0)  # pairs are those of a seed, in any order
    result = comparisons(shuffled, SETTINGS)
    assert len(result) == 3 * len(METRICS) * 3
    signs = np.array(list(product((-1, 1), repeat=9)))
    together = result[result["env"] == "all"]
    result = result.drop(together.index)
    for row in result.itertuples():
        runs = frame[frame["env"] == row.env].set_index("variant")[row.metric]
        x, y = (runs[name].to_numpy(float) for name in (row.variant, row.baseline))
        paired = scipy.stats.ttest_rel(x, y)
        assert row.difference == pytest.approx(np.mean(x - y))
        assert (row.low, row.high) == pytest.approx(paired.confidence_interval(0.95))
        if UNITS[row.metric] == "episodes":
            assert (row.test, row.p_value) == ("log-rank", logrank(x, y, HOW[1], generator()))
            x, y = -x, -y
        else:
            flips = np.mean(abs(signs @ (x - y)) >= abs(sum(x - y)))
            assert (row.test, row.p_value) == ("sign-flip", flips)
        u = scipy.stats.mannwhitneyu(x, y).statistic
        assert row.probability == pytest.approx(u / 81)
        assert row.probability_low <= row.probability <= row.probability_high
        assert (row.seeds, row.censored) == (9, 0)
    # Holm: the k-th smallest of m times m - k + 1, and never less than one before.
    p = sorted(result["p_value"])
    holm = [max(min(1, p[i] * (len(p) - i)) for i in range(k + 1)) for k in range(len(p))]
    holm = dict(zip(p, holm, strict=True))  # equal ones are adjusted equally
    assert result["p_holm"].tolist() == pytest.approx([holm[value] for value in result["p_value"]])
    # Over the environments together: the mean probability.
    untested = ["difference", "low", "high", "p_value", "p_holm"]
    assert together[untested].isna().all(axis=None)
    row = together.iloc[0]  # final_return of mace_fixed and ppo
    runs = [frame[frame["env"] == name].set_index("variant") for name in frame["env"].unique()]
    pairs = [
        [one.loc[name, [row["metric"]]].to_numpy() for name in (row["variant"], row["baseline"])]
        for one in runs
    ]
    expected = probability_of_improvement(pairs, *HOW, generator())
    assert tuple(row[["probability", "probability_low", "probability_high"]]) == expected


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
    frame = metrics(
        ["CartPole-v1"],
        list(times),
        seeds=8,
        sample_efficiency=times,
        sample_efficiency_censored=flags,
        episodes={name: [ends[name]] * 8 for name in ends},
    )
    result = comparisons(frame, SETTINGS).set_index("metric").loc["sample_efficiency"]
    end, restricted, events = min(budgets), {}, {}
    for name in times:
        late = np.array(flags[name], bool) | (np.array(times[name]) > end)
        restricted[name] = kaplan_meier_mean(np.minimum(times[name], end), late, end)
        events[name] = np.where(late, np.inf, times[name])
    assert result["difference"] == pytest.approx(restricted["mace_full"] - restricted["ppo"])
    assert result["low"] < result["difference"] < result["high"]
    p_value = logrank(events["mace_full"], events["ppo"], HOW[1], generator())
    assert (result["test"], result["p_value"]) == ("log-rank", p_value)
    assert result["censored"] == sum(np.isinf(values).sum() for values in events.values())


def test_one_seed_has_a_difference_and_no_p_value():
    result = comparisons(metrics(seeds=1), SETTINGS)
    assert result[["low", "high", "p_value", "p_holm", "probability_low"]].isna().all(axis=None)
    assert result["probability"].notna().all()
    assert result.loc[result["env"] != "all", "difference"].notna().all()


def test_aggregate_against_a_loop(study: Study):
    """Scores between random (0) and the best run (1), resampled within environments."""
    frame = table_for_scores(SEEDS)
    score = a.scores(frame, study.metrics)
    for (env, metric), own in score.groupby(["env", "metric"]):
        returns = frame.loc[frame["env"] == env, metric]
        random = study.metrics.random_return_in(env)
        expected = (returns - random) / (returns.max() - random)
        assert own["score"].tolist() == pytest.approx(expected.tolist())
    found = a.aggregate(frame, study.metrics).set_index(["metric", "variant"])
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


def test_nobody_better_than_random_counts_as_zero_and_one_seed_has_no_interval(study: Study):
    frame = table_for_scores(SEEDS)
    hopper = frame["env"] == "HopperBulletEnv-v0"
    frame.loc[hopper, list(a.SCORED)] = -3.0
    found = a.aggregate(frame, study.metrics).set_index(["metric", "variant"])["mean"]
    other = a.scores(frame[~hopper], study.metrics)
    for key, runs in other.groupby(["metric", "variant"]):
        assert found[key] == pytest.approx(runs["score"].sum() / 22)
    one = a.aggregate(table_for_scores({"CartPole-v1": 1}), study.metrics)
    assert one["mean"].notna().all()
    assert one[["mean_low", "mean_high", "iqm_low", "iqm_high"]].isna().all(axis=None)
