"""The figures: their data against pandas and scipy, and what is drawn against the data."""

import math
import struct
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from matplotlib.colors import same_color

from mace_rl.config.results import FigureConfig
from mace_rl.config.section import ConfigError, check
from mace_rl.config.study import read_study
from mace_rl.report.panels import MAX_POINTS, _thinned
from mace_rl.results.figures import draw_figure, mean_curves, quantity, save_figure, seed_curves
from mace_rl.results.records import RecordError

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


def draw(columns=3, colours=COLOURS, shown=RETURN, **shape):
    layout = FigureConfig(columns=columns)
    return draw_figure(*data(shown, **shape), shown, layout, 0.95, LABELS, colours)


def at(frame, **values):
    for name, value in values.items():
        frame = frame[frame[name] == value]
    return frame


@pytest.mark.parametrize("episodes", [1, 4, 5, 6, 40])
def test_a_seeds_curve_is_the_moving_average_of_the_episodes_so_far(episodes):
    runs = frames(episodes=episodes)
    single = seed_curves(runs, RETURN)
    assert list(single.columns) == ["env", "variant", "seed", "episode", "moving_average"]
    for (environment, variant, seed), run in runs.items():
        curve = at(single, env=environment, variant=variant, seed=seed)
        assert curve["episode"].tolist() == list(range(1, episodes + 1))
        expected = run["extrinsic_return"].rolling(5, min_periods=1).mean()
        np.testing.assert_allclose(curve["moving_average"], expected)


@pytest.mark.parametrize(("episodes", "points"), [(500, 500), (501, 251), (6000, 500)])
def test_long_curves_are_thinned_and_end_at_the_last_episode(episodes, points):
    run = frames(("A-v0",), 1, episodes)["A-v0", "ppo", 0]
    curve = seed_curves({("A-v0", "ppo", 0): run}, RETURN)
    assert len(curve) == points
    assert curve["episode"].iloc[-1] == episodes
    assert set(np.diff(curve["episode"])) == {math.ceil(episodes / 500)}
    full = run["extrinsic_return"].rolling(5, min_periods=1).mean().to_numpy()
    np.testing.assert_allclose(curve["moving_average"], full[curve["episode"] - 1])


def test_the_panels_of_the_page_are_thinned_and_end_at_the_last_episode():
    frame = pd.DataFrame({"episode": np.tile(np.arange(1, 1002), 2), "variant": "ppo"})
    kept = _thinned(frame)["episode"].to_numpy().reshape(2, -1)
    step = math.ceil(1001 / MAX_POINTS)
    assert (kept == np.arange(1001, 0, -step)[::-1]).all()
    assert len(kept[0]) <= MAX_POINTS
    assert len(_thinned(frame.head(MAX_POINTS))) == MAX_POINTS


def test_mean_curves_against_scipy_point_by_point():
    curves, single = data(seeds=4)
    assert list(curves.columns) == ["env", "variant", "episode", "mean", "lower", "upper", "n"]
    assert len(curves) == 2 * 2 * 40
    for row in curves.iloc[::7].itertuples():
        values = at(single, env=row.env, variant=row.variant, episode=row.episode)["moving_average"]
        assert len(values) == row.n == 4
        assert row.mean == pytest.approx(values.mean())
        bounds = scipy.stats.t.interval(0.95, 3, values.mean(), values.sem())
        assert (row.lower, row.upper) == pytest.approx(bounds)


def test_from_ten_seeds_on_the_band_is_the_same_bootstrap_every_time():
    curves, _ = data(seeds=10)
    again, _ = data(seeds=10)
    pd.testing.assert_frame_equal(curves, again, check_exact=True)
    assert (curves["lower"] < curves["mean"]).all()
    assert (curves["mean"] < curves["upper"]).all()


def test_one_seed_has_a_mean_and_no_band():
    curves, single = data(seeds=1)
    assert curves[["lower", "upper"]].isna().all(axis=None)
    np.testing.assert_array_equal(curves["mean"], single["moving_average"])


def test_seeds_of_different_lengths_are_refused():
    runs = frames()
    runs["B-v1", "ppo", 1] = runs["B-v1", "ppo", 1].iloc[:-1]
    with pytest.raises(RecordError, match="the seeds of B-v1, ppo differ in their episodes"):
        data(runs=runs)


def test_seeds_that_differ_between_environments_are_said_of_each():
    runs = frames(("A-v0",), seeds=5) | frames(("B-v1",), seeds=3)
    layout = FigureConfig(columns=2)
    figure = draw_figure(*data(runs=runs), RETURN, layout, 0.95, LABELS, COLOURS)
    assert [axes.get_title() for axes in figure.axes] == ["A-v0 (5 seeds)", "B-v1 (3 seeds)"]
    (legend,) = figure.legends
    assert legend.get_title().get_text().startswith("Line: mean over 3 to 5 seeds. Band: ")


