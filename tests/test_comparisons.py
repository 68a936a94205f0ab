"""Comparisons and regret from a small frame, against scipy, enumeration and loops."""

from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import table_for_tables

from mace_rl.config.results import RegretConfig
from mace_rl.config.study import read_study
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


def test_pairs_of_which_a_variant_is_missing_are_left_out():
    frame = comparisons(metrics(variants=["ppo", "mace_full"]), SETTINGS)
    assert set(zip(frame["variant"], frame["baseline"], strict=True)) == {("mace_full", "ppo")}
    frame = comparisons(metrics(variants=["ppo"]), SETTINGS)
    assert frame.empty
    assert "p_holm" in frame


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
            better = np.less.outer(x, y)
        else:
            flips = np.mean(abs(signs @ (x - y)) >= abs(sum(x - y)))
            assert (row.test, row.p_value) == ("sign-flip", flips)
            better = np.greater.outer(x, y)
        assert row.probability == pytest.approx(np.mean(better + np.equal.outer(x, y) / 2))
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
    alone = result.groupby(["metric", "variant", "baseline"], sort=False)["probability"].mean()
    assert together["probability"].tolist() == pytest.approx(alone.tolist())
    row = together.iloc[0]  # final_return of mace_fixed and ppo
    runs = [frame[frame["env"] == name].set_index("variant") for name in frame["env"].unique()]
    pairs = [
        [one.loc[name, row["metric"]].to_numpy() for name in (row["variant"], row["baseline"])]
        for one in runs
    ]
    expected = probability_of_improvement(pairs, *HOW, generator())
    assert tuple(row[["probability", "probability_low", "probability_high"]]) == expected


def test_one_environment_is_not_repeated_as_all():
    assert set(comparisons(metrics(["CartPole-v1"]), SETTINGS)["env"]) == {"CartPole-v1"}


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


def regret_of(seeds=8, noise=0.0, draw=1, **areas):
    """The frame of regret.csv, and that of metrics.csv that it is from."""
    frame = metrics(list(AREAS), list(AREAS["CartPole-v1"]), seeds)
    draws = np.random.default_rng(draw)
    means = [areas.get(row.variant, AREAS[row.env][row.variant]) for row in frame.itertuples()]
    frame["area_under_curve"] = means + noise * draws.normal(size=len(frame))
    chosen = RegretConfig(variant="mace_full", constants=["ppo", "mace_fixed", "low"])
    settings = SETTINGS.model_copy(update={"regret": chosen})
    return regret(frame, settings).set_index("env"), frame


def test_regret_by_hand():
    result, _ = regret_of()
    by_hand = {"CartPole-v1": 50 / (350 - 22.1), "Acrobot-v1": 10 / (-110 + 499.1)}
    for name, value in by_hand.items():
        assert result.loc[name, ["regret", "low", "high"]].tolist() == pytest.approx([value] * 3)
    assert result["best_constant"].tolist() == ["mace_fixed", "ppo", ""]
    assert result["best_area"].tolist()[:2] == [350, -110]
    assert result["variant_area"].tolist()[:2] == [300, -120]
    assert result.loc["all", "regret"] == pytest.approx(np.mean(list(by_hand.values())))
    assert (result["seeds"] == 8).all()


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
        z = np.sqrt(8 / 7) * scipy.stats.t.ppf(0.975, 7)
        expected = np.quantile(drawn, scipy.stats.norm.cdf([-z, z]))
        found = result.loc[name, ["low", "high"]].astype(float)
        np.testing.assert_allclose(found, expected, atol=0.12 * np.ptp(expected))


def test_the_regret_of_equals_errs_upward():
    """The best of three equal constants is lucky: a variant that is just as good has a regret."""
    equal = dict.fromkeys(AREAS["CartPole-v1"], 100.0)
    regrets = [
        regret_of(noise=20, draw=draw, **equal)[0].loc["all", "regret"] for draw in range(20)
    ]
    assert np.mean(regrets) > 2 * scipy.stats.sem(regrets)


def test_environments_may_have_different_seeds():
    _, frame = regret_of(noise=30)
    fewer = frame[(frame["env"] != "Acrobot-v1") | (frame["seed"] < 5)]
    settings = SETTINGS.model_copy(
        update={"regret": RegretConfig(variant="mace_full", constants=["ppo", "mace_fixed", "low"])}
    )
    found = regret(fewer, settings).set_index("env")
    assert found["seeds"].to_dict() == {"CartPole-v1": 8, "Acrobot-v1": 5, "all": 5}
    both = found.loc[["CartPole-v1", "Acrobot-v1"], "regret"].mean()
    assert found.loc["all", "regret"] == pytest.approx(both)


def test_regret_without_a_constant_that_beats_random_is_nan():
    constants = dict.fromkeys(("ppo", "mace_fixed", "low"), -600.0)
    result, _ = regret_of(**constants)
    assert result[["regret", "low", "high"]].isna().all(axis=None)
    one_seed, _ = regret_of(seeds=1)
    assert one_seed["regret"].notna().all()
    assert one_seed[["low", "high"]].isna().all(axis=None)


def test_a_cell_does_not_depend_on_the_other_environments():
    result, frame = regret_of(noise=30)
    alone = frame[frame["env"] == "Acrobot-v1"]
    settings = SETTINGS.model_copy(
        update={"regret": RegretConfig(variant="mace_full", constants=["ppo", "mace_fixed", "low"])}
    )
    (_, expected), *rest = regret(alone, settings).iterrows()
    assert not rest  # one environment is not repeated as all of them
    pd.testing.assert_series_equal(
        result.loc["Acrobot-v1"], expected.drop("env"), check_names=False, check_exact=True
    )
