"""The protocol's page against the code that judges, and against the runs that it came before."""

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from invented import LITERAL, ROBUST, ROOT

from mace_rl import files
from mace_rl.config.plugins import code_outside
from mace_rl.study.claims_config import parse_claims, read_claims
from mace_rl.study.compare.verdicts import FEWEST_SEEDS, LEVEL, WORTH_MENTIONING
from mace_rl.study.config import Study, read_study
from mace_rl.study.measure.betas import BEFORE, CORRELATION
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
    records = kept(ROOT / "reference" / "study", range(100, 200))
    assert records.keys() == {
        run
        for name in ("study", "questions")
        for run in read_study([ROOT / "config.yaml", CONFIRMATION / f"{name}.yaml"]).runs()
    }
    come_after(PAGE, records)


# --- the three worlds -----------------------------------------------------------------------------

WORLDS_PAGE = ROOT / "docs" / "worlds-protocol.md"
WORLDS_TEXT = " ".join(WORLDS_PAGE.read_text(encoding="utf-8").split())
WORLDS = {  # what is read over config.yaml
    "tuned": ["worlds/tuned"],
    "plain": ["plain", "worlds/plain"],
    "published": ["published", "worlds/published"],
    "questions": ["questions", "worlds/questions"],
    "controls": ["questions", "controls", "worlds/controls"],
}


def world(name: str) -> Study:
    paths = [ROOT / "config" / f"{path}.yaml" for path in WORLDS[name]]
    return read_study([ROOT / "config.yaml", *paths])


def test_the_worlds_have_the_runs_that_their_page_has() -> None:
    runs = {name: set(world(name).runs()) for name in WORLDS}
    tasks = runs["questions"] | runs["controls"]
    shared = len(runs["questions"] & runs["controls"])
    counts = [*(len(runs[name]) for name in ("tuned", "plain", "published")), len(tasks)]
    said = f"{', '.join(map(str, counts[:-1]))} and {counts[-1]} runs: the last two rows share"
    assert f"{said} {shared}." in WORLDS_TEXT
    for name in WORLDS:
        (row,) = re.findall(
            rf"\| `config/worlds/{name}.yaml` \|(.*?)\| (\d+) to (\d+) \|", WORLDS_TEXT
        )
        seeds = {seed for _, _, seed in runs[name]}
        assert seeds == set(range(int(row[1]), int(row[2]) + 1)) <= set(range(200, 300))
        environments = {env.partition("-")[0] for env, _, _ in runs[name]}
        named = row[0] + (WORLDS_TEXT if "Bullet" in str(environments) else "")
        short = (
            env.removesuffix("Deterministic").removesuffix("BulletEnv") for env in environments
        )
        assert all(env.removesuffix("200") in named for env in short)
    for name, last in (("tuned", 219), ("published", 209)):  # a run takes long
        assert max(seed for env, _, seed in runs[name] if env.startswith("Hopper")) == last
        assert f"| | Hopper | the same | 200 to {last} |" in WORLDS_TEXT


def test_the_worlds_are_asked_what_their_page_has() -> None:
    study = world("tuned")
    claims = read_claims(study, ROOT / study.claims)
    parts = [
        sum(len(part.each(claims.table1)) for part in one.parts[ROBUST])
        for family in claims.families.values()
        for one in family.claims.values()
    ]
    assert parts[:10] == [2, 2, 2, 2, 2, 3, 4, 2, 3, 2] and claims.rule == 2  # C1 to C10
    assert parts[10:21] == [4, 4, 4, 6, 5, 3, 1, 4, 3, 1, 3]  # W1 to W4, Q1, Q6, Q8, P1 to P3
    said = f"the ten claims ({sum(parts[:10])} parts), the four W ({sum(parts[10:14])}), the three"
    assert f"{said} Q ({sum(parts[14:17])}) and the three P ({sum(parts[17:20])})" in WORLDS_TEXT
    families = list(claims.families.values())
    for name, one in CLAIMED.claims.items():  # the confirmation's, but for C9
        for way, parts in one.parts.items():
            now = families[0].claims[name].parts[way]
            metrics = [part.metric.replace(CORRELATION, BEFORE) for part in parts]
            renamed = zip(parts, metrics, strict=True)
            assert now == [part.model_copy(update={"metric": metric}) for part, metric in renamed]
    assert f"`{BEFORE}`" in WORLDS_TEXT


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["tuned", "plain", "published", "tasks"])
def test_what_is_kept_of_a_world_came_after_its_page_and_from_one_state_of_the_code(folder) -> None:
    records = kept(ROOT / "reference" / "worlds" / folder, range(200, 300))
    names = ["questions", "controls"] if folder == "tasks" else [folder]
    assert records.keys() <= {run for name in names for run in world(name).runs()}
    come_after(WORLDS_PAGE, records)


def kept(archives: Path, seeds: range) -> dict[tuple[str, str, int], dict]:
    """run.json of every kept run of these seeds."""
    records = [
        json.loads(content)
        for archive in sorted(archives.glob("*/*.tar.xz"))
        for name, content in kept_runs.read(archive).items()
        if name.endswith(files.RECORD)
    ]
    found = {
        tuple(record["config"][key] for key in ("environment", "variant", "seed")): record
        for record in records
    }
    return {run: record for run, record in found.items() if run[2] in seeds}


