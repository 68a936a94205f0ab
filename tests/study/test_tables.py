"""Every table from small frames: numbers against scipy, three renderings of the same cells."""

import re
from decimal import Decimal
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from invented import (
    CLAIMS,
    ENVIRONMENTS,
    LITERAL,
    PAPERS,
    QUICK,
    ROBUST,
    STUDY,
    VARIANTS,
    digits_of,
    table_for_claims,
    table_for_tables,
)
from shared import NO_LATEX, pdflatex

from mace_rl.config.agent import PPOConfig, TorchModule
from mace_study.compare import summary
from mace_study.compare.aggregate import aggregate
from mace_study.compare.comparisons import comparisons
from mace_study.compare.verdicts import ledger
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.betas import BEFORE, CORRELATION
from mace_study.measure.betas import LABELS as TITLES
from mace_study.measure.metrics import Metric, all_metrics, metrics_columns
from mace_study.show import tables
from mace_study.show.latex import latex_cell, table1_latex, table2_latex
from mace_study.show.markdown import markdown, plain
from mace_study.show.markdown import page as markdown_page
from mace_study.show.sections import _others, of_ledger, of_runs, read_data
from mace_study.show.tables import Cell, Value, estimate, number

metrics = partial(table_for_tables, all_metrics(QUICK))
LABELS = {"ppo": "PPO (Baseline)", "mace_fixed": "MACE-RL (Fixed β)", "mace_full": "MACE-RL (Full)"}
WORST = Metric("worst", "Worst & last", "return", lambda curve: curve.returns.min())
SHOWN = {"entropy_coefficient": 1e-05, "hidden_units": [64, 32], "gae_lambda": 1.0}
PPO = STUDY.run_config("CartPole-v1", "ppo", 0).ppo.model_copy(update=SHOWN)


def table1(runs: pd.DataFrame, settings: MetricsConfig = QUICK) -> pd.DataFrame:
    return summary.split(summary.summary(runs, settings, CLAIMS.table1), CLAIMS.table1)[0]


def supplement(runs: pd.DataFrame, settings: MetricsConfig = QUICK) -> pd.DataFrame:
    return summary.split(summary.summary(runs, settings, CLAIMS.table1), CLAIMS.table1)[1]


def cells(frame: pd.DataFrame) -> dict[tuple[str, str], str]:
    """{(first cell of the row, column): cell} as Markdown prints it."""
    head, _, *lines = markdown(frame).splitlines()
    columns = [name.strip() for name in head.split("|")[2:-1]]
    found = {}
    for row, *rest in ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines):
        found |= {(row, name): cell for name, cell in zip(columns, rest, strict=True)}
    return found


def table1_of(**values: object) -> dict[tuple[str, str], str]:
    variants = list(next(iter(values.values())))  # type: ignore[call-overload]
    frame = table1(metrics(["CartPole-v1"], variants, **values))
    return cells(tables.table1(frame, QUICK, CLAIMS.table1))


def test_summary_against_pandas_and_scipy() -> None:
    frame = metrics(seeds=5)
    result = table1(frame, QUICK)
    assert len(result) == 3 * 3 * 2
    for row in result.itertuples():
        values = frame.query("env == @row.env and variant == @row.variant")[row.metric]
        low, high = scipy.stats.t.interval(0.95, 4, values.mean(), values.sem())
        expected = values.mean(), max(low, 1), min(high, 2000)
        assert (row.mean, row.low, row.high) == pytest.approx(expected)
        assert (row.seeds, row.censored, row.episodes) == (5, 0, 2000)
        assert row.paper == CLAIMS.table1.value(row.env, row.variant, row.metric)
    other = table1(metrics(["Pendulum-v1"], ["ppo"]), QUICK)
    assert other["paper"].isna().all()