def test_one_panel_per_environment_shows_the_data():
    curves, _ = data()
    figure = draw()
    assert [axes.get_title() for axes in figure.axes] == ["A-v0", "B-v1"]
    assert figure.axes[0].get_ylabel() == "Extrinsic return\n(mean of up to 5 episodes)"
    assert {axes.get_xlabel() for axes in figure.axes} == {"Training episodes"}
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(LABELS.values())
    for axes in figure.axes:
        means = [line for line in axes.get_lines() if line.get_label() in LABELS.values()]
        assert [line.get_label() for line in means] == list(LABELS.values())
        for line, variant in zip(means, LABELS, strict=True):
            curve = at(curves, env=axes.get_title(), variant=variant)
            np.testing.assert_array_equal(line.get_xdata(), curve["episode"])
            np.testing.assert_array_equal(line.get_ydata(), curve["mean"])
            assert same_color(line.get_color(), COLOURS[variant])


def test_bands_and_faint_seeds_lie_behind_the_means():
    axes = draw(seeds=4).axes[0]
    faint = [line for line in axes.get_lines() if line.get_label() not in LABELS.values()]
    means = [line for line in axes.get_lines() if line.get_label() in LABELS.values()]
    bands = axes.collections
    assert len(faint) == 2 * 4
    assert len(bands) == 2
    assert max(line.get_alpha() for line in faint) < 0.5
    assert max(line.zorder for line in faint) < min(band.zorder for band in bands)
    assert max(band.zorder for band in bands) < min(line.zorder for line in means)
    curves, single = data(seeds=4)
    vertices = bands[0].get_paths()[0].vertices
    curve = at(curves, env="A-v0", variant="ppo")
    assert vertices[:, 1].max() == curve["upper"].max()
    assert vertices[:, 1].min() == curve["lower"].min()
    shown = at(single, env="A-v0")["moving_average"]
    low, high = axes.get_ylim()
    assert low < shown.min()
    assert high > shown.max()


@pytest.mark.parametrize(("seeds", "bands", "faint"), [(1, 0, 0), (2, 0, 4), (3, 2, 6)])
def test_few_seeds(seeds, bands, faint):
    figure = draw(seeds=seeds)
    assert len(figure.axes[0].collections) == bands
    assert len(figure.axes[0].get_lines()) == 2 + faint
    (legend,) = figure.legends
    assert (f"{seeds} seeds" in legend.get_title().get_text()) == (seeds > 1)
    assert ("95 % interval" in legend.get_title().get_text()) == (bands > 0)


@pytest.mark.parametrize(("environments", "columns"), [(1, 3), (2, 1), (4, 3), (5, 2), (7, 3)])
def test_any_number_of_environments(environments, columns, tmp_path):
    names = tuple(f"E{i}-v0" for i in range(environments))
    figure = draw(columns, environments=names, seeds=2)
    assert [axes.get_title() for axes in figure.axes] == list(names)
    bottom = [axes.get_title() for axes in figure.axes if axes.get_xlabel()]
    assert bottom == list(names[-min(columns, environments) :])
    left = [axes.get_title() for axes in figure.axes if axes.get_ylabel()]
    assert left == list(names[:: min(columns, environments)])
    save_figure(figure, tmp_path / "figure.png")


def test_a_constant_return_can_be_drawn(tmp_path):
    runs = {run: frame * 0 + 500 for run, frame in frames(seeds=3).items()}
    save_figure(draw(runs=runs), tmp_path / "figure.pdf")


def test_figure_2_shows_beta_as_it_was_without_variants_that_have_none():
    curves, single = data(BETA)
    assert set(curves["variant"]) == set(single["variant"]) == {"mace_full"}
    for (environment, variant, seed), run in frames().items():
        beta = at(single, env=environment, variant=variant, seed=seed)["beta"].tolist()
        assert beta == (run["beta"].tolist() if variant == "mace_full" else [])
    for row in curves.itertuples():
        beta = at(single, env=row.env, episode=row.episode)["beta"]
        bounds = scipy.stats.t.interval(0.95, 2, beta.mean(), beta.sem())
        assert row.mean == pytest.approx(beta.mean())
        assert (row.lower, row.upper) == pytest.approx((max(bounds[0], 0), min(bounds[1], 1)))
    figure = draw(shown=BETA)
    assert [axes.get_title() for axes in figure.axes] == ["A-v0", "B-v1"]
    assert {axes.get_ylim() for axes in figure.axes} == {(0, 1)}
    assert figure.axes[0].get_ylabel() == "β"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [LABELS["mace_full"]]
    once = {run: frame * 0 for run, frame in frames().items()}  # one β above 0 is enough
    once["B-v1", "ppo", 2].loc[7, "beta"] = 0.1
    assert set(data(BETA, once)[0]["variant"]) == {"ppo"}


