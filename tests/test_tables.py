"""Tables and comparisons from a small frame: numbers against scipy, LaTeX by its structure."""

import os
import re
import shutil
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import table_for_tables

from mace_rl.config.agent import PPOConfig, TorchModule
from mace_rl.config.study import read_study
from mace_rl.results.latex import escaped, supplement_latex, table1_latex, table2_latex
from mace_rl.results.metrics import Metric, all_metrics
from mace_rl.results.paper import ENVIRONMENTS, PAPER_TABLE1
from mace_rl.results.paper import VARIANTS as PAPER_VARIANTS
from mace_rl.results.tables import supplement, table1

STUDY = read_study([Path(__file__).parents[1] / "config.yaml"])
SETTINGS = STUDY.metrics.model_copy(update={"bootstrap_repetitions": 1000})
metrics = partial(table_for_tables, all_metrics(SETTINGS))
PAPER, VARIANTS = list(ENVIRONMENTS), list(PAPER_VARIANTS)
LABELS = {"ppo": "PPO (Baseline)", "mace_fixed": "MACE-RL (Fixed β)", "mace_full": "MACE-RL (Full)"}
WORST = Metric("worst", "Worst & last", "return", lambda curve: curve.returns.min())
PPO = STUDY.run_config("CartPole-v1", "ppo", 0).ppo.model_copy(
    update={
        "entropy_coefficient": 1e-05,
        "hidden_units": [64, 32],
        "gae_lambda": 1.0,
        "normalise_observations": False,
    }
)


def cells(fragment):
    """{(variant or row label, place of the column): cell}, as printed."""
    found = {}
    for line in fragment.splitlines():
        if line.startswith(r"\raggedright"):
            label, *values = line.removeprefix(r"\raggedright ").removesuffix(r" \\").split(" & ")
            label = label.replace(r"\newline ", " ").replace(r"$\beta$", "β")
            name = next((name for name in LABELS if LABELS[name] == label), label)
            found |= {(name, place): value for place, value in enumerate(values)}
    return found


def test_summary_against_pandas_and_scipy():
    frame = metrics(seeds=5)
    result = table1(frame, SETTINGS)
    assert len(result) == 3 * 3 * 2
    for row in result.itertuples():
        values = frame.query("env == @row.env and variant == @row.variant")[row.metric]
        assert row.mean == pytest.approx(values.mean())
        low, high = scipy.stats.t.interval(0.95, 4, values.mean(), values.sem())
        assert (row.low, row.high) == pytest.approx((max(low, 1), min(high, 2000)))
        assert (row.seeds, row.censored, row.episodes) == (5, 0, 2000)


def test_the_interval_of_a_share_ends_at_0_and_1():
    own = SETTINGS.model_copy(update={"solved_return": {"CartPole-v1": 475.0}})
    frame = metrics(["CartPole-v1"], ["ppo"]).assign(solved=[0.0, 1.0, 1.0])
    row = supplement(frame, own).set_index("metric").loc["solved"]
    assert (row["mean"], row["low"], row["high"]) == (pytest.approx(2 / 3), 0, 1)
    fragment = supplement_latex(supplement(frame, own), {}, own)
    assert r"0.67\\{\scriptsize [0.00,\,1.00]}" in cells(fragment)["Solved at the end", 0]


def test_the_papers_numbers_stand_beside_ours():
    result = table1(metrics(["CartPole-v1", "Pendulum-v1"], ["ppo", "mace_fixed_0.2"]), SETTINGS)
    papers = result.set_index(["env", "variant", "metric"])["paper"]
    assert papers["CartPole-v1", "ppo", "sample_efficiency"] == 140
    assert papers["CartPole-v1", "ppo", "convergence_steps"] == 660
    assert papers.isna().sum() == 6
    # Table 1 of the paper, read across its rows.
    across = [PAPER_TABLE1[environment, variant] for variant in VARIANTS for environment in PAPER]
    assert across == [
        *((186, 617), (140, 660), (865, 1841)),
        *((201, 595), (120, 620), (782, 1801)),
        *((249, 586), (104, 634), (495, 1799)),
    ]


