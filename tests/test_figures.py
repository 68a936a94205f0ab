"""The figures over training: their data against pandas and scipy, and what files they give."""

import html
import math
import subprocess
import sys
from itertools import product
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
import scipy.stats

from mace_rl.records import RecordError
from mace_rl.study.config import read_study
from mace_rl.study.metrics_config import FigureConfig
from mace_rl.study.show.curves import (
    PlotStyle,
    draw_figure,
    figure_as_svg,
    mean_curves,
    quantity,
    save_figure,
    seed_curves,
)

STUDY = read_study([Path(__file__).parents[1] / "config.yaml"])
METRICS = STUDY.metrics.model_copy(update={"moving_average": 5, "bootstrap_repetitions": 500})
RETURN, BETA = quantity("1", METRICS), quantity("2", METRICS)
LABELS = {"ppo": "PPO (Baseline)", "mace_full": "MACE-RL (Full β)"}
COLOURS = {"ppo": "tab:blue", "mace_full": "tab:green"}


def frames(environments=("A-v0", "B-v1"), seeds=3, episodes=40):
    draws = np.random.default_rng(0)
    return {
        run: pd.DataFrame(
            {
                "extrinsic_return": np.cumsum(draws.normal(size=episodes)),
                "beta": draws.random(episodes) * (run[1] != "ppo"),
            }
        )
        for run in product(environments, LABELS, range(seeds))
    }


def data(shown=RETURN, runs=None, **shape):
    single = seed_curves(runs or frames(**shape), shown)
    return mean_curves(single, shown, METRICS), single


def draw(colours=COLOURS, shown=RETURN, runs=None, inset=None, **shape):
    layout = FigureConfig(columns=3, inset=inset)
    look = PlotStyle(layout, 0.95, LABELS, colours, {})
    return draw_figure(*data(shown, runs, **shape), shown, look)


def at(frame, **values):
    for name, value in values.items():
        frame = frame[frame[name] == value]
    return frame


@pytest.mark.parametrize(
    ("episodes", "points"), [(1, 1), (4, 4), (5, 5), (40, 40), (500, 500), (501, 251), (6000, 500)]
)
def test_a_seeds_curve_is_the_mean_of_the_episodes_so_far_and_ends_at_the_last(episodes, points):
    runs = frames(("A-v0",), 2, episodes)
    single = seed_curves(runs, RETURN)
    for (environment, variant, seed), run in runs.items():
        curve = at(single, env=environment, variant=variant, seed=seed)
        assert len(curve) == points
        kept = range(episodes, 0, -math.ceil(episodes / 500))
        assert curve["episode"].tolist() == sorted(kept)
        expected = run["extrinsic_return"].rolling(5, min_periods=1).mean()
        np.testing.assert_allclose(curve["moving_average"], expected[curve["episode"] - 1])


@pytest.mark.parametrize("shown", [RETURN, BETA], ids=["return", "beta"])
def test_mean_curves_against_scipy_point_by_point(shown):
    curves, single = data(shown, seeds=4)
    for row in curves.iloc[::7].itertuples():
        values = at(single, env=row.env, variant=row.variant, episode=row.episode)[shown.name]
        assert len(values) == row.n == 4
        assert row.mean == pytest.approx(values.mean())
        bounds = np.array(scipy.stats.t.interval(0.95, 3, values.mean(), values.sem()))
        assert (row.lower, row.upper) == pytest.approx(
            tuple(np.clip(bounds, *shown.limits or (-99, 99)))
        )


def test_one_seed_has_no_band_and_ten_the_same_bootstrap_every_time():
    single = data(seeds=1)[0]
    assert single[["lower", "upper"]].isna().all(axis=None) and single["mean"].notna().all()
    curves, _ = data(seeds=10)
    pd.testing.assert_frame_equal(curves, data(seeds=10)[0], check_exact=True)
    assert ((curves["lower"] < curves["mean"]) & (curves["mean"] < curves["upper"])).all()


def test_seeds_of_different_lengths_are_refused():
    runs = frames()
    runs["B-v1", "ppo", 1] = runs["B-v1", "ppo", 1].iloc[:-1]
    with pytest.raises(RecordError, match="the seeds of B-v1, ppo differ in their episodes"):
        data(runs=runs)


