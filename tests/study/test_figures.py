"""Figures and pictures: their data against pandas, scipy and loops, and what files they give."""

import math
from dataclasses import replace
from itertools import product

import matplotlib
import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import (
    CLAIMS,
    QUESTIONED,
    QUICK,
    ROBUST,
    SEEDS,
    STUDY,
    VARIANTS,
    table_for_claims,
    table_for_questions,
    table_for_scores,
)
from PIL import Image
from shared import illegible

from mace_study.compare.ledger import Answer
from mace_study.compare.statistics import mean_interval
from mace_study.compare.verdicts import ledger
from mace_study.config.metrics import ConstantsConfig, FigureConfig, MetricsConfig
from mace_study.show import curves as c
from mace_study.show.pictures import PICTURES, Source
from mace_study.show.pictures import _what as words

METRICS = STUDY.metrics.model_copy(update={"moving_average": 5, "bootstrap_repetitions": 500})
RETURN, BETA = c.quantity("1", METRICS), c.quantity("2", METRICS)
LABELS = {"ppo": "PPO (Baseline)", "mace_full": "MACE-RL (Full β)"}
COLOURS = {"ppo": "tab:blue", "mace_full": "tab:green"}


def frames(environments=("A-v0", "B-v1"), seeds=3, episodes=40):
    draws = np.random.default_rng(0)
    found = {}
    for run in product(environments, LABELS, range(seeds)):
        returns = np.cumsum(draws.normal(size=episodes))
        beta = draws.random(episodes) * (run[1] != "ppo")
        found[run] = pd.DataFrame({"extrinsic_return": returns, "beta": beta})
    return found


def data(shown=RETURN, runs=None, **shape):
    single = c.seed_curves(runs or frames(**shape), shown)
    return c.mean_curves(single, shown, METRICS), single


def draw(colours=COLOURS, shown=RETURN, runs=None, inset=None, **shape):
    layout = FigureConfig(columns=3, inset=inset)
    look = c.PlotStyle(layout, 0.95, LABELS, colours, {})
    return c.draw_figure(*data(shown, runs, **shape), shown, look)


def at(frame, **values):
    for name, value in values.items():
        frame = frame[frame[name] == value]
    return frame


@pytest.mark.parametrize(
    ("episodes", "points"), [(1, 1), (4, 4), (5, 5), (40, 40), (300, 300), (301, 151), (6000, 300)]
)
def test_a_seeds_curve_is_the_mean_of_the_episodes_so_far_and_ends_at_the_last(episodes, points):
    runs = frames(("A-v0",), 2, episodes)
    single = c.seed_curves(runs, RETURN)
    for (environment, variant, seed), run in runs.items():
        curve = at(single, env=environment, variant=variant, seed=seed)
        assert len(curve) == points
        kept = range(episodes, 0, -math.ceil(episodes / 300))
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
        expected = np.clip(bounds, *shown.limits or (-99, 99))
        assert (row.lower, row.upper) == pytest.approx(tuple(expected))


def test_a_beta_above_1_is_within_its_interval_and_the_panel():
    runs = {run: frame.assign(beta=frame["beta"] * 4) for run, frame in frames().items()}
    curves, single = data(BETA, runs)
    assert single["beta"].max() > 3 and curves["upper"].max() > 2
    assert (curves["mean"] <= curves["upper"]).all() and (curves["lower"] >= 0).all()
    assert [axes.get_ylim() for axes in draw(shown=BETA, runs=runs).axes] == [
        (0, single[single["env"] == name]["beta"].max()) for name in ("A-v0", "B-v1")
    ]


def test_curves_of_a_variant_end_with_its_shortest_run():
    runs = frames()
    whole = len(runs["B-v1", "ppo", 1])
    runs["B-v1", "ppo", 1] = runs["B-v1", "ppo", 1].iloc[:-1]
    ends = data(runs=runs)[0].groupby(["env", "variant"])["episode"].max()
    assert ends["B-v1", "ppo"] == whole - 1 and ends["B-v1", "mace_full"] == whole