def test_censored_runs_are_counted_and_kept():
    frame = metrics(
        ["Acrobot-v1"],
        ["ppo"],
        sample_efficiency={"ppo": [100, 2000, 2000]},
        sample_efficiency_censored={"ppo": [0, 1, 1]},
    )
    row = table1(frame, SETTINGS).iloc[0]
    assert row["mean"] == pytest.approx(4100 / 3)
    assert row["censored"] == 2
    assert r"\textbf{1367}$^{\dagger2}$" in table1_latex(table1(frame, SETTINGS), LABELS, SETTINGS)


def test_no_cell_depends_on_another_environment_or_variant():
    """Bootstrap intervals included: more columns do not change a number."""
    all_of_it = metrics(seeds=12)
    part = all_of_it[(all_of_it["env"] == "CartPole-v1") & (all_of_it["variant"] == "mace_full")]
    alone, among = table1(part, SETTINGS), table1(all_of_it, SETTINGS)
    among = among[(among["env"] == "CartPole-v1") & (among["variant"] == "mace_full")]
    pd.testing.assert_frame_equal(alone, among.reset_index(drop=True), check_exact=True)


def test_table1_has_the_papers_layout():
    frame = metrics(
        ["CartPole-v1"],
        sample_efficiency={"ppo": [1, 2, 3], "mace_fixed": [120] * 3, "mace_full": [104] * 3},
        convergence_steps={"ppo": [660] * 3, "mace_fixed": [620] * 3, "mace_full": [634] * 3},
    )
    fragment = table1_latex(table1(frame, SETTINGS), LABELS, SETTINGS)
    found = cells(fragment)
    assert [name for name, _ in found] == list(LABELS)
    # Mean 2, standard error 1 / √3, t of two degrees of freedom 4.303: 2 ± 2.48, but not below 1.
    assert r"\textbf{2} / 660\\{\scriptsize [1,\,4]/[660,\,660]}" in found["ppo", 0]
    assert r"120 / \textbf{620}\\" in found["mace_fixed", 0]
    assert r"104 / 634\\" in found["mace_full", 0]
    assert r"Algorithm & CartPole-v1 \\" in fragment
    assert r"Means over 3 seeds and, below, their 95\,\% $t$ intervals." in fragment
    assert "Training budget: 2000 episodes (CartPole-v1)." in fragment
    assert "dagger" not in fragment


def test_ties_are_all_bold_as_displayed():
    frame = metrics(
        ["CartPole-v1"],
        sample_efficiency={"ppo": [104, 104, 105], "mace_fixed": [104] * 3, "mace_full": [105] * 3},
        convergence_steps={variant: [600] * 3 for variant in VARIANTS},
    )
    found = cells(table1_latex(table1(frame, SETTINGS), LABELS, SETTINGS))
    assert r"\textbf{104} / \textbf{600}" in found["ppo", 0]  # 104.33 is shown as 104
    assert r"\textbf{104} / \textbf{600}" in found["mace_fixed", 0]
    assert r"}105 / \textbf{600}" in found["mace_full", 0]


def test_a_mean_of_seeds_that_all_failed_is_never_the_best():
    frame = metrics(
        ["CartPole-v1"],
        ["ppo"],
        convergence_steps={"ppo": [2000] * 3},
        convergence_steps_censored={"ppo": [1] * 3},
    )
    fragment = table1_latex(table1(frame, SETTINGS), LABELS, SETTINGS)
    assert r" / 2000$^{\dagger3}$" in cells(fragment)["ppo", 0]
    assert "a lower bound" in fragment
    # Nor where the best mean, of a variant that got there once, is shown as the same number.
    frame = metrics(
        ["CartPole-v1"],
        ["ppo", "mace_full"],
        convergence_steps={"ppo": [1999, 2000, 2000], "mace_full": [2000] * 3},
        convergence_steps_censored={"ppo": [0, 1, 1], "mace_full": [1] * 3},
    )
    found = cells(table1_latex(table1(frame, SETTINGS), LABELS, SETTINGS))
    assert r" / \textbf{2000}$^{\dagger2}$" in found["ppo", 0]
    assert r" / 2000$^{\dagger3}$" in found["mace_full", 0]


def test_one_seed_has_no_interval():
    fragment = table1_latex(table1(metrics(seeds=1), SETTINGS), LABELS, SETTINGS)
    assert r"{\scriptsize --/--}" in fragment
    assert "One seed, which allows no interval." in fragment
    assert "nan" not in fragment


