"""Comparisons, regret and scores from small frames, against scipy, enumeration and loops."""

from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import SEEDS, expanded, table_for_scores, table_for_tables

from mace_rl.config.results import RegretConfig
from mace_rl.config.study import Study, read_study
from mace_rl.results import aggregate as a
from mace_rl.results.comparisons import comparisons, regret
from mace_rl.results.metrics import all_metrics
from mace_rl.results.statistics import logrank, probability_of_improvement

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


AREAS = {  # by environment: of the meta network and of three constants
    "CartPole-v1": {"mace_full": 300.0, "ppo": 200.0, "mace_fixed": 350.0, "low": 340.0},
    "Acrobot-v1": {"mace_full": -120.0, "ppo": -110.0, "mace_fixed": -400.0, "low": -300.0},
}
CHOSEN = RegretConfig(variant="mace_full", constants=["ppo", "mace_fixed", "low"])
REGRET = SETTINGS.model_copy(update={"regret": CHOSEN})


def regret_of(seeds=8, noise=0.0, draw=1, **areas):
    """The frame of regret.csv, and that of metrics.csv that it is from."""
    frame = metrics(list(AREAS), list(AREAS["CartPole-v1"]), seeds)
    draws = np.random.default_rng(draw)
    means = [areas.get(row.variant, AREAS[row.env][row.variant]) for row in frame.itertuples()]
    frame["area_under_curve"] = means + noise * draws.normal(size=len(frame))
    return regret(frame, REGRET).set_index("env"), frame


def test_regret_by_hand():
    result, _ = regret_of()
    by_hand = {"CartPole-v1": 50 / (350 - 22.1), "Acrobot-v1": 10 / (-110 + 499.1)}
    by_hand["all"] = np.mean(list(by_hand.values()))
    for name, value in by_hand.items():
        assert result.loc[name, ["regret", "low", "high"]].tolist() == pytest.approx([value] * 3)
    assert result["best_constant"].tolist() == ["mace_fixed", "ppo", ""]
    assert result[["best_area", "variant_area"]].to_numpy()[:2].tolist() == [
        *([350, 300], [-110, -120])
    ]
    assert (result["seeds"] == 8).all()
    constants = dict.fromkeys(("ppo", "mace_fixed", "low"), -600.0)  # none beats random
    assert regret_of(**constants)[0][["regret", "low", "high"]].isna().all(axis=None)
    one_seed, _ = regret_of(seeds=1)
    assert one_seed["regret"].notna().all()
    assert one_seed[["low", "high"]].isna().all(axis=None)


def test_the_interval_of_regret_chooses_the_best_constant_anew():
    result, frame = regret_of(noise=30)
    draws, regrets = np.random.default_rng(5), {name: [] for name in AREAS}
    for name, random in (("CartPole-v1", 22.1), ("Acrobot-v1", -499.1)):
        runs = frame[frame["env"] == name]
        wide = runs.pivot(index="seed", columns="variant", values="area_under_curve")
        for _ in range(2000):
            means = wide.loc[draws.integers(8, size=8)].mean()
            best = means.drop("mace_full").max()
            regrets[name].append((best - means["mace_full"]) / (best - random))
    regrets["all"] = np.mean(list(regrets.values()), axis=0)
    for name, drawn in regrets.items():
        found, expected = result.loc[name, ["low", "high"]].astype(float), expanded(drawn, 8)
        np.testing.assert_allclose(found, expected, atol=0.12 * np.ptp(expected))


def test_environments_are_measured_apart_and_may_have_different_seeds():
    all_of_it, frame = regret_of(noise=30)
    fewer = frame[(frame["env"] != "Acrobot-v1") | (frame["seed"] < 5)]
    found = regret(fewer, REGRET).set_index("env")
    assert found["seeds"].to_dict() == {"CartPole-v1": 8, "Acrobot-v1": 5, "all": 5}
    both = found.loc[["CartPole-v1", "Acrobot-v1"], "regret"].mean()
    assert found.loc["all", "regret"] == pytest.approx(both)
    alone = regret(frame[frame["env"] == "Acrobot-v1"], REGRET).set_index("env")
    pd.testing.assert_frame_equal(all_of_it.loc[["Acrobot-v1"]], alone, check_exact=True)


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
