"""Every reading of Table 1's metrics, the paper's numbers, and shuffled returns."""

import numpy as np
import pandas as pd
import pytest

from mace_rl.config.study import Study
from mace_rl.results import readings as r
from mace_rl.results.metrics_table import metrics_table
from mace_rl.results.paper import PAPER_TABLE1
from mace_rl.results.statistics import logrank

EPISODES = 400


def learning(rng: np.random.Generator, knee: int) -> np.ndarray:
    """Returns that rise from 20 to 450 until the episode `knee`."""
    level = np.interp(np.arange(EPISODES), [0, knee, EPISODES], [20, 450, 450])
    return np.clip(level + rng.normal(0, 20, EPISODES), 9, 500).round()


@pytest.fixture
def frames() -> dict[tuple[str, str, int], pd.DataFrame]:
    rng, found = np.random.default_rng(5), {}
    for seed in range(6):
        for variant, knee in (("ppo", 240), ("mace_fixed", 200), ("mace_full", 100)):
            returns = learning(rng, knee)
            frame = pd.DataFrame({"extrinsic_return": returns, "env_steps": np.cumsum(returns)})
            found["CartPole-v1", variant, seed] = frame
    return found


def select(table: pd.DataFrame, reading: str, source: str) -> pd.DataFrame:
    rows = table[(table["reading"] == reading) & (table["source"] == source)]
    return rows.set_index("variant")


def test_a_reading_is_the_mean_of_the_metric_over_seeds(frames, study: Study) -> None:
    table = r.readings(frames, study.metrics)
    runs = metrics_table(frames, list(frames), study.metrics)
    rows = select(table, "sample_efficiency_range", r.RUNS)
    expected = runs.groupby("variant")["sample_efficiency_range"].mean()
    for variant in expected.index:
        assert rows.loc[variant, "mean"] == pytest.approx(expected[variant])
        assert rows.loc[variant, "low"] < expected[variant] < rows.loc[variant, "high"]
    assert rows["rank"].to_dict() == {"ppo": 3, "mace_fixed": 2, "mace_full": 1}
    assert np.isnan(rows.loc["mace_full", "p_value"])
    # 6 runs all earlier than 6 others: two of C(12, 6) ways are as extreme.
    assert rows.loc["ppo", "p_value"] == pytest.approx(2 / 924)


def test_the_papers_numbers_stand_beside(frames, study: Study) -> None:
    rows = select(r.readings(frames, study.metrics), "convergence_steps", r.PAPER)
    published = {name: PAPER_TABLE1["CartPole-v1", name][1] for name in rows.index}
    assert rows["mean"].to_dict() == published
    assert rows["rank"].to_dict() == {"ppo": 3, "mace_fixed": 1, "mace_full": 2}


def test_shuffled_returns_are_the_same_in_another_order(frames, study: Study) -> None:
    shuffled = r.shuffled(frames, study.metrics)
    for run, frame in frames.items():
        own, other = frame["extrinsic_return"], shuffled[run]["extrinsic_return"]
        assert sorted(own) == sorted(other)
        assert not np.array_equal(own, other)
    rows = select(r.readings(frames, study.metrics), "sample_efficiency", r.SHUFFLED)
    assert (rows["mean"] < 10).all()  # three in four returns are over the bar


def test_the_table_names_the_first_first_and_bold_if_that_is_no_chance(
    frames, study: Study
) -> None:
    table = r.readings(frames, study.metrics)
    lines = r.markdown(table, study.metrics).splitlines()
    (line,) = [line for line in lines if line.startswith("| Sample efficiency (range) |")]
    cell = line.split("|")[2].strip()
    assert cell.startswith("**mace_full ")
    assert [part.strip("* ").split()[0] for part in cell.split(",")] == [
        *("mace_full", "mace_fixed", "ppo")
    ]
    (noise,) = [line for line in lines if line.startswith("| Sample efficiency, returns shuffled")]
    assert "**" not in noise
    kinds = [line.split("|")[1].split(":")[0].split("(")[0].strip() for line in lines[2:]]
    assert kinds.index("Convergence") == 1 + max(
        place for place, kind in enumerate(kinds) if kind.startswith("Sample")
    )


def ordered(means: dict[str, float], p_values: dict[str, float]) -> tuple[list[str], bool]:
    rows = pd.DataFrame(
        {
            "variant": list(means),
            "mean": list(means.values()),
            "rank": [1 + sorted(means.values()).index(mean) for mean in means.values()],
            "p_value": [p_values.get(name, np.nan) for name in means],
        }
    )
    found, sure = r.ranked(rows)
    return list(found["variant"]), sure


def test_first_for_sure_is_who_is_ahead_of_every_other_beyond_chance() -> None:
    means = {"c": 300.0, "a": 100.0, "b": 101.0}
    order = ["a", "b", "c"]
    assert ordered(means, {"b": 0.049, "c": 0.001}) == (order, True)
    assert ordered(means, {"b": 0.05, "c": 0.001}) == (order, False)  # of one it is not shown
    assert ordered(means, {}) == (order, False)  # of the paper's there is no test
    tied = {"c": 300.0, "a": 100.0, "b": 100.0}
    assert ordered(tied, {"b": 0.001, "c": 0.001}) == (order, False)


def test_runs_that_never_got_there_are_censored_at_the_end(study: Study) -> None:
    """Three of six never do, the others of both variants at the same episodes."""
    frames = {}
    for seed in range(6):
        for variant in ("ppo", "mace_full"):
            returns = np.full(EPISODES, 20.0)
            if variant == "ppo" or seed < 3:
                returns[100 + seed :] = 450.0
            frame = pd.DataFrame({"extrinsic_return": returns, "env_steps": np.cumsum(returns)})
            frames["CartPole-v1", variant, seed] = frame
    rows = select(r.readings(frames, study.metrics), "sample_efficiency_range", r.RUNS)
    assert rows["censored"].to_dict() == {"ppo": 0, "mace_full": 3}
    runs = metrics_table(frames, list(frames), study.metrics).set_index("variant")
    times = {name: runs.loc[name, "sample_efficiency_range"].to_numpy(float) for name in rows.index}
    times["mace_full"][3:] = np.inf
    expected = logrank(times["ppo"], times["mace_full"], 9999, np.random.default_rng(0))
    assert rows.loc["mace_full", "p_value"] == pytest.approx(expected)
    assert rows.loc["mace_full", "mean"] == (sum(times["ppo"][:3]) + 3 * EPISODES) / 6
    cells = r.markdown(rows.reset_index(), study.metrics).splitlines()[2]
    assert "ppo" in cells and f"mace_full {rows.loc['mace_full', 'mean']:.0f}†" in cells


def test_an_environment_that_the_paper_has_not(frames, study: Study) -> None:
    settings = study.metrics.model_copy(
        update={"random_return": {"Other-v0": 20.0}, "reference_return": {}}
    )
    other = {("Other-v0", *run[1:]): frame for run, frame in frames.items()}
    table = r.readings(other, settings)
    assert set(table["source"]) == {r.RUNS, r.SHUFFLED}
    figure = r.draw_readings(
        table,
        *({name: name for name in ("ppo", "mace_fixed", "mace_full")},),
        {"ppo": "red", "mace_fixed": "green", "mace_full": "blue"},
        settings,
    )
    assert [axes.get_title() for axes in figure.axes] == ["Other-v0"]