def test_the_caption_names_the_interval_and_every_budget():
    frame = metrics(seeds=10)
    frame.loc[frame["env"] == "HopperBulletEnv-v0", "episodes"] = 6000
    fragment = table1_latex(table1(frame, SETTINGS), LABELS, SETTINGS)
    assert r"Means over 10 seeds and, below, their 95\,\% bootstrap intervals." in fragment
    assert "2000 episodes (Acrobot-v1, CartPole-v1); 6000 episodes (HopperBulletEnv-v0)" in fragment


@pytest.mark.parametrize(
    ("fewest", "expected"),
    [
        (10, r"Means over 10 to 12 seeds and, below, their 95\,\% bootstrap intervals."),
        (5, r"Means over 5 to 12 seeds and, below, their 95\,\% $t$ (below 10 seeds) or bootstrap"),
        (1, r"their 95\,\% bootstrap intervals; one seed allows none. Training"),
    ],
)
def test_the_caption_of_different_seeds_holds_for_all_of_them(fewest, expected):
    frame = metrics(seeds=12)
    few = (frame["env"] != "HopperBulletEnv-v0") | (frame["seed"] < fewest)
    assert expected in table1_latex(table1(frame[few], SETTINGS), LABELS, SETTINGS)


def test_small_returns_have_more_digits_and_zero_has_no_sign():
    frame = metrics(["DeepSea10-v0"], ["ppo", "mace_full"], seeds=2)
    small = frame["variant"] == "ppo"
    frame["final_return"] = np.where(small, 0.6934, -0.0001)
    frame["early_return"] = np.where(small, -0.0032, -0.0021)
    frame["area_under_curve"] = 0.0
    found = cells(supplement_latex(supplement(frame, SETTINGS), {}, SETTINGS))
    rows: dict[str, list[str]] = {}
    for (name, _), cell in found.items():
        rows.setdefault(name, []).append(re.search(r"c@\{\}\}(.*?)\\\\", cell)[1])
    assert rows["Final return"] == ["0.693", "0.000"]
    assert rows["Mean return of the beginning"] == ["$-$0.00320", "$-$0.00210"]
    assert rows["Mean return of training"] == ["0.0", "0.0"]


def test_more_than_three_environments_continue_below():
    environments = [*PAPER, "Under_score-v0", "Pendulum-v1"]
    fragment = table1_latex(table1(metrics(environments), SETTINGS), {}, SETTINGS)
    heads = re.findall(r"Algorithm & (.*) \\\\", fragment)
    assert heads == [" & ".join(PAPER), r"Under\_score-v0 & Pendulum-v1"]
    assert fragment.count("mace\\_full &") == 2


def test_the_supplement_has_every_companion():
    fragment = supplement_latex(supplement(metrics(), SETTINGS), LABELS, SETTINGS)
    found = cells(fragment)
    assert [name for name, place in found if place == 0] == [
        "Final return",
        "Mean return of training",
        "Mean return of the beginning",
        "Sample efficiency (common bar)",
        "Sample efficiency (range)",
        "Convergence (range)",
        "Convergence (steepest)",
        "Convergence (flattest)",
        "Convergence (public code)",
    ]
    assert r"$-$85.2\\{\scriptsize [$-$85.2,\,$-$85.2]}" in found["Final return", 0]
    assert "." not in found["Convergence (range)", 0]
    captions = re.findall(r"\\caption{(.*), the companion metrics\. Means over 3 seeds", fragment)
    assert captions == PAPER
    assert len(set(re.findall(r"\\label{(.*)}", fragment))) == fragment.count(r"\label") == 3
    own = SETTINGS.model_copy(update={"custom": [f"{__name__}:WORST"]})
    frame = metrics(["CartPole-v1"]).assign(worst=-7.0)
    fragment = supplement_latex(supplement(frame, own), LABELS, own)
    assert r"$-$7.00\\" in cells(fragment)[r"Worst \& last", 0]