def come_after(page: Path, records: dict[tuple[str, str, int], dict]) -> None:
    """All are of one state of the code, which is later than the page's last commit."""
    git, told = ["git", "-C", str(ROOT)], {"capture_output": True, "text": True}
    shallow = subprocess.run([*git, "rev-parse", "--is-shallow-repository"], check=False, **told)
    if shallow.stdout.strip() != "false" or not records:
        pytest.skip("not a git repository with its whole history, or no run is kept yet")
    ((commit, dirty),) = {tuple(record["code"].values()) for record in records.values()}
    # A run's sources are also those of a rule in extras/ that it has.
    states = {(bool(code_outside(one["config"])), one["sources"]) for one in records.values()}
    assert not dirty and len(states) == len({outside for outside, _ in states})
    log = subprocess.run([*git, "log", "-1", "--format=%H", "--", str(page)], check=True, **told)
    subprocess.run([*git, "merge-base", "--is-ancestor", log.stdout.strip(), commit], check=True)


def as_low(steps: np.ndarray) -> float:
    """How likely a sum of whole numbers is as low as this one, if their signs may be flipped."""
    chances = np.zeros(2 * np.abs(steps).sum() + 1)
    middle = len(chances) // 2
    chances[middle] = 1  # a sum of 0, of no seed yet
    for step in steps:
        chances = (np.roll(chances, step) + np.roll(chances, -step)) / 2
    return chances[: middle + steps.sum() + 1].sum()


@pytest.mark.slow
def test_the_exact_p_of_the_part_that_hangs_on_chance_is_what_the_study_says() -> None:
    tables = ROOT / "reference" / "tables" / "questions"
    table = pd.read_csv(tables / "metrics.csv").query("env == @BARREN")
    returns = table.pivot(index="seed", columns="variant", values="area_under_curve")

    claims = json.loads((tables / "claims.json").read_text(encoding="utf-8"))["claims"]
    parts = [part for claim in claims for part in claim[ROBUST]["parts"]]
    ours = {i: part for i, part in enumerate(parts) if part["environments"] == [BARREN]}
    p = np.array([part["p_value"] for part in parts])
    pairs = [(returns[part["variant"]], returns[part["baseline"]]) for part in ours.values()]
    steps = [
        np.rint((variant - baseline) / 1e-5).astype(int).to_numpy() for variant, baseline in pairs
    ]
    p[[*ours]] = [2 * min(as_low(own), as_low(-own)) for own in steps]
    (hangs,) = (i for i, part in ours.items() if part["variant"] == "beta_0.1")  # over 1: Q2's
    rank = (p < p[hangs]).sum()
    said = (ROOT / "docs" / "confirmation.md").read_text(encoding="utf-8")
    assert f"corrected p of {parts[hangs]['p_holm']:.4f} by" in said
    assert f"Exactly it is {p[hangs] * (len(p) - rank):.4f}" in said


def by_all_patterns(part: dict, kind: str, runs: pd.DataFrame, study: Study) -> float:
    """The p of a part of returns, of difference or of equivalence, `kind`, by all sign patterns."""
    differences, together = [], len(part["environments"]) > 1
    for env in part["environments"]:
        own = runs[runs["env"] == env].pivot(index="seed", columns="variant", values=part["metric"])
        bounds = study.metrics.reference_return[env], study.metrics.random_return[env]
        unit = part["worth_mentioning"] * (bounds[0] - bounds[1] if together else 1)
        differences.append((own[part["variant"]] - own[part["baseline"]]).to_numpy() / unit)
    margin = 0 if kind == "p_value" else 1
    sides = []
    for sign in (1, -1):
        shares = [(sign * own - margin) / len(own) for own in differences]  # of a mean of means
        sides.append(as_low(np.rint(np.concatenate(shares) / 1e-6).astype(int)))
    return max(sides) if margin else 2 * min(sides)


@pytest.mark.slow
def test_each_p_that_hangs_on_chance_is_named_by_the_page_and_exact_there() -> None:
    page, named = (ROOT / "docs" / "study.md").read_text(encoding="utf-8"), 0
    for name in ("tuned", "plain", "published", "controls", "questions"):
        tables = ROOT / "reference" / "tables" / {"questions": "exploration"}.get(name, name)
        runs = pd.read_csv(tables / "metrics.csv")
        content = json.loads((tables / "claims.json").read_text(encoding="utf-8"))
        claims = content["claims"]
        parts = [(claim["family"], part) for claim in claims for part in claim[ROBUST]["parts"]]
        for kind, corrected in (("p_value", "p_holm"), ("p_equivalent", "p_equivalent_holm")):
            for family, part in parts:
                if not 0.025 < part[corrected] < 0.12:
                    continue
                rank = sum(own == family and one[kind] >= part[kind] for own, one in parts)
                p = rank * by_all_patterns(part, kind, runs, world(name))
                assert f"{part[corrected]:.3f} ({p:.3f} by all sign patterns)" in page
                named += 1
    assert named == page.count("by all sign patterns")