def test_figure_2_leaves_out_whoever_has_no_beta():
    assert set(data(BETA)[0]["variant"]) == {"mace_full"}
    once = {run: frame * 0 for run, frame in frames().items()}  # one β above 0 is enough
    once["B-v1", "ppo", 2].loc[7, "beta"] = 0.1
    assert set(data(BETA, once)[0]["variant"]) == {"ppo"}
    nothing = draw(shown=BETA, runs={run: frame * 0 for run, frame in frames().items()})
    assert [text.get_text() for text in nothing.axes[0].texts] == ["β is 0 in every run"]


def test_each_panel_shows_the_means_of_its_environment():
    curves, _ = data(seeds=4)
    for axes in draw(seeds=4).axes:
        shown = {line.get_label(): line.get_ydata() for line in axes.lines}
        for variant, label in LABELS.items():
            expected = at(curves, env=axes.get_title(), variant=variant)["mean"]
            np.testing.assert_array_equal(shown[label], expected)


def test_a_mean_that_covers_another_leaves_gaps_to_see_it_by():
    runs = frames(("A-v0",))
    equal = runs | {("A-v0", "mace_full", seed): runs["A-v0", "ppo", seed] for seed in range(3)}
    for given, expected in ((runs, ["-", "-"]), (equal, ["-", "--"])):
        lines = draw(runs=given).axes[0].get_legend_handles_labels()[0]
        assert [line.get_linestyle() for line in lines] == expected


# Of somebody's matplotlibrc.
USERS = {"text.usetex": True, "font.size": 30, "font.family": "serif", "savefig.bbox": "tight"}
USERS |= {"axes.formatter.use_locale": True, "path.simplify": False, "pdf.compression": 0}
USERS |= {"axes.prop_cycle": matplotlib.cycler(color="r"), "axes.grid": True}


def test_labels_are_plain_text(monkeypatch):
    for label in ("$$", r"$\notacommand{$", r"$\lambda$ & <50 %> #~^{}", "long " * 12):
        monkeypatch.setitem(LABELS, "ppo", label)
        figure = draw()
        assert f">{html.escape(label, quote=False)}<" in figure_as_svg(figure)
        figure.draw_without_rendering()  # lays it out
        assert figure.legends[0].get_window_extent().width < figure.bbox.width


@pytest.mark.parametrize("kind", ["pdf", "png"])
def test_the_same_data_gives_the_same_file_and_another_colour_does_not(tmp_path, monkeypatch, kind):
    contents = []
    for epoch, colours in (("0", COLOURS), ("1000000000", COLOURS), ("0", COLOURS | {"ppo": "k"})):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)  # what matplotlib would take for the time
        with matplotlib.rc_context(USERS if epoch != "0" else {}):
            save_figure(draw(colours=colours, episodes=200, inset=0.9), tmp_path / f"figure.{kind}")
        contents.append((tmp_path / f"figure.{kind}").read_bytes())
    assert contents[0] == contents[1] != contents[2]
    if kind == "pdf":  # vectors, and fonts that journals take
        assert b"/FontFile2" in contents[0]
        assert not any(word in contents[0] for word in (b"/Type3", b"/Subtype /Image", b"Creat"))


@pytest.mark.slow
def test_importing_results_modules_is_quick():
    """Planning the workflow imports them; tables and figures do without torch altogether."""
    heavy = {"torch", "numba", "gymnasium", "snakemake", "pybullet"}
    slow = {"pandas", "matplotlib.figure", "seaborn", "scipy.stats", "torch", "numba"}
    code = "import sys, mace_rl.study.{}; print(*(set({}) & set(sys.modules)))"
    modules = {"claims_config": slow, "show.tables": heavy, "compare.comparisons": heavy}
    for module, forbidden in modules.items():
        command = [sys.executable, "-c", code.format(module, sorted(forbidden))]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
        assert run.stdout.split() == []


def test_an_inset_shows_a_beginning_in_which_most_is_learned():
    runs = frames(episodes=200)
    for (environment, variant, seed), run in runs.items():
        slope = 0.5 if (environment, variant) == ("B-v1", "ppo") else 20  # of both one learns late
        run["extrinsic_return"] = np.minimum(slope * np.arange(200), 100.0) + seed
    first, second = draw(runs=runs, inset=0.1).axes[:2]
    [inset] = first.child_axes
    assert inset.get_xlim() == (0, 20) and not second.child_axes
    assert [line.get_xdata().tolist() for line in inset.lines] == [list(range(1, 21))] * 2