def test_figure_2_leaves_out_whoever_has_no_beta():
    assert set(data(BETA)[0]["variant"]) == {"mace_full"}
    once = {run: frame * 0 for run, frame in frames().items()}  # one β above 0 is enough
    once["B-v1", "ppo", 2].loc[7, "beta"] = 0.1
    assert set(data(BETA, once)[0]["variant"]) == {"ppo"}
    nothing = draw(shown=BETA, runs={run: frame * 0 for run, frame in frames().items()})
    assert [text.get_text() for text in nothing.axes[0].texts] == ["β is 0 in every run"]


def test_each_panel_shows_the_means_of_its_environment():
    """Each with dashes of its own; single seeds are drawn up to ten, and not more."""
    curves, _ = data(seeds=4)
    for axes in draw(seeds=4).axes:
        shown = {line.get_label(): line.get_ydata() for line in axes.lines}
        for variant, label in LABELS.items():
            expected = at(curves, env=axes.get_title(), variant=variant)["mean"]
            np.testing.assert_array_equal(shown[label], expected)
    lines = draw(seeds=4).axes[0].get_legend_handles_labels()[0]
    assert len({str(line._unscaled_dash_pattern) for line in lines}) == len(LABELS)
    for seeds in (10, 11):
        figure = draw(seeds=seeds)
        [words] = [legend.get_title().get_text() for legend in figure.legends]
        assert ("Faint lines" in words) == (seeds == 10)
        assert len(figure.axes[0].lines) == len(LABELS) * (1 + seeds * (seeds == 10))


# Of somebody's matplotlibrc.
USERS = {"text.usetex": True, "font.size": 30, "font.family": "serif", "savefig.bbox": "tight"}
USERS |= {"axes.formatter.use_locale": True, "path.simplify": False, "pdf.compression": 0}
USERS |= {"axes.prop_cycle": matplotlib.cycler(color="r"), "axes.grid": True}


@pytest.mark.parametrize(("seeds", "drawn"), [(1, 0), (2, 2), (10, 10), (11, 0)])
def test_single_seeds_are_drawn_and_told_if_there_are_two_to_ten(seeds, drawn, tmp_path):
    """With more they are not even needed."""
    figure = draw(seeds=seeds, episodes=12)
    assert [len(axes.lines) for axes in figure.axes] == [2 + 2 * drawn] * 2
    assert ("Faint lines" in figure.legends[0].get_title().get_text()) == bool(drawn)
    means, single = data(seeds=seeds, episodes=12)
    assert c.shows_seeds(means) == (seeds <= 10)
    if seeds > 10:
        look = c.PlotStyle(FigureConfig(columns=3), 0.95, LABELS, COLOURS, {})
        without = c.draw_figure(means, single.iloc[:0], RETURN, look)
        for name, each in {"with": figure, "without": without}.items():
            c.save_figure(each, tmp_path / f"{name}.png")
        assert (tmp_path / "with.png").read_bytes() == (tmp_path / "without.png").read_bytes()


def test_labels_are_plain_text(monkeypatch):
    for label in ("$$", r"$\notacommand{$", r"$\lambda$ & <50 %> #~^{}", "long " * 12):
        monkeypatch.setitem(LABELS, "ppo", label)
        figure = draw()
        assert label in [text.get_text() for text in figure.legends[0].get_texts()]
        figure.draw_without_rendering()  # lays it out
        assert figure.legends[0].get_window_extent().width < figure.bbox.width


@pytest.mark.parametrize("kind", ["pdf", "png"])
def test_the_same_data_gives_the_same_file_and_another_colour_does_not(tmp_path, monkeypatch, kind):
    contents = []
    for epoch, colours in (("0", COLOURS), ("1000000000", COLOURS), ("0", COLOURS | {"ppo": "k"})):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)  # what matplotlib would take for the time
        with matplotlib.rc_context(USERS if epoch != "0" else {}):
            figure = draw(colours=colours, episodes=200, inset=0.9)
            c.save_figure(figure, tmp_path / f"figure.{kind}")
        contents.append((tmp_path / f"figure.{kind}").read_bytes())
    assert contents[0] == contents[1] != contents[2]
    if kind == "pdf":  # vectors, and fonts that journals take
        assert b"/FontFile2" in contents[0]
        assert not any(word in contents[0] for word in (b"/Type3", b"/Subtype /Image", b"Creat"))


