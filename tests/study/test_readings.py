"""Every reading of Table 1's metrics, the paper's numbers, and shuffled returns."""

import numpy as np
import pandas as pd
import pytest
from invented import CLAIMS, STUDY, frame

from mace_study.compare import readings as r
from mace_study.compare.statistics import logrank
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics_csv import metrics_table
from mace_study.show import tables
from mace_study.show.curves import plot_style
from mace_study.show.markdown import markdown
from mace_study.show.pictures import PICTURES

EPISODES = 400
Frames = dict[tuple[str, str, int], pd.DataFrame]


@pytest.fixture
def frames() -> Frames:
    """Returns that rise from 20 to 450, soonest those of mace_full."""
    rng, found = np.random.default_rng(5), {}
    for seed in range(6):
        for variant, knee in (("ppo", 240), ("mace_fixed", 200), ("mace_full", 100)):
            level = np.interp(np.arange(EPISODES), [0, knee, EPISODES], [20, 450, 450])
            returns = np.clip(level + rng.normal(0, 20, EPISODES), 9, 500).round()
            found["CartPole-v1", variant, seed] = frame(returns)
    return found


def readings(frames: Frames, settings: MetricsConfig = STUDY.metrics) -> pd.DataFrame:
    return r.readings(frames, metrics_table(frames, settings), settings, CLAIMS.table1)


def select(table: pd.DataFrame, reading: str, source: str) -> pd.DataFrame:
    rows = table[(table["reading"] == reading) & (table["source"] == source)]
    return rows.set_index("variant")


def test_readings_of_runs_of_the_paper_and_of_shuffled_returns(frames) -> None:
    table = readings(frames)
    runs = metrics_table(frames, STUDY.metrics)
    rows = select(table, "sample_efficiency_range", r.RUNS)
    expected = runs.groupby("variant")["sample_efficiency_range"].mean()
    assert rows["mean"].to_dict() == pytest.approx(expected.to_dict())
    assert ((rows["low"] < rows["mean"]) & (rows["mean"] < rows["high"])).all()
    assert rows["rank"].to_dict() == {"ppo": 3, "mace_fixed": 2, "mace_full": 1}
    assert np.isnan(rows.loc["mace_full", "p_value"])
    # 6 runs all earlier than 6 others: two of C(12, 6) ways are as extreme.
    assert rows.loc["ppo", "p_value"] == pytest.approx(2 / 924)
    rows = select(table, "convergence_steps", r.PAPER)
    published = {"ppo": 660, "mace_fixed": 620, "mace_full": 634}
    assert rows["mean"].to_dict() == published
    assert rows["rank"].to_dict() == {"ppo": 3, "mace_fixed": 1, "mace_full": 2}
    for run, shuffled in r.shuffled(frames, STUDY.metrics).items():
        own, other = frames[run]["extrinsic_return"], shuffled["extrinsic_return"]
        assert sorted(own) == sorted(other) and not np.array_equal(own, other)
    rows = select(table, "sample_efficiency", r.SHUFFLED)
    assert (rows["mean"] < 10).all()  # three in four returns are over the bar
    # The table names the first first, bold if that is no chance; noise comes last.
    lines = markdown(tables.readings(table, STUDY.metrics)).splitlines()
    (cell,) = [line.split("|")[2] for line in lines if "Sample efficiency (range)" in line]
    assert cell.strip().startswith("**mace_full ")
    order = [part.strip("* ").split()[0] for part in cell.split(",")]
    assert order == ["mace_full", "mace_fixed", "ppo"] and "**" not in lines[-1]


@pytest.mark.parametrize(
    ("means", "p_values", "expected"),
    [
        ((300.0, 100.0, 101.0), (0.001, np.nan, 0.049), True),
        ((300.0, 100.0, 101.0), (0.001, np.nan, 0.05), False),  # of one it is not shown
        ((300.0, 100.0, 101.0), (np.nan,) * 3, False),  # of the paper's there is no test
        ((300.0, 100.0, 100.0), (0.001, np.nan, 0.001), False),  # tied
    ],
)
def test_first_for_sure_is_who_is_ahead_of_every_other(means, p_values, expected) -> None:
    rows = pd.DataFrame({"variant": ["c", "a", "b"], "mean": means, "p_value": p_values})
    rows["rank"] = rows["mean"].rank(method="min")
    found, sure = r.ranked(rows.to_dict("records"))
    assert ([row["variant"] for row in found], sure) == (["a", "b", "c"], expected)


def test_runs_that_never_got_there_are_censored_at_the_end() -> None:
    """Three of six never do, the others of both variants at the same episodes."""
    frames = {}
    for seed in range(6):
        for variant in ("ppo", "mace_full"):
            returns = np.full(EPISODES, 20.0)
            if variant == "ppo" or seed < 3:
                returns[100 + seed :] = 450.0
            frames["CartPole-v1", variant, seed] = frame(returns)
    table = readings(frames)
    rows = select(table, "sample_efficiency_range", r.RUNS)
    assert rows["censored"].to_dict() == {"ppo": 0, "mace_full": 3}
    runs = metrics_table(frames, STUDY.metrics).set_index("variant")
    times = {name: runs.loc[name, "sample_efficiency_range"].to_numpy(float) for name in rows.index}
    times["mace_full"][3:] = np.inf
    expected = logrank(times["ppo"], times["mace_full"], 9999, np.random.default_rng(0))
    assert rows.loc["mace_full", "p_value"] == pytest.approx(expected)
    assert rows.loc["mace_full", "mean"] == (sum(times["ppo"][:3]) + 3 * EPISODES) / 6
    cells = markdown(tables.readings(rows.reset_index(), STUDY.metrics)).splitlines()[2]
    assert "ppo" in cells and f"mace_full {rows.loc['mace_full', 'mean']:.0f}†" in cells


def test_a_longer_budget_makes_nobody_later(frames: Frames) -> None:
    """With the budget of ppo, 30 episodes, mace_full never gets there either."""
    short, reading = {}, "sample_efficiency_common"
    for (env, variant, seed), own in frames.items():
        late = np.where(np.arange(EPISODES) < 350, 20.0, 450.0)
        returns = own["extrinsic_return"] * 0 + (20.0 if variant == "ppo" else late)
        new = frame(returns.to_numpy()[: 300 if variant == "ppo" else EPISODES])
        short[env, variant, seed] = new
    rows = select(readings(short), reading, r.RUNS)
    assert rows["censored"].to_dict() == {"ppo": 6, "mace_fixed": 0, "mace_full": 0}
    assert set(rows["rank"]) == {1} and np.nanmin(rows["p_value"]) == 1


def test_an_environment_that_the_paper_has_not(frames: Frames) -> None:
    changes = {"random_return": {"Other-v0": 20.0}, "reference_return": {}}
    settings = STUDY.metrics.model_copy(update=changes)
    other = {("Other-v0", *run[1:]): frame for run, frame in frames.items()}
    table = readings(other, settings)
    assert set(table["source"]) == {r.RUNS, r.SHUFFLED}
    colours = {"ppo": "red", "mace_fixed": "green", "mace_full": "blue"}
    look = plot_style(settings, STUDY.figure.model_dump(), STUDY.labels, colours)
    figure = PICTURES["readings"].draw(table, look)
    assert [axes.get_title() for axes in figure.axes] == ["Other-v0"]