def test_a_study_without_beta_has_a_figure_that_says_so(tmp_path):
    plain = {run: frame for run, frame in frames().items() if run[1] == "ppo"}
    for name, written in zip(("curves", "seeds"), data(BETA, plain), strict=True):
        written.to_csv(tmp_path / f"{name}.csv", index=False)
    read = [pd.read_csv(tmp_path / f"{name}.csv") for name in ("curves", "seeds")]
    figure = draw_figure(*read, BETA, FigureConfig(columns=3), 0.95, LABELS, COLOURS)
    assert [text.get_text() for text in figure.axes[0].texts] == ["β is 0 in every run"]
    save_figure(figure, tmp_path / "figure.pdf")


def test_an_inset_shows_a_beginning_in_which_most_is_learned():
    early = {run: frame.copy() for run, frame in frames(seeds=3, episodes=200).items()}
    for run, frame in early.items():
        slow = run[0] == "B-v1" and run[1] == "ppo"
        frame["extrinsic_return"] = np.minimum(np.arange(200) * (0.5 if slow else 20), 100) + run[2]
    layout = FigureConfig(columns=3, inset=0.1)
    figure = draw_figure(*data(runs=early), RETURN, layout, 0.95, LABELS, COLOURS)
    first, second = figure.axes[:2]
    assert second.child_axes == []  # of both variants one learns all along
    [inset] = first.child_axes
    assert inset.get_xlim() == (0, 20)
    for line, variant in zip(inset.lines, LABELS, strict=True):
        mean = at(data(runs=early)[0], env="A-v0", variant=variant)
        assert list(line.get_ydata()) == list(mean[mean["episode"] <= 20]["mean"])
        assert line.get_color() == COLOURS[variant]
    assert "Inset: the first 10 %" in figure.legends[0].get_title().get_text()
    assert not any(axes.child_axes for axes in draw(seeds=3).axes)


def test_the_same_data_gives_the_same_files_and_another_colour_does_not(tmp_path, monkeypatch):
    for name, epoch, colours in (
        ("a", "0", COLOURS),
        ("b", "1000000000", COLOURS),
        ("c", "0", COLOURS | {"ppo": "#123456"}),
    ):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)  # what matplotlib would take for the time
        for kind in ("pdf", "png"):
            save_figure(draw(colours=colours), tmp_path / f"{name}.{kind}")
    for kind in ("pdf", "png"):
        first, second, third = ((tmp_path / f"{name}.{kind}").read_bytes() for name in "abc")
        assert first == second
        assert first != third


def test_the_pdf_has_vectors_truetype_fonts_and_no_date(tmp_path):
    save_figure(draw(), tmp_path / "figure.pdf")
    content = (tmp_path / "figure.pdf").read_bytes()
    assert b"/FontFile2" in content
    assert b"/Type3" not in content
    assert b"/Subtype /Image" not in content
    assert b"CreationDate" not in content
    assert b"matplotlib" not in content.lower()


def test_the_png_has_a_printers_resolution(tmp_path):
    save_figure(draw(), tmp_path / "figure.png")
    content = (tmp_path / "figure.png").read_bytes()
    place = content.index(b"pHYs") + 4
    per_metre, _, unit = struct.unpack(">IIB", content[place : place + 9])
    assert unit == 1
    assert per_metre * 0.0254 >= 200
    assert b"Software" not in content


@pytest.mark.parametrize("columns", [0, -1, 1.5, "3", None])
def test_columns_are_a_positive_number(columns):
    with pytest.raises(ConfigError, match="figure: columns is"):
        check(FigureConfig, {"columns": columns}, "figure")


@pytest.mark.slow
def test_importing_results_modules_is_quick():
    """Planning the workflow imports them; tables and figures do without torch altogether."""
    heavy = {"torch", "numba", "gymnasium", "snakemake", "pybullet"}
    slow = heavy | {"pandas", "matplotlib.figure", "seaborn", "scipy.stats"}
    code = "import sys, mace_rl.results.{}; print(*(set({}) & set(sys.modules)))"
    for module, forbidden in (("figures", slow), ("tables", heavy), ("comparisons", heavy)):
        command = [sys.executable, "-c", code.format(module, sorted(forbidden))]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
        assert run.stdout.split() == []
