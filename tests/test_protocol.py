"""The protocol's page against the code that judges, and against the runs that it came before."""

import json
import re
import subprocess

import numpy as np
import pandas as pd
import pytest
from invented import LITERAL, ROBUST, ROOT

from mace_rl import files
from mace_rl.study.claims_config import parse_claims
from mace_rl.study.compare.verdicts import FEWEST_SEEDS, LEVEL, WORTH_MENTIONING
from mace_rl.study.config import read_study
from mace_rl.study.measure.betas import CORRELATION
from tools import kept_runs

CONFIRMATION = ROOT / "reference" / "confirmation"
CLAIMS = parse_claims(CONFIRMATION / "claims.yaml")
CLAIMED, ASKED = CLAIMS.families.values()
BARREN = "BarrenRegion-v0"
PAGE = ROOT / "docs" / "protocol.md"
TEXT = PAGE.read_text(encoding="utf-8")
ROWS = {
    cells[0]: cells[1:]
    for line in reversed(TEXT.splitlines())  # the power of some comes later
    if re.match(r"\| (C|Q)\d", line) and len(cells := line.strip("| ").split(" | ")) > 2
}


def metrics(cell: str, column: int) -> set[str]:
    """What a cell of the claims' table names, or the cell that it refers to."""
    if referred := re.fullmatch("as (C[0-9]+)", cell):
        return metrics(ROWS[referred[1]][column], column)
    return set(re.findall("`([a-z_]+)`", cell)) or {CORRELATION}


@pytest.mark.parametrize("name", CLAIMED.claims)
def test_claims_are_measured_as_the_page_says(name: str) -> None:
    named = metrics(ROWS[name][1], 1) - {CORRELATION}  # C6: of one part
    for how, column in ((ROBUST, 2), (LITERAL, 3)):
        expected = {part.metric for part in CLAIMED.claims[name].parts[how]}
        assert metrics(ROWS[name][column], column) | named == expected


def test_questions_have_the_parts_that_the_page_has() -> None:
    parts = [claim.parts[ROBUST] for claim in ASKED.claims.values()]
    count = [sum(len(part.each(CLAIMS.table1)) for part in own) for own in parts]
    # By its words: five tasks; three; three times five others; four; one and one.
    assert list(ASKED.claims) == [f"Q{number}" for number in range(1, 9)]
    assert count == [5, 3, 5, 5, 5, 4, 1, 1]
    assert {name for names in ROWS for name in names.split(", ")} >= set(CLAIMED.claims)
    assert f"{WORTH_MENTIONING:.0%}".replace("%", " %") in TEXT
    assert f"below {LEVEL}" in TEXT and f"fewer than {FEWEST_SEEDS} seeds" in TEXT


def test_configurations_have_the_runs_that_the_page_has() -> None:
    runs = {}
    for name in ("study", "questions"):
        study = read_study([ROOT / "config.yaml", CONFIRMATION / f"{name}.yaml"])
        for env, variant, seed in study.runs():
            runs.setdefault(name, {}).setdefault((env, variant), []).append(seed)
    assert all(seeds == list(range(100, 120)) for seeds in runs["study"].values())
    assert len(runs["study"]) == 9 and len(runs["questions"]) == 80
    for (env, _), seeds in runs["questions"].items():
        last = 159 if env.startswith(("Barren", "Noisy")) else 119
        assert seeds == list(range(100, last + 1))


@pytest.mark.slow
def test_every_run_is_kept_and_came_after_the_page_and_from_one_state_of_the_code() -> None:
    git, told = ["git", "-C", str(ROOT)], {"capture_output": True, "text": True}
    shallow = subprocess.run([*git, "rev-parse", "--is-shallow-repository"], check=False, **told)
    if shallow.stdout.strip() != "false":
        pytest.skip("not a git repository with its whole history")
    records = {
        tuple(record["config"][key] for key in ("environment", "variant", "seed")): record
        for archive in sorted((ROOT / "reference" / "study").glob("*/*.tar.xz"))
        for name, content in kept_runs.read(archive).items()
        if name.endswith(files.RECORD) and (record := json.loads(content))
    }
    records = {run: record for run, record in records.items() if run[2] in range(100, 200)}
    assert records.keys() == {
        run
        for name in ("study", "questions")
        for run in read_study([ROOT / "config.yaml", CONFIRMATION / f"{name}.yaml"]).runs()
    }
    ((commit, dirty),) = {tuple(record["code"].values()) for record in records.values()}
    assert not dirty and len({record["sources"] for record in records.values()}) == 1
    log = subprocess.run([*git, "log", "-1", "--format=%H", "--", str(PAGE)], check=True, **told)
    subprocess.run([*git, "merge-base", "--is-ancestor", log.stdout.strip(), commit], check=True)


@pytest.mark.slow
def test_the_exact_p_of_the_part_that_hangs_on_chance_is_what_the_study_says() -> None:
    tables = ROOT / "reference" / "tables" / "questions"
    table = pd.read_csv(tables / "metrics.csv").query("env == @BARREN")
    returns = table.pivot(index="seed", columns="variant", values="area_under_curve")

    def exact(variant: str, baseline: str) -> float:
        """By how likely each sum of the differences is if any of their signs may be flipped."""
        differences = np.rint((returns[variant] - returns[baseline]) * 1e5).astype(int)
        chances = np.zeros(2 * differences.abs().sum() + 1)
        chances[len(chances) // 2] = 1  # a sum of 0, of no seed yet
        for one in differences:
            chances = (np.roll(chances, one) + np.roll(chances, -one)) / 2
        return 2 * chances[: len(chances) // 2 - abs(differences.sum()) + 1].sum()

    claims = json.loads((tables / "claims.json").read_text(encoding="utf-8"))["claims"]
    parts = [part for claim in claims for part in claim[ROBUST]["parts"]]
    ours = {i: part for i, part in enumerate(parts) if part["environments"] == [BARREN]}
    p = np.array([part["p_value"] for part in parts])
    p[[*ours]] = [exact(part["variant"], part["baseline"]) for part in ours.values()]
    (hangs,) = (i for i, part in ours.items() if part["variant"] == "beta_0.1")  # over 1: Q2's
    rank = (p < p[hangs]).sum()
    said = (ROOT / "docs" / "study.md").read_text(encoding="utf-8")
    assert f"corrected p of {parts[hangs]['p_holm']:.4f} by" in said
    assert f"Exactly it is {p[hangs] * (len(p) - rank):.4f}" in said