def test_table_1_has_bold_ties_censored_means_and_the_papers_numbers() -> None:
    speeds = {"ppo": [1, 2, 3], "mace_fixed": [120] * 3, "mace_full": [104] * 3}
    ends = {"ppo": [600] * 3, "mace_fixed": [600, 600, 601], "mace_full": [2000] * 3}
    failed = {"ppo": [0] * 3, "mace_fixed": [0] * 3, "mace_full": [1] * 3}
    found = table1_of(
        sample_efficiency=speeds, convergence_steps=ends, convergence_steps_censored=failed
    )
    # Mean 2, standard error 1 / √3, t of two degrees of freedom 4.303: 2 ± 2.48, but not below 1.
    assert found == {
        ("ppo", "CartPole-v1"): "**2** / **600** (1 to 4 / 600 to 600); paper: 140 / 660",
        ("mace_fixed", "CartPole-v1"): "120 / **600** (120 to 120 / 599 to 602); paper: 120 / 620",
        ("mace_full", "CartPole-v1"): "104 / 2000†3 (104 to 104 / 2000 to 2000); paper: 104 / 634",
    }
    # A mean of seeds that all failed is never the best, though it is shown as the same number.
    ends = {"ppo": [1999, 2000, 2000], "mace_full": [2000] * 3}
    failed = {"ppo": [0, 1, 1], "mace_full": [1] * 3}
    found = table1_of(convergence_steps=ends, convergence_steps_censored=failed)
    assert " / **2000†2** (" in found["ppo", "CartPole-v1"]
    assert " / 2000†3 (" in found["mace_full", "CartPole-v1"]


def test_companions_have_the_digits_of_their_largest_mean_and_the_users_own_metrics() -> None:
    changes = {"custom": [f"{__name__}:WORST"], "solved_return": {"DeepSea10-v0": 0.5}}
    own = QUICK.model_copy(update=changes)
    frame = metrics(["DeepSea10-v0"], ["ppo", "mace_full"]).assign(worst=-7.0)
    small = frame["variant"] == "ppo"
    frame["final_return"] = np.where(small, 0.6934, -0.0001)
    frame["early_return"] = np.where(small, -0.0032, -0.0021)
    frame["solved"] = [0.0, 1.0, 1.0] * 2
    found = cells(tables.companions(supplement(frame, own), own)["DeepSea10-v0"])
    shown = {name: (found[name, "ppo"], found[name, "mace_full"]) for name, _ in found}
    assert shown["Final return"] == ("0.693 (0.693 to 0.693)", "0.000 (0.000 to 0.000)")
    beginning = [text.split()[0] for text in shown["Mean return of the beginning"]]
    assert beginning == ["−0.00320", "−0.00210"]
    assert shown["Solved at the end"] == ("0.67 (0.00 to 1.00)",) * 2  # the ends of a share
    assert shown["Worst & last"] == ("−7.00 (−7.00 to −7.00)",) * 2
    assert "." not in shown["Sample efficiency (range)"][0]
    names = {metric.label for metric in all_metrics(own)} - {"Sample efficiency", "Convergence"}
    assert set(shown) == names


def test_returns_worst_seeds_and_solved_tasks_by_variant_and_environment() -> None:
    frame = metrics(["A-v0", "B-v0"], ["ppo", "mace_full"], seeds=3)
    frame["final_return"] = np.arange(len(frame)) - 3.0
    frame["solved"] = [0.9, 1.0, 0.89] * 4
    frame = frame[(frame["env"] != "B-v0") | (frame["variant"] != "ppo")]
    means = tables.named(supplement(frame, QUICK), LABELS)
    found = cells(tables.means(means, "final_return", QUICK))
    assert found["PPO (Baseline)", "A-v0"].startswith("−2.00 (")
    assert found["MACE-RL (Full)", "B-v0"].startswith("7.00 (")
    assert found["PPO (Baseline)", "B-v0"] == ""
    worst = {("ppo", "A-v0"): "−3.00", ("ppo", "B-v0"): ""}
    worst |= {("mace_full", "A-v0"): "0.00", ("mace_full", "B-v0"): "6.00"}
    assert cells(tables.worst(frame, QUICK)) == worst
    assert cells(tables.solved(frame))["mace_full", "B-v0"] == "2 of 3"


