"""Every reading of Table 1's metrics, the paper's numbers, and shuffled returns."""

import numpy as np
import pandas as pd
import pytest

from mace_rl.config.study import Study
from mace_rl.results import readings as r
from mace_rl.results.metrics_table import metrics_table
from mace_rl.results.paper import PAPER_TABLE1

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