def test_a_picture_in_256_colours_looks_the_same():
    draws = np.random.default_rng(0)
    colours = np.full((200, 200, 3), 255, np.uint8)
    colours[:100] = draws.integers(0, 256, (100, 200, 1))  # greys
    colours[100:150, :, 2] = draws.integers(0, 256, (50, 200))
    colours[180:184, 180:184] = 2, 158, 115  # a dot, as in a legend: nothing else is like it
    picture = c.few_colours(Image.fromarray(colours).convert("RGBA"))
    assert picture.mode == "P" and len(picture.getcolors()) <= 256
    assert abs(np.asarray(picture.convert("RGB"), int) - colours).max() < 4


def test_an_inset_shows_a_beginning_in_which_most_is_learned():
    runs = frames(episodes=200)
    for (environment, variant, seed), run in runs.items():
        slope = 0.5 if (environment, variant) == ("B-v1", "ppo") else 20  # of both one learns late
        run["extrinsic_return"] = np.minimum(slope * np.arange(200), 100.0) + seed
    first, second = draw(runs=runs, inset=0.1).axes[:2]
    [inset] = first.child_axes
    assert inset.get_xlim() == (0, 20) and not second.child_axes
    assert [line.get_xdata().tolist() for line in inset.lines] == [list(range(1, 21))] * 2


# --- Pictures of all runs at once -----------------------------------------------------------------

CONSTANTS = ["beta_1", "ppo"]


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
    advantage = {"ppo": 0.0, "mace_fixed": 0.03, "mace_full": 0.06}
    claimed, asked = table_for_claims(12, advantage, 0.05), table_for_questions(12)
    return [ledger(table, QUESTIONED, CLAIMS) for table in (claimed, asked)]


@pytest.fixture
def settings() -> MetricsConfig:
    chosen = ConstantsConfig(learned="mace_full", fixed=CONSTANTS)
    return STUDY.metrics.model_copy(update={"constants": chosen, "bootstrap_repetitions": 500})


def test_every_run_is_there_with_its_returns(runs, settings) -> None:
    table = PICTURES["every_seed"].data(Source({"metrics": runs}, [], settings, CLAIMS))
    assert len(table) == 2 * len(runs)
    for row in table.sample(20, random_state=0).itertuples():
        own = runs[(runs["env"] == row.env) & (runs["seed"] == row.seed)]
        assert row.value == own.set_index("variant").loc[row.variant, row.metric]


def test_constants_come_in_their_order_with_the_learned_one_last(runs, settings) -> None:
    table = PICTURES["constants"].data(Source({"metrics": runs}, [], settings, CLAIMS))
    names = sorted(set(table["variant"]))
    labels, colours = {name: name for name in names}, dict.fromkeys(names, "C0")
    look = c.PlotStyle(FigureConfig(columns=3), 0.95, labels, colours, {})
    panels = PICTURES["constants"].draw(table, look).axes
    for (environment, rows), axes in zip(table.groupby("env", sort=False), panels, strict=False):
        assert len(axes.containers) == (rows["role"] != "learned").sum()  # dots with bars
        assert list(rows["variant"][:2]) == CONSTANTS
        roles = dict.fromkeys(CONSTANTS, "fixed") | {"mace_full": "learned"}
        assert dict(zip(rows["variant"], rows["role"], strict=True)) == roles
        for row in rows.itertuples():
            own = runs[(runs["env"] == environment) & (runs["variant"] == row.variant)]
            values = own["area_under_curve"].to_numpy()
            assert (row.mean, row.seeds) == (values.mean(), len(values))
            bounds = mean_interval(values, 0.95, 500, np.random.default_rng(0))
            assert (row.low, row.high) == tuple(map(float, bounds))


