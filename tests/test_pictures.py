"""Pictures of all runs at once: their data against loops, and that each can be drawn."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from invented import BY_SIZE, CLAIMS, SEEDS, table_for_claims, table_for_questions, table_for_scores

from mace_rl.study.compare.ledger import Answer
from mace_rl.study.compare.statistics import mean_interval
from mace_rl.study.compare.verdicts import ledger
from mace_rl.study.config import Study, read_study
from mace_rl.study.measure.metrics import all_metrics
from mace_rl.study.metrics_config import ConstantsConfig, FigureConfig, MetricsConfig
from mace_rl.study.show.curves import PlotStyle, save_figure
from mace_rl.study.show.pictures import PICTURES, Source

CONSTANTS = ["beta_1", "ppo"]
ROOT = Path(__file__).parents[1]
QUESTIONED = read_study([ROOT / "config.yaml", ROOT / "config" / "questions.yaml"]).metrics
METRICS = {metric.name: metric.label for metric in all_metrics(QUESTIONED)}
QUESTIONED = QUESTIONED.model_copy(update={"bootstrap_repetitions": 500})


@pytest.fixture(scope="module")
def runs() -> pd.DataFrame:
    """metrics.csv of three variants; in HopperBulletEnv-v0 all seeds of one are equal."""
    frame = table_for_scores(SEEDS)
    third = frame[frame["variant"] == "ppo"].assign(variant="beta_1")
    third.loc[third["env"] == "HopperBulletEnv-v0", "area_under_curve"] = 0.1
    frame = pd.concat([frame, third], ignore_index=True)
    return frame.assign(solved=np.random.default_rng(1).uniform(0.8, 1, len(frame)))


@pytest.fixture(scope="module")
def ledgers() -> list[list[Answer]]:
    """Of the paper's claims, of our questions, and of the claims by the second rule."""
    advantage = {"ppo": 0.0, "mace_fixed": 0.03, "mace_full": 0.06}
    claimed, asked = table_for_claims(12, advantage, 0.05), table_for_questions(12)
    own = (claimed, CLAIMS), (asked, CLAIMS), (claimed, BY_SIZE)
    return [ledger(table, QUESTIONED, claims) for table, claims in own]


@pytest.fixture
def settings(study: Study) -> MetricsConfig:
    chosen = ConstantsConfig(learned="mace_full", fixed=CONSTANTS)
    return study.metrics.model_copy(update={"constants": chosen, "bootstrap_repetitions": 500})


def test_every_run_is_there_with_its_returns(runs, settings) -> None:
    table = PICTURES["every_seed"].data(Source({"metrics": runs}, [], settings, CLAIMS))
    assert len(table) == 2 * len(runs)
    for row in table.sample(20, random_state=0).itertuples():
        own = runs[(runs["env"] == row.env) & (runs["seed"] == row.seed)]
        assert row.value == own.set_index("variant").loc[row.variant, row.metric]


def test_constants_come_in_their_order_with_the_learned_one_last(runs, settings) -> None:
    table = PICTURES["constants"].data(Source({"metrics": runs}, [], settings, CLAIMS))
    names = sorted(set(table["variant"]))
    look = PlotStyle(
        FigureConfig(columns=3),
        0.95,
        {name: name for name in names},
        dict.fromkeys(names, "C0"),
        {},
    )
    panels = PICTURES["constants"].draw(table, look).axes
    for (environment, rows), axes in zip(table.groupby("env", sort=False), panels, strict=False):
        assert len(axes.containers) == (rows["role"] != "learned").sum()  # dots with bars
        assert dict(zip(rows["variant"], rows["role"], strict=True)) == {
            **dict.fromkeys(CONSTANTS, "fixed"),
            "mace_full": "learned",
        }
        assert list(rows["variant"][:2]) == CONSTANTS
        for row in rows.itertuples():
            own = runs[(runs["env"] == environment) & (runs["variant"] == row.variant)]
            values = own["area_under_curve"].to_numpy()
            assert (row.mean, row.seeds) == (values.mean(), len(values))
            bounds = mean_interval(values, 0.95, 500, np.random.default_rng(0))
            assert (row.low, row.high) == tuple(map(float, bounds))


def test_a_seed_solves_its_task_if_nine_of_ten_last_episodes_do(runs, settings) -> None:
    for row in (
        PICTURES["solved"].data(Source({"metrics": runs}, [], settings, CLAIMS)).itertuples()
    ):
        own = runs[(runs["env"] == row.env) & (runs["variant"] == row.variant)]["solved"]
        assert (row.solved, row.seeds) == (sum(share >= 0.9 for share in own), len(own))


@pytest.mark.parametrize("family", [0, 1, 2])
def test_the_forest_has_every_part_in_units_of_the_margin(ledgers, family, settings) -> None:
    ledger = ledgers[family]
    table = PICTURES["forest"].data(Source({}, ledger, settings, CLAIMS))
    assert set(table["measured"]) == set(ledger[0].ways)
    assert ("size" in table) == (family == 2)
    for how, rows in table.groupby("measured"):
        parts = [(one.ways[how], part) for one in ledger for part in one.ways[how].parts]
        for (judged, part), (_, row) in zip(parts, rows.iterrows(), strict=True):
            assert row["verdict"] == judged.verdict
            for name in ("difference", "low", "high"):
                assert row[name] * part.worth_mentioning == pytest.approx(getattr(part, name))
            assert np.isnan(row["paper"]) == np.isnan(part.in_paper)
            assert row["outcome"] == part.outcome and row["answer"] == judged.outcome
        assert not rows.duplicated(["claim", "part"]).any()  # the words tell parts from each other


@pytest.mark.parametrize(
    "name", ["every_seed", "constants", "solved", "forest", "forest of questions", "forest by size"]
)
def test_every_picture_can_be_drawn_and_is_the_same_again(
    runs, ledgers, settings, study, tmp_path, name
):
    forests = "forest", "forest of questions", "forest by size"
    sources = dict(zip(forests, ledgers, strict=True))
    source = Source({"metrics": runs}, sources.get(name, []), settings, CLAIMS)
    name = name.partition(" ")[0]
    names = dict.fromkeys(runs["variant"], "A label (of some length)") | {"beta_1": "β = 1"}
    look = PlotStyle(study.figure, 0.95, names, dict.fromkeys(names, "tab:blue"), METRICS)
    table = PICTURES[name].data(source)
    table.to_csv(tmp_path / "table.csv", index=False)
    read = pd.read_csv(tmp_path / "table.csv", keep_default_na=False, na_values=[""])
    for path, data in (("a.png", table), ("b.png", read)):
        save_figure(PICTURES[name].draw(data, look), tmp_path / path)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