def test_table2_has_the_papers_rows_then_ours():
    changes = {"gae_lambda": 0.95, "normalise_observations": True}
    changes["network"] = TorchModule(kind="torch", module="my_nets:layer_norm")
    hopper = PPO.model_copy(update=changes)
    fragment = table2_latex({"Acrobot-v1": PPO, "A_b-v0": PPO, "Hopper": hopper})
    paper, ours = fragment.split(r"\midrule")[1:]
    assert re.findall(r"\\raggedright (.*) \\\\", paper) == [
        "Actor Learning Rate & 0.0003",
        "Critic Learning Rate & 0.001",
        r"Discount Factor ($\gamma$) & 0.99",
        "PPO Epochs ($K$) & 4",
        r"PPO Clip Parameter ($\epsilon$) & 0.2",
        "Optimizer & Adam",
    ]
    assert r"1.0 (Acrobot-v1, A\_b-v0)\\0.95 (Hopper)" in ours
    assert r"no (Acrobot-v1, A\_b-v0)\\yes (Hopper)" in ours
    assert r"Entropy Coefficient & $1 \times 10^{-5}$ \\" in ours
    assert r"tanh network (Acrobot-v1, A\_b-v0)\\my\_nets:layer\_norm (Hopper)" in ours
    assert "& 64, 32 " in ours
    assert "None" not in ours
    # Every setting is there: five of the paper's rows and Adam, and a row for each of the others.
    assert fragment.count("raggedright") == len(PPOConfig.model_fields) + 1


def test_special_characters_are_escaped_once():
    assert escaped(r"a_b & 50 % β ~ \x {1} #2 $3^4 λ") == (
        r"a\_b \& 50 \% $\beta$ \textasciitilde{} \textbackslash{}x \{1\} \#2"
        r" \$3\textasciicircum{}4 $\lambda$"
    )


def fragments():
    many = metrics([*PAPER, "Under_score-v0", "MountainCarContinuous-v0"], seeds=12)
    many["sample_efficiency"] += 1000  # four digits in every cell are the widest there are
    many["episodes"] = 6000
    labels = LABELS | {"mace_full": "MACE-RL (Full, Meta Network) 100 % & β"}
    return [
        table1_latex(table1(many, SETTINGS), labels, SETTINGS),
        table1_latex(table1(metrics(seeds=1), SETTINGS), {}, SETTINGS),
        supplement_latex(supplement(many, SETTINGS), labels, SETTINGS),
        table2_latex({"A_b-v0": PPO, "HopperBulletEnv-v0": PPO.model_copy(update={"clip": 0.1})}),
    ]


FRAGMENTS = dict(zip(("table1", "one seed", "supplement", "table2"), fragments(), strict=True))


@pytest.mark.parametrize("fragment", FRAGMENTS.values(), ids=FRAGMENTS)
def test_the_latex_is_balanced(fragment):
    assert fragment.isascii()
    bare = re.sub(r"\\[\\{}]", "", fragment)
    assert bare.count("{") == bare.count("}")
    stack = []
    for kind, name in re.findall(r"\\(begin|end)\{([a-z*]+)\}", fragment):
        if kind == "begin":
            stack.append(name)
        else:
            assert stack.pop() == name
    assert not stack
    body = re.sub(r"(?s)\\begin\{tabular\}\[t\].*?\\end\{tabular\}", "", fragment)
    for part in re.findall(r"(?s)\\toprule\n(.*?)\\bottomrule", body):
        rows = [row for row in part.splitlines() if "&" in row]
        assert len({len(re.findall(r"(?<!\\)&", row)) for row in rows}) == 1
    # After \\ a bracket would be read as an optional argument.
    assert not re.search(r"\\\\\s*[\[*]", fragment)


@pytest.mark.skipif(
    shutil.which("pdflatex") is None and "CI" not in os.environ, reason="needs pdflatex"
)
@pytest.mark.parametrize("fragment", FRAGMENTS.values(), ids=FRAGMENTS)
def test_pdflatex_compiles_it_within_the_margins(fragment, tmp_path):
    document = (
        "\\documentclass{article}\n\\usepackage{booktabs}\n\\begin{document}\n"
        f"{fragment}\\end{{document}}\n"
    )
    (tmp_path / "page.tex").write_text(document)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout
    assert "Overfull \\hbox" not in run.stdout
    assert "Float too large" not in run.stdout
    assert "Missing character" not in run.stdout
