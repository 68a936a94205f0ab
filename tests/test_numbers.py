"""README and docs say what the kept tables say, and what is printed of them is right."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from invented import table_for_claims

from mace_rl.config.study import Study
from mace_rl.results import claims, claims_text
from tools import kept_runs, printed_numbers
from tools.shown import results, runs

ROOT = Path(__file__).parents[1]


def test_the_pages_say_what_the_kept_tables_say(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["numbers", "--check"])
    printed_numbers.main()
    said = capsys.readouterr().out
    assert said.endswith("marked texts, 0 differ\n")
    assert int(said.split()[0]) >= 5


def test_a_number_that_is_not_printed_is_refused_and_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "docs").mkdir()
    shutil.copytree(ROOT / "reference/tables/baseline", tmp_path / "reference/tables/baseline")
    page = tmp_path / "README.md"
    page.write_text(
        "<!-- python -m tools.show means reference/tables/baseline -->\n9\n<!-- end -->"
    )
    monkeypatch.setattr(printed_numbers, "ROOT", tmp_path)
    monkeypatch.setattr("sys.argv", ["numbers", "--check"])
    with pytest.raises(SystemExit, match=r"README\.md: means reference/tables/baseline"):
        printed_numbers.main()
    assert "\n9\n" in page.read_text()
    monkeypatch.setattr("sys.argv", ["numbers"])
    printed_numbers.main()
    assert "| Acrobot-v1 | ppo | 20 |" in page.read_text()
    page.write_text("<!-- python -m tools.show means reference/none -->\n<!-- end -->")
    with pytest.raises(SystemExit, match="reference/none"):
        printed_numbers.main()
    mark = "<!-- python -m tools.show means reference/tables/baseline -->"
    for text in (f"{mark}\nwords\n{mark}\n<!-- end -->\n", f"{mark}\n", f"{mark} 9\n<!-- end -->"):
        page.write_text(text)
        with pytest.raises(SystemExit, match=r"README\.md: not each .* has its <!-- end -->"):
            printed_numbers.main()
        assert page.read_text() == text


def test_the_study_page_has_no_decimal_or_count_of_its_own() -> None:
    text = printed_numbers.MARKED.sub("", (ROOT / "docs/study.md").read_text(encoding="utf-8"))
    own = re.findall(r"(?<![\w.])[−-]?\d+\.\d+|\d+ of \d+", text)
    assert set(own) <= {"0.5", "0.05"}, "of a probability and of a test"


def write(frame: pd.DataFrame, folder: Path) -> Path:
    frame.to_csv(folder / "metrics.csv", index=False)
    return folder


def test_means_and_solved_seeds(tmp_path: Path) -> None:
    rows = [
        {"env": env, "variant": "ppo", "seed": seed, "final_return": seed + 0.5}
        | {"area_under_curve": -float(seed), "solved": 0.9 if seed < 3 else 0.89}
        for env in ("A-v0", "B-v0")
        for seed in range(4)
    ]
    folder = write(pd.DataFrame(rows), tmp_path)
    mean = results.means(folder, "final_return")[2]
    assert mean.startswith("| A-v0 | ppo | 4 | 2 (")
    low, high = map(float, re.findall(r"\((\S+) to (\S+)\)", mean.replace("−", "-"))[0])
    half = 3.182446 * np.std([0.5, 1.5, 2.5, 3.5], ddof=1) / 2  # t with 3 degrees of freedom
    assert (low, high) == (pytest.approx(2 - half, abs=1e-3), pytest.approx(2 + half, abs=1e-3))
    assert results.solved(folder)[2] == "| ppo | 3 of 4; −1.5 | 3 of 4; −1.5 |"


def test_the_headline_counts_the_verdicts(tmp_path: Path, study: Study) -> None:
    frame = table_for_claims(20, {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}, noise=0.02)
    settings = study.metrics.model_copy(update={"bootstrap_repetitions": 1000})
    text = claims_text.as_json(claims.ledger(frame, settings), {"runs": 1})
    (tmp_path / "claims.json").write_text(text, encoding="utf-8")
    (line,) = results.headline(tmp_path)
    assert "10 claims: 9 reproduced, 1 contradicted, 0 inconclusive" in line
    share = float(re.findall(r"by (\S+) % of the way", line)[0])
    assert share == pytest.approx(30, abs=3)
    assert len(results.ledger(tmp_path)) == 12
    assert sum("| holds |" in line for line in results.parts(tmp_path)) == 22


def test_differences_are_of_one_metric_and_of_single_environments(tmp_path: Path) -> None:
    row = {"variant": "full", "baseline": "ppo", "seeds": 12, "low": -3.0, "high": 0.123456}
    rows = [
        {**row, "env": "A-v0", "metric": "return", "difference": -1.5, "p_value": 0.01234},
        {**row, "env": "A-v0", "metric": "area_under_curve", "difference": 9.0, "p_value": 0.5},
        {**row, "env": "all", "metric": "return", "difference": np.nan, "p_value": np.nan},
    ]
    table = pd.DataFrame(rows)
    table.assign(p_holm=3 * table["p_value"]).to_csv(tmp_path / "comparisons.csv", index=False)
    lines = results.differences(tmp_path, "return")
    assert lines[2:] == ["| A-v0 | full − ppo | 12 | −1.5 (−3 to 0.1235) | 0.0123 | 0.0370 |"]


def test_together_weighs_every_environment_alike(tmp_path: Path) -> None:
    """Two studies: in B-v0 of the second every run of the variant wins, elsewhere half do."""
    (tmp_path / "first").mkdir()
    (tmp_path / "second").mkdir()
    areas = {"first": {"A-v0": ([1.0, 3.0], [2.0, 2.0])}}
    areas["second"] = {"A-v0": ([1.0], [9.0]), "B-v0": ([5.0, 6.0, 7.0], [1.0, 2.0, 3.0])}
    for name, environments in areas.items():
        rows = [
            {"env": env, "variant": variant, "seed": seed, "area_under_curve": area}
            for env, both in environments.items()
            for variant, values in zip(("full", "other"), both, strict=True)
            for seed, area in enumerate(values)
        ]
        write(pd.DataFrame(rows), tmp_path / name)
    line = results.together(tmp_path / "first", "second", "full", "other")[-1]
    assert line.startswith("| full over other | 2 | 2 to 3 | 0.75 (")
    for words, reason in (
        (("full", "nobody"), "'full' and 'nobody'"),
        (("full",), "wants a variant"),
    ):
        with pytest.raises(SystemExit, match=reason):
            results.together(tmp_path / "first", "second", *words)


def test_a_regret_that_no_constant_has_is_an_empty_cell(tmp_path: Path) -> None:
    head = "env,variant,best_constant,best_area,variant_area,regret,low,high,seeds\n"
    rows = "A-v0,full,ppo,1,0.5,0.5,-0.00001,0.75,9\nB-v0,full,ppo,1,0.5,,,,9\n"
    (tmp_path / "regret.csv").write_text(head + rows)
    assert results.regret(tmp_path)[2:] == [
        "| A-v0 | ppo | 1 | 0.5 | 0.5000 (0.0000 to 0.7500) | 9 |",
        "| B-v0 | ppo | 1 | 0.5 |  | 9 |",
    ]


def test_finals_name_the_worst_seed(tmp_path: Path) -> None:
    rows = [
        {"env": "A-v0", "variant": "ppo", "final_return": final, "area_under_curve": 2 * final}
        for final in (3.0, 1.0, 5.0)
    ]
    (line,) = results.finals(write(pd.DataFrame(rows), tmp_path))[2:]
    assert line == "| ppo | 3 [1] / 6 |"


def test_the_betas_of_each_seed_are_in_order_of_size(tmp_path: Path) -> None:
    """20 episodes: those of the last two count."""
    content = {}
    for seed, last in enumerate((0.5, 0.2)):
        frame = pd.DataFrame({"beta": [1.0] * 18 + [last, last + 0.1]})
        content[f"seed{seed}/episodes.csv"] = frame.to_csv(index=False).encode()
        content[f"seed{seed}/run.json"] = b"{}"
    kept_runs.write(tmp_path / "A-v0" / "mace_full.tar.xz", content)
    assert runs.betas(tmp_path, "A-v0")[2:] == ["| A-v0 | 2 | 0.25, 0.55 |"]
    assert runs.lowest(tmp_path, "A-v0")[2:] == ["| A-v0 | 2 | 0.20, 0.50 |"]
