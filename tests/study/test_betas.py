"""betas.csv: where β ends, its range, and its correlation with stagnation, against pandas."""

import numpy as np
import pandas as pd
import pytest
from invented import CONFIG, averages, curve, frame, noisy

from mace_rl.base.tables import read_table
from mace_study.measure import betas as b


def test_betas_are_measured_like_returns(tmp_path):
    beta = np.linspace(0.2, 0.6, 400)[::-1]
    runs = {("CartPole-v1", "mace_full", seed): frame(noisy(seed), length=7) for seed in range(3)}
    found = {run: own.assign(beta=beta) for run, own in runs.items()}
    result = b.betas_table(found, CONFIG)
    shown = result[["beta_end", "beta_lowest", "beta_highest"]]
    assert np.allclose(shown, [beta[-40:].mean(), 0.2, 0.6])
    for run, correlation in zip(found, result["stagnation_correlation"], strict=True):
        average = found[run]["extrinsic_return"].rolling(50).mean()
        stagnation = (average.shift(50) - average).shift(1).round(9)  # ties
        expected = stagnation.corr(pd.Series(beta), method="spearman")
        assert correlation == pytest.approx(expected)
    without = b.betas_table(found, CONFIG.model_copy(update={"reference_return": {}}))
    pd.testing.assert_frame_equal(without, result.iloc[:, :-2])  # no bar, nothing before it
    result.to_csv(tmp_path / "betas.csv", index=False)
    read = read_table(tmp_path / "betas.csv", b.betas_columns(CONFIG))
    pd.testing.assert_frame_equal(read, result)
    one = b.betas_table(found, CONFIG, ["stagnation_correlation_before"])
    pd.testing.assert_frame_equal(one, result[one.columns])
    assert b.in_all(curve(noisy(0)), np.full(400, 0.4)) == 0  # β that is constant


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
        return b.before(run, betas), b.after(run, betas)

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