def test_betas_are_of_runs_in_which_beta_changes() -> None:
    frame = pd.DataFrame({"env": "A-v0", "variant": ["ppo"] * 2 + ["mace_full"] * 3})
    frame["seed"] = [0, 1, 0, 1, 2]
    frame["beta_end"] = [0, 0, 0.9, 0.125, 0.5]
    frame["beta_lowest"] = [0, 0, 0.25, 0.1, 0.2]
    frame["beta_highest"] = [0, 0, 1.0, 0.9, 0.9]
    frame["stagnation_correlation"] = [0.0, 0, 0.5, 0.25, 0.375]
    (row,) = tables.betas(frame, QUICK).to_numpy()
    low, high = scipy.stats.t.interval(0.95, 2, 0.375, 0.125 / 3**0.5)
    assert list(row[:2]) == ["A-v0", "mace_full"]
    assert list(row[3:5]) == ["0.12, 0.50, 0.90", "0.10, 0.20, 0.25"]
    assert row[5].values == [estimate((0.375, low, high), 3)]


def test_table_2_has_the_papers_rows_then_ours() -> None:
    network = TorchModule(kind="torch", module="my_nets:layer_norm")
    hopper = PPO.model_copy(update={"gae_lambda": 0.95, "network": network})
    runs = {"Acrobot-v1": PPO, "A_b-v0": PPO, "Hopper": hopper}
    fragment = table2_latex(runs, CLAIMS.table2)
    paper, ours = fragment.split(r"\midrule")[1:]
    assert re.findall(r"\\raggedright (.*) \\\\", paper) == [
        "Actor Learning Rate & 0.0003",
        "Critic Learning Rate & 0.001",
        r"Discount Factor (\ensuremath{\gamma}) & 0.99",
        r"PPO Epochs (\ensuremath{\mathit{K}}) & 4",
        r"PPO Clip Parameter (\ensuremath{\varepsilon}) & 0.2",
        "Optimizer & Adam",
    ]
    for value in (r"1.0 (Acrobot-v1, A\_b-v0)\\0.95 (Hopper)", r"my\_nets:layer\_norm (Hopper)"):
        assert value in ours
    assert "1 {\\texttimes} 10\\ensuremath{^-}\\ensuremath{^5} " in ours and "None" not in ours
    # Every setting is there: five of the paper's rows and Adam, and a row for each of the others.
    assert fragment.count("raggedright") == len(PPOConfig.model_fields) + 1


@pytest.mark.parametrize(
    ("fewest", "expected"),
    [
        (12, r"over 12 seeds .* bootstrap intervals\."),
        (5, r"over 5 to 12 seeds .* \$t\$ \(below 10 seeds\) or bootstrap"),
        (1, r"bootstrap intervals; one seed allows none\."),
    ],
)
def test_the_caption_names_seeds_intervals_and_budgets(fewest: int, expected: str) -> None:
    frame = metrics(seeds=12)
    hopper = frame["env"] == "HopperBulletEnv-v0"
    frame.loc[hopper, "episodes"] = 6000
    shown = table1(frame[~hopper | (frame["seed"] < fewest)], QUICK)
    fragment = table1_latex(shown, {}, QUICK, CLAIMS.table1)
    assert re.search(expected, fragment) and "6000 episodes (HopperBulletEnv-v0)" in fragment
    assert "nan" not in fragment and (r"{\scriptsize --/--}" in fragment) == (fewest == 1)


@given(st.floats(-1e9, 1e9), st.integers(0, 5))
def test_a_number_reads_back_as_itself_rounded(value: float, digits: int) -> None:
    text = number(value, digits)
    read = Decimal(text.replace("−", "-"))
    assert abs(read - Decimal(value)) <= Decimal(10) ** -digits / 2
    assert "-" not in text and (read != 0 or "−" not in text)
    assert len(text.partition(".")[2]) == digits
    assert number(None) == number(float("nan"), digits) == "–"


CELL = Cell([Value("−2", "−3", "4", "†1", best=True), Value("5", "–", "–")], note="paper: <7>")


def test_a_cell_in_each_rendering() -> None:
    frame = pd.DataFrame([["a & b|c", CELL]], columns=["", "x<y"])
    assert markdown(frame).splitlines()[2] == (
        r"| a & b\|c | **−2†1** / 5 (−3 to 4 / – to –); paper: <7> |"
    )
    assert plain(frame) == "          x<y\na & b|c   −2†1* / 5"
    assert latex_cell(CELL) == (
        r"\begin{tabular}[t]{@{}c@{}}\textbf{\ensuremath{-}2}$^{\dagger1}$ / 5"
        r"\\{\scriptsize [\ensuremath{-}3,\,4]/--}\end{tabular}"
    )


