"""metrics.csv: its rows, what is refused in it, metrics of the user's own and those of a study."""

import sys
from itertools import product

import numpy as np
import pandas as pd
import pytest
from invented import CONFIG, SETTINGS, frame, noisy

from mace_rl.base.tables import RecordError
from mace_rl.config.section import ConfigError, check
from mace_study.config.metrics import GOALS, MetricsConfig
from mace_study.measure import metrics as m
from mace_study.measure.metrics_csv import metrics_of_run, metrics_table, read_metrics

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
    "convergence_steps_public_code": 286,  # its floor: int(0.3 · 951) + 1
    "sample_efficiency_public_code": 201,
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
    return metrics_table(runs(), settings)


def test_a_row_holds_each_metric_under_its_name():
    returns = np.concatenate([np.full(200, 20.0), np.full(800, 500.0)])
    run = "CartPole-v1", "ppo", 4
    row = metrics_of_run(frame(returns, 9), run, CONFIG, m.all_metrics(CONFIG))
    assert row == ROW
    assert list(row) == COLUMNS


def test_the_table_has_every_run_and_counts_censored_ones():
    result = table()
    assert list(result[COLUMNS[:4]].itertuples(index=False, name=None)) == WANTED
    assert not result.isna().any(axis=None)
    acrobot = result[result["env"] == "Acrobot-v1"]  # the bar is above the final return
    assert (acrobot[["sample_efficiency", "sample_efficiency_censored"]] == [400, 1]).all(axis=None)


def change(row, column, value):
    def damage(lines):
        cells = lines[row].split(",")
        cells[COLUMNS.index(column)] = value
        lines[row] = ",".join(cells)

    return damage


DAMAGE = {
    "a run lost": (lambda lines: lines.pop(3), "line 4: the run .*1, 400. stands where .*3, 400. "),
    "a run twice": (lambda lines: lines.append(lines[1]), "line 10: the run .* where None belongs"),
    "empty": (change(5, "convergence_steps", ""), "line 6: convergence_steps is ''"),
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
        read_metrics(path, WANTED, CONFIG)
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
    end = COLUMNS.index(f"{EPISODES[0]}_censored")  # of the metrics: then come their flags
    assert list(result.columns) == [*COLUMNS[:end], *added[:2], *COLUMNS[end:], added[2]]
    pd.testing.assert_frame_equal(result[COLUMNS], table())
    for row, run in zip(result[added].itertuples(index=False), runs().values(), strict=True):
        returns = run["extrinsic_return"].tolist()
        first = next((t for t, value in enumerate(returns, start=1) if value > 0), None)
        assert tuple(row) == (first or 400, min(returns), first is None)
    result.to_csv(tmp_path / "metrics.csv", index=False)
    read = read_metrics(tmp_path / "metrics.csv", WANTED, settings)
    pd.testing.assert_frame_equal(read, result, check_exact=True)
    with pytest.raises(RecordError, match="line 1: the column 'positive'"):
        read_metrics(tmp_path / "metrics.csv", WANTED, CONFIG)


NO_METRIC = [  # what is given, and what is said of it
    (3, "is no mace_study.measure.metrics.Metric but of type int"),
    (m.Metric("seed", "S", "return", min), "has the name 'seed', but metrics.csv has a"),
    (m.Metric("solved", "S", "episodes", min), "'solved', but metrics.csv"),  # of other studies
    (m.Metric("a,b", "A", "return", min), "has the name 'a,b', but a column's name should"),
    (m.Metric("s", "S", "steps", min), "has the unit 'steps', but should have one of episodes"),
    (m.Metric("y", "Y", "share", lambda curve: 50.0), "50.0, but should be a finite number from 0"),
    (m.Metric("y", "Y", "episodes", lambda curve: m.Attained(3.9, False)), "at a whole number"),
    (m.Metric("y", "Y", "return", lambda curve: np.nan), "y .* nan, but should be a finite"),
    (m.Metric("y", "Y", "episodes", lambda curve: 3.5), r"y of the run \(.*, 3\) is 3.5"),
    (m.Metric("y", "Y", "episodes", lambda curve: m.Attained(0, False)), "y is 0 of 400 episodes"),
    (m.Metric("y", "Y", "episodes", lambda curve: m.Attained(9, True)), "y is 9 of .*censored = 1"),
]


@pytest.mark.parametrize(("own", "problem"), NO_METRIC)
def test_what_is_no_metric_is_refused(own, problem, custom):
    with pytest.raises((ConfigError, RecordError), match=problem):
        table(settings=custom(m.Metric("x_censored", "X", "return", lambda curve: 0.0), own))


def each(environments, variants):
    return dict.fromkeys(environments, variants)


def test_a_study_has_the_metrics_whose_goals_all_its_environments_have():
    def names(environments, **changes):
        settings = check(MetricsConfig, SETTINGS | changes, "test").within(
            each(environments, ["ppo"])
        )
        return [metric.name for metric in m.all_metrics(settings) if metric.needs]

    assert names(ENVIRONMENTS) == ["solved", "sample_efficiency_common"]
    assert names(["CartPole-v1", "Other-v0"]) == []
    assert names(ENVIRONMENTS, solved_return={"CartPole-v1": 475.0}) == ["sample_efficiency_common"]
    assert names(["CartPole-v1"], reference_return={}) == ["solved"]
    chosen = {"constants": {"learned": "mace_full", "fixed": ["ppo", "beta_1"]}}
    drawn = check(MetricsConfig, SETTINGS | chosen, "test")
    lines = drawn.incomplete(each([*ENVIRONMENTS, "Other-v0"], VARIANTS))
    assert [line.split()[0].partition(".")[2] for line in lines] == [*GOALS, "constants"]
    assert [line.split()[-1] for line in lines] == ["Other-v0", "Other-v0", "beta_1"]
    assert CONFIG.incomplete(each(ENVIRONMENTS, [])) == CONFIG.incomplete({"Other-v0": []}) == []
    assert drawn.within(each(ENVIRONMENTS, VARIANTS)).constants is None
    assert (
        drawn.within(each(ENVIRONMENTS, ["ppo", "beta_1", "mace_full"])).constants
        == drawn.constants
    )


def test_a_goal_that_random_actions_attain_is_refused():
    settings = check(MetricsConfig, SETTINGS | {"solved_return": {"CartPole-v1": 22.1}}, "test")
    problem = r"metrics\.solved_return\.CartPole-v1 is 22\.1, but should be greater than .*, 22\.1"
    with pytest.raises(ConfigError, match=problem):
        settings.within(each(ENVIRONMENTS, VARIANTS))
