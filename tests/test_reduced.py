"""docs/reduced, which `make quick` gives again to the byte: its trainings, tables and figures."""

from pathlib import Path

import pandas as pd
import pytest
from invented import CLAIMS
from shared import VARIANTS, finish

from mace_rl.records import EpisodeRecord, RunKey, as_columns
from mace_rl.study.compare.summary import split, summary
from mace_rl.study.config import read_study
from mace_rl.study.measure.run_metrics import metrics_table
from mace_rl.study.show.curves import (
    PlotStyle,
    draw_figure,
    mean_curves,
    quantity,
    save_figure,
    seed_curves,
)
from mace_rl.study.show.latex import table1_latex

ROOT = Path(__file__).parents[1]
EXPECTED = ROOT / "docs" / "reduced"
STUDY = read_study([ROOT / "config.yaml", ROOT / "config" / "reduced.yaml"])
METRICS = STUDY.metrics.within(STUDY.environments, STUDY.variants)


@pytest.fixture(scope="module")
def runs() -> dict[RunKey, pd.DataFrame]:
    """The records of the reduced study's runs."""
    return {
        key: pd.DataFrame(as_columns(EpisodeRecord, finish(STUDY.run_config(*key)).records))
        for key in STUDY.runs()
    }


@pytest.mark.slow
def test_table_1(runs):
    metrics = metrics_table(runs, METRICS)
    table, _ = split(summary(metrics, METRICS, CLAIMS.table1), CLAIMS.table1)
    assert table.to_csv(index=False).encode() == (EXPECTED / "table1.csv").read_bytes()
    latex = table1_latex(table, STUDY.labels, METRICS, CLAIMS.table1)
    assert latex.encode() == (EXPECTED / "table1.tex").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("number", ["1", "2"])
def test_figures(runs, tmp_path, number):
    shown = quantity(number, STUDY.metrics)
    single_seeds = seed_curves(runs, shown)
    look = PlotStyle(STUDY.figure, STUDY.metrics.confidence, STUDY.labels, STUDY.colours, {})
    curves = mean_curves(single_seeds, shown, STUDY.metrics)
    figure = draw_figure(curves, single_seeds, shown, look)
    name = f"figure{number}.png"
    save_figure(figure, tmp_path / name)
    assert (tmp_path / name).read_bytes() == (EXPECTED / name).read_bytes()


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", STUDY.environments)
def test_the_first_episodes_do_not_depend_on_the_budget(run_config, environment, variant):
    short, long = (
        finish(run_config(environment, variant, 3, episodes=episodes)) for episodes in (6, 10)
    )
    assert short.records == long.records[:6]
    assert list(map(str, short.diagnostics)) == list(map(str, long.diagnostics[:6]))  # with NaN