def test_a_table_names_the_packages_of_all_its_words() -> None:
    cyrillic = r"% Needs \usepackage{booktabs} \usepackage[T2A,T1]{fontenc}"
    data, paper = table1(metrics(), QUICK), CLAIMS.table1
    captioned = paper.model_copy(update={"caption": "Шаги"})
    sharp = PPO.model_copy(update={"clip": 0.1})
    labelled = CLAIMS.table2.model_copy(update={"others": {"gae_lambda": "Шаги"}})
    for fragment, expected in (
        (table1_latex(data, {}, QUICK, paper), r"% Needs \usepackage{booktabs}"),
        (table1_latex(data, {}, QUICK, captioned), cyrillic),
        (table1_latex(data, {"ppo": "Шаги"}, QUICK, paper), cyrillic),
        (table2_latex({"A-v0": PPO}, labelled), cyrillic),
        (table2_latex({"A-v0": PPO, "A-v0: Шаги": sharp}, CLAIMS.table2), cyrillic),
    ):
        assert fragment.splitlines()[0] == expected


@pytest.mark.skipif(NO_LATEX, reason="needs pdflatex")
def test_pdflatex_compiles_every_fragment_within_the_margins(tmp_path: Path) -> None:
    many = metrics([*ENVIRONMENTS, "Under_score-v0", "MountainCarContinuous-v0"], seeds=12)
    many["sample_efficiency"] += 1000  # four digits in every cell are the widest there are
    many["episodes"] = 6000
    labels = LABELS | {"mace_full": "MACE-RL (Full, Meta Network) 100 % & βςΩ\u03bf"}
    fragments = [
        table1_latex(table1(many, QUICK), labels, QUICK, CLAIMS.table1),
        table1_latex(table1(metrics(seeds=1), QUICK), {}, QUICK, CLAIMS.table1),
        table2_latex({"A_b-v0": PPO, "B-v0": PPO.model_copy(update={"clip": 0.1})}, CLAIMS.table2),
    ]
    assert re.findall(r"Algorithm & (.*) \\\\", fragments[0]) == [
        *(" & ".join(ENVIRONMENTS), r"Under\_score-v0 & MountainCarContinuous-v0")  # below
    ]
    body = "\n".join(fragments)
    assert body.isascii() and body.count(r"\label") == 3
    said = pdflatex(tmp_path, ["\\usepackage{booktabs}"], body)
    for trouble in ("Overfull \\hbox", "Float too large", "Missing character"):
        assert trouble not in said


def test_names_are_read_as_they_were_written(tmp_path: Path) -> None:
    runs = metrics(["CartPole-v1"], ["NA", "None", "nan", "0.1", "1e3", "True", "007"])
    runs = runs.astype(metrics_columns(all_metrics(QUICK)))
    pairs = QUICK.model_copy(update={"comparisons": [["NA", "0.1"]]})
    made = {"metrics": runs, "table1": table1(runs), "comparisons": comparisons(runs, pairs)}
    for name, frame in made.items():
        frame.to_csv(tmp_path / f"{name}.csv", index=False)
    of_runs = runs[["env", "variant", "seed", "episodes"]].itertuples(index=False, name=None)
    read = read_data(tmp_path, made, list(of_runs), QUICK)
    for name, frame in made.items():
        pd.testing.assert_frame_equal(read[name], frame.reset_index(drop=True), check_dtype=False)


