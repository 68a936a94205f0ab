"""Scores over all environments, against independent computations."""

import numpy as np
import pytest
import scipy.stats
from invented import SEEDS, table_for_scores

from mace_rl.config.study import Study
from mace_rl.results import aggregate as a


def test_scores_are_between_random_and_the_best_run(study: Study) -> None:
    frame = table_for_scores(SEEDS)
    found = a.scores(frame, study.metrics).set_index(["env", "metric", "variant", "seed"])["score"]
    best = frame.loc[frame["env"] == "CartPole-v1", "final_return"].max()
    for _, row in frame[frame["env"] == "CartPole-v1"].iterrows():
        expected = (row["final_return"] - 22.1) / (best - 22.1)
        key = "CartPole-v1", "final_return", row["variant"], row["seed"]
        assert found[key] == pytest.approx(expected)
    assert found.groupby(["env", "metric"]).max().tolist() == [1.0] * 4


def test_an_environment_that_nobody_is_better_in_than_random_counts_as_zero(study: Study) -> None:
    frame = table_for_scores(SEEDS)
    for metric in a.SCORED:
        frame.loc[frame["env"] == "HopperBulletEnv-v0", metric] = -3.0
    found = a.scores(frame, study.metrics)
    assert set(found.loc[found["env"] == "HopperBulletEnv-v0", "score"]) == {0.0}
    other = a.scores(frame[frame["env"] == "CartPole-v1"], study.metrics)
    means = a.aggregate(frame, study.metrics).set_index(["metric", "variant"])["mean"]
    for (metric, variant), runs in other.groupby(["metric", "variant"]):
        assert means[metric, variant] == pytest.approx(runs["score"].sum() / 22)


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    values = np.array([9.0, -100, 3, 4, 5, 6, 1000, 0])
    assert a.interquartile_mean(values) == np.mean([3, 4, 5, 6])
    two = np.stack([values, values[::-1] + 1])
    np.testing.assert_allclose(a.interquartile_mean(two), [4.5, 5.5])


def test_aggregate_against_a_loop(study: Study) -> None:
    frame = table_for_scores(SEEDS)
    found = a.aggregate(frame, study.metrics).set_index(["metric", "variant"])
    score = a.scores(frame, study.metrics)
    runs = score[(score["metric"] == "final_return") & (score["variant"] == "ppo")]
    row = found.loc["final_return", "ppo"]
    assert row["runs"] == 22
    assert row["mean"] == pytest.approx(runs["score"].mean())
    assert row["iqm"] == pytest.approx(runs["score"].sort_values().iloc[5:17].mean())
    draws, resampled = np.random.default_rng(9), []
    strata = [group["score"].to_numpy() for _, group in runs.groupby("env")]
    for _ in range(4000):
        drawn = np.concatenate([draws.choice(values, len(values)) for values in strata])
        resampled.append(np.mean(np.sort(drawn)[5:17]))
    z = scipy.stats.t.ppf(0.975, 9) * np.sqrt(10 / 9)
    expected = np.quantile(resampled, scipy.stats.norm.cdf([-z, z]))
    width = np.ptp(expected)
    np.testing.assert_allclose([row["iqm_low"], row["iqm_high"]], expected, atol=0.1 * width)


def test_one_seed_allows_no_interval(study: Study) -> None:
    found = a.aggregate(table_for_scores({"CartPole-v1": 1}), study.metrics)
    assert found["mean"].notna().all()
    assert found[["mean_low", "mean_high", "iqm_low", "iqm_high"]].isna().all(axis=None)
