"""The ceiling: forks repeat themselves; the oracle gains nothing where nothing helps."""

import numpy as np
import pandas as pd
import pytest
from invented import STUDY
from scipy import stats
from shared import finish

from mace_rl.bonus.flag import FlagNovelty
from mace_rl.library import settings
from mace_rl.training.trainer import Trainer
from mace_study.compare.ceiling import effects, gains, over_ppo, stretches
from mace_study.show.worlds import draw_gains
from tools import ceiling


class NoBonus(FlagNovelty):
    """A novelty that is 0: β has nothing to weigh."""

    def __call__(self, states):
        return np.zeros(len(states))


def test_a_fork_goes_on_from_the_state_with_other_random_numbers():
    config = settings("CartPole-v1", "mace_fixed", seed=800, episodes=12)
    trainer = finish(ceiling.with_beta(config, 0.4))
    state = trainer.state_dict()
    forks = [
        ceiling.go_on(ceiling.with_beta(config, beta), state, stream, 5)
        for beta, stream in ((0.0, 1), (0.0, 1), (0.0, 2), (1.0, 1))
    ]
    told = [ceiling.returns(fork, 12).tolist() for fork in forks]
    assert all(fork.records[:12] == trainer.records for fork in forks)
    assert told[0] == told[1] != told[2] and len(told[0]) == 5
    assert [record.beta for record in forks[3].records[10:]] == [0.4, 0.4, 1, 1, 1, 1, 1]
    again = Trainer(ceiling.with_beta(config, 0.4))
    again.load_state_dict(state)
    assert again.records == trainer.records  # forks have not changed it


def test_effect_and_noise_by_hand():
    """Two forks, four βs, two streams, 20 episodes: β = 1 earns 3 more in the first 10 of them."""
    forks = np.zeros((2, 4, 2, 20))
    forks[:, -1, :, :10] = 3
    forks[:, :, 0] += 1
    found = list(ceiling.effects(forks))
    assert [stretch for stretch, *_ in found] == [1, 10, 20]
    assert [effect for _, effect, _ in found] == pytest.approx([3, 3, 1.5])
    assert [noise for *_, noise in found] == pytest.approx([np.std([0, 1], ddof=1)] * 3)
    assert stretches(1.0, 1.0) == pytest.approx(15.7, abs=0.01)  # two samples, textbook


@pytest.mark.slow
def test_where_beta_has_no_effect_the_oracle_gains_nothing(monkeypatch):
    """What is reported is not what was chosen by: its mean is that of a constant, by chance."""
    monkeypatch.setattr(ceiling, "STEP", 3)
    monkeypatch.setattr(ceiling, "LAST", 9)
    monkeypatch.setattr(ceiling, "STREAMS", 2)
    novelty = {"kind": "custom", "estimator": "test_ceiling:NoBonus"}
    gains, chosen = [], []
    for seed in range(800, 830):
        config = settings("CartPole-v1", "mace_fixed", seed=seed, novelty=novelty)
        mean, forks = ceiling.oracle(config, 4)
        constant = ceiling.with_beta(config.model_copy(update={"episodes": 9}), 0.4)
        expected = ceiling.returns(finish(constant), 0).mean()
        gains.append(mean - expected)
        chosen.append(forks.mean(axis=(2, 3)).max(axis=1).mean() - forks.mean())
    error = np.std(gains, ddof=1) / np.sqrt(len(gains))
    assert abs(np.mean(gains)) < 2 * error
    assert np.mean(chosen) > 2 * error  # by which chance alone seems to gain


def rows_by_hand(seeds: int = 5) -> pd.DataFrame:
    """As tools.ceiling writes them, with a world: the oracle is near 30, PPO near 20."""
    draws = np.random.default_rng(0)
    found = []
    for seed in range(800, 800 + seeds):
        start = {"world": "plain", "env": "CartPole-v1", "seed": seed, "episodes": 20}
        for who, level in (("oracle", 30.0), ("ppo", 20.0), ("beta_0.4", 25.0)):
            own = start | {"who": who, "mean_return": level + draws.normal()}
            stretches = (1, 10, 20) if who == "oracle" else (np.nan,)
            for stretch in stretches:
                numbers = {"effect": 2 + draws.normal(), "noise": 4 + draws.random(), "forks": 29}
                found.append(own | {"stretch": stretch} | (numbers if who == "oracle" else {}))
    return pd.DataFrame(found)


def test_gains_and_effects_are_means_over_seeds_with_student_s_interval():
    rows = rows_by_hand()
    first = rows.drop_duplicates(["seed", "who"]).set_index(["who", "seed"])["mean_return"]
    for row in gains(rows, STUDY.metrics).itertuples():
        difference = first["oracle"] - first[row.over]
        interval = stats.t.interval(0.95, 4, difference.mean(), stats.sem(difference))
        assert (row.gain, row.low, row.high) == pytest.approx((difference.mean(), *interval))
        assert (row.world, row.episodes, row.seeds) == ("plain", 20, 5)
    oracle = rows[rows["who"] == "oracle"]
    for row in effects(rows, STUDY.metrics).itertuples():
        own = oracle[oracle["stretch"] == row.stretch]
        assert row.effect == pytest.approx(own["effect"].mean())
        assert row.noise == pytest.approx(np.sqrt(np.mean(own["noise"] ** 2)))
        each = 2 * (2.801585 * row.noise / row.effect) ** 2
        assert (row.stretches, row.needed) == pytest.approx((each, 2 * each * row.stretch))


def test_gains_over_ppo_are_shares_of_all_there_is():
    means = {("CartPole-v1", "ppo"): {3: 20.0, 4: 40.0}, ("CartPole-v1", "x"): {3: 30.0, 4: 60.0}}
    ((env, variant, seeds, gain, low, high),) = over_ppo(means, STUDY.metrics).to_numpy()
    everything = STUDY.metrics.reference_return[env] - STUDY.metrics.random_return[env]
    assert (variant, seeds, gain) == ("x", 2, pytest.approx(15 / everything)) and low < gain < high


def test_the_picture_has_a_panel_for_each_task_and_one_axis():
    own = {"env": "CartPole-v1", "seeds": 20, "gain": 0.1, "low": 0.0, "high": 0.3}
    rows = [own | {"world": "control", "variant": "oracle, H = 20", "low": -0.4}]
    names = "oracle, H = 20", "mace_full", "oracle, H = 50"
    rows += [own | {"world": "plain", "variant": name} for name in names]
    panels = draw_gains(pd.DataFrame(rows)).axes
    assert [axes.get_title() for axes in panels] == ["CartPole-v1 (plain)", "CartPole-v1 (control)"]
    assert len({axes.get_xlim() for axes in panels}) == 1
    assert panels[0].get_xlim()[0] < -0.4 and panels[0].get_xlim()[1] > 0.3
    labels = [[label.get_text() for label in axes.get_yticklabels()] for axes in panels]
    assert labels == [["oracle, H = 20", "oracle, H = 50", "mace_full"], ["oracle, H = 20"]]
