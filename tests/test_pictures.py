"""Pictures of all runs at once: their data against loops, and what they draw."""

import re

import numpy as np
import pandas as pd
import pytest
from invented import SEEDS, table_for_scores
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from mace_rl.config.results import RegretConfig
from mace_rl.config.study import Study
from mace_rl.report.panels import svg
from mace_rl.results import pictures
from mace_rl.results.aggregate import SCORED, scores
from mace_rl.results.figures import figure_as_svg, save_figure

NAMES = {"ppo": "PPO", "mace_full": "Full"}
COLOURS = {"ppo": "tab:blue", "mace_full": "tab:green"}


def test_a_panel_of_the_page_says_and_shows_what_the_figure_does() -> None:
    figure = Figure(figsize=(3, 2))
    axes = figure.subplots()
    axes.plot([0.975, 0.995], [0.123456, 0.2], alpha=0.19)
    axes.set_yticks([0.125, 0.175])
    whole, small = figure_as_svg(figure), svg(figure, "name", "label")
    for shown in (r"<text[^>]*>([^<]*)<", r"opacity: ([\d.]+)", r"stroke-width: ([\d.]+)"):
        assert re.findall(shown, small) == re.findall(shown, whole) != []
    paths = [
        re.findall(r"-?\d+(?:\.\d+)?", " ".join(re.findall(r' d="([^"]+)"', text)))
        for text in (whole, small)
    ]
    np.testing.assert_allclose(*(np.array(path, float) for path in paths), atol=0.1)
    assert max(len(number.partition(".")[2]) for number in paths[1]) == 1


def test_a_profile_is_the_share_of_runs_that_are_at_least_so_good(study: Study) -> None:
    frame = table_for_scores(SEEDS)
    curves, every = pictures.profiles(frame, study.metrics), scores(frame, study.metrics)
    for (metric, variant), curve in curves.groupby(["metric", "variant"]):
        own = every[(every["metric"] == metric) & (every["variant"] == variant)]["score"]
        expected = [sum(value >= tau for value in own) / 22 for tau in curve["score"]]
        np.testing.assert_allclose(curve["share"], expected, atol=1e-12)
        assert (curve["low"] <= curve["share"]).all()
        assert (curve["share"] <= curve["high"]).all()
        assert curve["share"].iloc[0] == 1


def test_the_band_of_a_profile_is_the_bootstrap_of_its_share(study: Study) -> None:
    frame = table_for_scores({"CartPole-v1": 12})
    curves, every = pictures.profiles(frame, study.metrics), scores(frame, study.metrics)
    one = curves[(curves["metric"] == "final_return") & (curves["variant"] == "ppo")]
    own = every[(every["metric"] == "final_return") & (every["variant"] == "ppo")]["score"]
    middle = one.iloc[(one["share"] - 0.5).abs().argmin()]
    # How often of 12 draws are over τ is binomial.
    spread = np.sqrt(0.25 / 12)
    assert own.ge(middle["score"]).mean() == pytest.approx(0.5)
    assert middle["high"] - middle["low"] == pytest.approx(2 * 2.3 * spread, rel=0.2)


def test_every_run_is_a_dot_of_its_variants_colour() -> None:
    frame = table_for_scores(SEEDS)
    figure = pictures.draw_every_seed(frame, NAMES, COLOURS)
    panels = {axes.get_title(): axes for axes in figure.axes}
    assert len(panels) == len(SEEDS) * len(SCORED)
    axes = panels["CartPole-v1:\nfinal return"]
    own = frame[frame["env"] == "CartPole-v1"]
    for dots, variant in zip(axes.collections[::2], ("ppo", "mace_full"), strict=True):
        values = own.loc[own["variant"] == variant, "final_return"]
        np.testing.assert_array_equal(np.asarray(dots.get_offsets())[:, 1], values)
        assert tuple(dots.get_facecolor()[0][:3]) == to_rgba(COLOURS[variant])[:3]


def test_the_regret_shows_constants_as_a_line_and_others_beside_it(study: Study) -> None:
    frame = table_for_scores({"CartPole-v1": 5})
    constant = frame[frame["variant"] == "ppo"].assign(variant="beta_1")
    frame = pd.concat([frame, constant.assign(area_under_curve=100.0)], ignore_index=True)
    regret = RegretConfig(variant="mace_full", constants=["ppo", "beta_1"])
    names, colours = NAMES | {"beta_1": "β = 1"}, COLOURS | {"beta_1": "black"}
    figure = pictures.draw_regret(frame, regret, study.figure, study.metrics, names, colours)
    (axes,) = figure.axes
    joined = next(line for line in axes.lines if len(line.get_xdata()) == 2)
    means = frame.groupby("variant")["area_under_curve"].mean()
    np.testing.assert_allclose(joined.get_ydata(), means[["ppo", "beta_1"]])
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["PPO", "1"]
    dots = [line.get_ydata()[0] for line in axes.lines if len(line.get_xdata()) == 1]
    assert means["mace_full"] in dots


def test_the_regret_of_seeds_that_are_all_equal_can_be_drawn(study: Study) -> None:
    """A bound of 20 times 0.1 differs from the mean in the last bit."""
    frame = table_for_scores({"CartPole-v1": 20}).assign(area_under_curve=0.1)
    regret = RegretConfig(variant="mace_full", constants=["ppo"])
    figure = pictures.draw_regret(frame, regret, study.figure, study.metrics, NAMES, COLOURS)
    assert len(figure.axes[0].collections) == 2


def test_a_picture_is_the_same_file_again(study: Study, tmp_path) -> None:
    frame = table_for_scores(SEEDS)
    curves = pictures.profiles(frame, study.metrics)
    files = [tmp_path / name for name in ("a.png", "b.png", "a.pdf", "b.pdf")]
    for path in files:
        save_figure(pictures.draw_profiles(curves, 0.95, NAMES, COLOURS), path)
    contents = [path.read_bytes() for path in files]
    assert contents[0] == contents[1]
    assert contents[2] == contents[3]