def test_a_seed_solves_its_task_if_nine_of_ten_last_episodes_do(runs, settings) -> None:
    table = PICTURES["solved"].data(Source({"metrics": runs}, [], settings, CLAIMS))
    for row in table.itertuples():
        own = runs[(runs["env"] == row.env) & (runs["variant"] == row.variant)]["solved"]
        assert (row.solved, row.seeds) == (sum(share >= 0.9 for share in own), len(own))


@pytest.mark.parametrize("family", range(2))
def test_the_forest_has_every_part_in_units_of_the_margin(ledgers, family, settings) -> None:
    ledger = ledgers[family]
    table = PICTURES["forest"].data(Source({}, ledger, settings, CLAIMS))
    assert set(table["measured"]) == set(ledger[0].ways)
    for how, rows in table.groupby("measured"):
        judgements = [one.ways[how] for one in ledger if how in one.ways]
        parts = [(judged, part) for judged in judgements for part in judged.parts]
        for (judged, part), (_, row) in zip(parts, rows.iterrows(), strict=True):
            assert row["verdict"] == judged.verdict
            for name in ("difference", "low", "high"):
                assert row[name] * part.worth_mentioning == pytest.approx(getattr(part, name))
            assert np.isnan(row["paper"]) == np.isnan(part.in_paper)
            assert row["outcome"] == part.outcome and row["answer"] == judged.outcome
            assert row["size"] == part.size
        assert not rows.duplicated(["claim", "part"]).any()  # the words tell parts from each other


def test_parts_over_zero_are_told_apart_by_their_variants(ledgers, settings) -> None:
    part = ledgers[0][0].ways[ROBUST].parts[0]
    parts = [replace(part, variant=name, baseline=None) for name in VARIANTS]
    source = Source({}, [], settings, CLAIMS.model_copy(update={"variants": {"ppo": "PPO"}}))
    assert [words(each, parts, source) for each in parts] == ["PPO", *VARIANTS[1:]]


@pytest.mark.parametrize(
    ("name", "family"),
    [("every_seed", 0), ("constants", 0), ("solved", 0), *(("forest", i) for i in range(2))],
)
def test_every_picture_is_the_same_again(runs, ledgers, settings, tmp_path, name, family):
    source = Source({"metrics": runs}, ledgers[family], settings, CLAIMS)
    names = dict.fromkeys(runs["variant"], "A label (of some length)") | {"beta_1": "β = 1"}
    colours = dict.fromkeys(names, "tab:blue")
    look = c.plot_style(QUESTIONED, STUDY.figure.model_dump(), names, colours)
    table = PICTURES[name].data(source)
    table.to_csv(tmp_path / "table.csv", index=False)
    read = pd.read_csv(tmp_path / "table.csv", keep_default_na=False, na_values=[""])
    for path, data in (("a.png", table), ("b.png", read)):
        figure = PICTURES[name].draw(data, look)
        c.save_figure(figure, tmp_path / path)
    assert not illegible(figure)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_an_inset_never_lies_on_a_curve():
    early = np.concatenate([np.arange(20), np.full(180, 19.0)])
    low = np.where(np.arange(200) < 25, early, 8.0)  # it comes down to where the inset would be
    curves = [
        pd.DataFrame({"env": "E", "variant": variant, "episode": np.arange(1, 201), "n": 1}).assign(
            mean=mean, lower=np.nan, upper=np.nan
        )
        for variant, mean in (("a", early), ("b", early), ("c", low))
    ]
    shown, found = c.quantity("1", QUICK), []
    for own in (curves[:2], curves):
        seeds = pd.concat(own).rename(columns={"mean": shown.name}).assign(seed=0)
        names = {name: name for name in "abc"}
        colours = dict(zip("abc", ("red", "green", "blue"), strict=True))
        look = c.PlotStyle(FigureConfig(columns=1, inset=0.1), 0.95, names, colours, {})
        [panel] = c.draw_figure(pd.concat(own), seeds, shown, look).axes[:1]
        found.append(len(panel.child_axes))
    assert found == [1, 0]