def test_the_page_of_a_study_has_each_of_its_tables_with_the_numbers_of_their_files() -> None:
    runs = metrics(seeds=10)
    kinds = {"table1": table1, "supplement": supplement, "comparisons": comparisons}
    kinds["aggregate"] = aggregate
    data = {name: make(runs, QUICK) for name, make in kinds.items()}
    beta = {"beta_end": 0.5, "beta_lowest": runs["seed"] / 10, "beta_highest": 0.6}
    beta["stagnation_correlation"] = 0
    data |= {"metrics": runs, "betas": runs[["env", "variant", "seed"]].assign(**beta)}
    equal = dict.fromkeys(VARIANTS, 0.0)
    claims = ledger(table_for_claims(12, equal, noise=0.02), QUICK, PAPERS)
    shown = [*of_ledger(claims, CLAIMS), *of_runs(data, CLAIMS, QUICK)]
    page = markdown_page("Tables", "Made by hand.", shown, ["figure1"])
    assert f"{LITERAL}: 0 reproduced, 10 not reproduced, 0 cannot tell (too few seeds)" in page
    row = data["comparisons"].set_index(["env", "metric", "variant", "baseline"])
    row = row.loc["CartPole-v1", "area_under_curve", "mace_full", "ppo"]
    assert f"| {number(row['p_value'], 4)} | {number(row['p_holm'], 4)} |" in page
    assert "| mace_full | 10 | 0.50, 0.50, 0.50 | 0.00, 0.45, 0.90 |" in page
    for part in (part for claim in claims for part in claim.ways[ROBUST].parts):
        digits = digits_of(part)
        shown = (number(getattr(part, name), digits) for name in ("difference", "low", "high"))
        assert "{} ({} to {})".format(*shown) in page
    detailed, part = tables.parts(claims, ROBUST).iloc[0], claims[0].ways[ROBUST].parts[0]
    assert detailed["room"] == number(part.room, 1)
    # A study without them: no claims, nothing to compare, one environment, β as it was set.
    alone = {name: make(runs.iloc[:10], QUICK) for name, make in kinds.items()}
    alone |= {"metrics": runs.iloc[:10], "betas": data["betas"].iloc[:0]}
    page = markdown_page("", "", of_runs(alone, CLAIMS, QUICK))
    assert not re.search("who is better|claims|environments together|## β|!\\[|nan", page)


def words(cell: str | tables.Cell) -> str:
    """What it shows first."""
    return cell if isinstance(cell, str) else cell.values[0].text


def test_every_column_of_a_table_has_the_label_of_what_is_in_it():
    """Each number is unlike all others, so that a cell tells the column that it is from."""
    values = dict(zip(TITLES, (0.1, 0.2, 0.3, 0.4, 0.5), strict=True))
    rows = [
        {"env": "E", "variant": "v", "seed": seed, "beta_highest": 0.9 + seed / 100} | values
        for seed in range(10)
    ]
    frame = tables.betas(pd.DataFrame(rows), QUICK)
    for name, value in values.items():
        cell = frame[TITLES[name]].iloc[0]
        assert float(words(cell).split(",")[0]) == value
    compared = {"difference": 11.0, "low": 12.0, "high": 13.0, "p_value": 0.14, "p_holm": 0.15}
    compared |= {"probability": 0.16, "probability_low": 0.17, "probability_high": 0.18}
    what = {"env": "E", "metric": "final_return", "variant": "v", "baseline": "w", "seeds": 19}
    means = pd.DataFrame([{**what, "mean": 11.0, "low": 12.0, "high": 13.0}])
    shown = tables.comparisons(pd.DataFrame([what | compared]), means, QUICK).iloc[0]
    heads = {"n": "seeds", "difference": "difference", "p": "p_value", "p (Holm)": "p_holm"}
    for head, name in heads.items():
        assert float(words(shown[head])) == pytest.approx((what | compared)[name])
    mean = {"mean": 0.21, "mean_low": 0.2, "mean_high": 0.3, "iqm": 0.22, "iqm_low": 0.1}
    one = {"variant": "v", "metric": "m", "runs": 23, **mean, "iqm_high": 0.4}
    shown = tables.aggregate(pd.DataFrame([one])).iloc[0]
    for head, name in {"runs": "runs", "mean": "mean", "interquartile mean": "iqm"}.items():
        assert float(words(shown[head])) == pytest.approx(one[name])


def test_the_page_names_the_column_that_a_claim_is_judged_by():
    for name in (CORRELATION, BEFORE):
        rows = [{"env": "E", "variant": "v", "seed": seed} for seed in range(10)]
        betas = pd.DataFrame(rows).assign(**dict.fromkeys([*TITLES, "beta_highest"], 0.5))
        betas["beta_end"] = betas["seed"] / 10
        asked = [("C9", name)]
        [beta] = _others({"metrics": betas, "betas": betas}, QUICK, asked)
        assert f"Of C9 it is the column *{TITLES[name]}*" in beta.note
