"""The kept runs against the protocols that came before them, and what hangs on chance."""

import json
import re
import subprocess
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from invented import ROBUST, ROOT
from pyarrow import parquet

from mace_rl.config.plugins import load
from mace_rl.config.run import RunConfig
from mace_study.config.study import Study, read_study
from tools import specification, tables

# By the commit that runs name: their protocol as it lies there, and where it lies today.
PROTOCOLS = {
    "34f838d": ("docs/worlds-protocol.md", ROOT / "reference" / "worlds" / "protocol.md"),
    "ed57401": ("reference/network/protocol.md", ROOT / "reference" / "network" / "protocol.md"),
    "f396531": ("reference/minigrid/protocol.md", ROOT / "reference" / "minigrid" / "protocol.md"),
    **dict.fromkeys(  # the second: trained again, as reference/worlds/errata.md says
        ("08d9a0b", "d105a38"),
        ("reference/readings/protocol.md", ROOT / "reference" / "readings" / "protocol.md"),
    ),
}
FOLDERS = sorted(set(tables.STUDIES) - set(tables.ELSEWHERE))


def world(name: str) -> Study:
    paths = [ROOT / "config" / f"{path}.yaml" for path in tables.STUDIES[name]]
    return read_study([ROOT / "config.yaml", *paths])


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS)
def test_what_is_kept_came_after_its_protocol_and_from_one_state_of_the_code(folder) -> None:
    """The protocol is today, byte for byte, what it was then; and settings still load."""
    records = kept(ROOT / "reference" / "worlds" / folder)
    names = [name for name in tables.STUDIES if tables.ELSEWHERE.get(name, name) == folder]
    asked = {run for name in names for run in world(name).runs()}
    cells = product(asked, specification.READINGS)
    asked |= {(env, name, seed) for (env, _, seed), name in cells}
    assert {*records} <= asked
    for config in {run[:2]: record["config"] for run, record in records.items()}.values():
        for reference in RunConfig.model_validate(config).references().values():
            if not reference.startswith("HopperBullet"):
                load(reference, "reference")
    git, told = ["git", "-C", str(ROOT)], {"capture_output": True}
    shallow = subprocess.run([*git, "rev-parse", "--is-shallow-repository"], check=False, **told)
    if shallow.stdout.strip() != b"false" or not records:
        pytest.skip("not a git repository with its whole history, or no run is kept yet")
    states: dict[str, set[tuple[tuple, str]]] = {}
    for record in records.values():
        assert not record["code"]["dirty"]
        # A run's sources are also those of the code that it names, such as a rule in extras/.
        named = ("novelty", "estimator"), ("bonus", "estimator"), ("beta", "rule")
        names = tuple(record["config"].get(part, {}).get(key) for part, key in named)
        state = names, record["sources"]
        states.setdefault(record["code"]["commit"], set()).add(state)
    for commit, several in states.items():
        assert len(several) == len({names for names, _ in several})
        then, now = PROTOCOLS[commit[:7]]
        page = subprocess.run([*git, "show", f"{commit}:{then}"], check=True, **told).stdout
        assert page == now.read_bytes()


def kept(folder: Path) -> dict[tuple[str, str, int], dict]:
    """run.json of every kept run."""
    records = [
        json.loads(record)
        for path in sorted(folder.glob("*.parquet"))
        for record in parquet.read_table(path, columns=["record"])["record"].to_pylist()
    ]
    return {
        tuple(record["config"][key] for key in ("environment", "variant", "seed")): record
        for record in records
    }


def as_low(steps: np.ndarray) -> float:
    """How likely a sum of whole numbers is as low as this one, if their signs may be flipped."""
    chances = np.ones(1)  # of a sum of 0, of no seed yet, which is in the middle
    for step in sorted(np.abs(steps)):
        chances = (np.pad(chances, (2 * step, 0)) + np.pad(chances, (0, 2 * step))) / 2
    return chances[: len(chances) // 2 + steps.sum() + 1].sum()


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
        sides.append(as_low(np.rint(np.concatenate(shares) / 1e-5).astype(int)))
    return max(sides) if margin else 2 * min(sides)


@pytest.mark.slow
def test_each_p_that_hangs_on_chance_is_named_by_the_page_and_exact_there() -> None:
    page = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
    told = re.findall(r"(?<=[|,] )0\.\d{3} \(0\.\d{3}\)(?= \||, )", page)
    exact = []
    for name in tables.STUDIES:
        folder = ROOT / "reference" / "tables" / name
        if not (folder / "claims.json").exists():
            continue
        runs = pd.read_csv(folder / "metrics.csv")
        content = json.loads((folder / "claims.json").read_text(encoding="utf-8"))
        families: dict[str, list[dict]] = {}
        for claim in content["claims"]:
            families.setdefault(claim["family"], []).extend(claim[ROBUST]["parts"])
        for kind, corrected in (("p_value", "p_holm"), ("p_equivalent", "p_equivalent_holm")):
            for family in families.values():
                near = [part for part in family if 0.025 < part[corrected] < 0.12]
                p = [
                    by_all_patterns(part, kind, runs, world(name)) if part in near else part[kind]
                    for part in family
                ]
                ranked = sorted(p)
                for part in near:
                    until = ranked[: ranked.index(p[family.index(part)]) + 1]
                    holm = max(one * (len(p) - place) for place, one in enumerate(until))
                    exact.append(f"{part[corrected]:.3f} ({holm:.3f})")
    assert sorted(exact) == sorted(told)
