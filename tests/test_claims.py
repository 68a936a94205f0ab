"""The verdicts on the paper's claims, from tables in which the truth is known."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import table_for_claims

from mace_rl.config.study import Study
from mace_rl.results import claims
from mace_rl.results.claims import CLAIMS, LITERAL, ROBUST
from mace_rl.results.statistics import paired_comparison, stratified_comparison

ROOT = Path(__file__).parents[1]


def verdicts(frame: pd.DataFrame, study: Study) -> dict[str, tuple[str, str]]:
    settings = study.metrics.model_copy(update={"bootstrap_repetitions": 1000})
    records = claims.ledger(frame, settings)
    return {
        record["claim"]: (record[LITERAL]["verdict"], record[ROBUST]["verdict"])
        for record in records
    }


def test_what_is_plainly_so_is_reproduced(study: Study) -> None:
    frame = table_for_claims(20, {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}, noise=0.02)
    expected = dict.fromkeys((claim.name for claim in CLAIMS), ("reproduced",) * 2)
    assert verdicts(frame, study) == expected | {"C6": ("contradicted",) * 2}


def test_fixed_first_is_what_one_claim_wants(study: Study) -> None:
    frame = table_for_claims(20, {"ppo": 0.0, "mace_fixed": 0.3, "mace_full": 0.1}, noise=0.02)
    found = verdicts(frame, study)
    assert found["C6"] == ("reproduced", "reproduced")
    assert found["C9"] == ("reproduced", "reproduced")  # asks nothing of the others
    assert {found[f"C{n}"][0] for n in (1, 2, 3, 4, 5, 7, 8, 10)} == {"contradicted"}


def test_no_difference_worth_mentioning_contradicts_and_too_few_seeds_decide_nothing(
    study: Study,
) -> None:
    equal = dict.fromkeys(("ppo", "mace_fixed", "mace_full"), 0.0)
    many = verdicts(table_for_claims(20, equal, noise=0.02), study)
    assert set(many.values()) == {("contradicted", "contradicted")}
    plain = {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}
    for few in (table_for_claims(9, equal, noise=0.0), table_for_claims(9, plain, noise=0.02)):
        assert set(verdicts(few, study).values()) == {("inconclusive", "inconclusive")}


def test_a_part_is_what_paired_statistics_say(study: Study) -> None:
    frame = table_for_claims(12, {"ppo": 0.0, "mace_fixed": 0.05, "mace_full": 0.1}, noise=0.1)
    part = claims.ledger(frame, study.metrics)[0][ROBUST]["parts"][0]
    assert (part["variant"], part["baseline"]) == ("mace_full", "ppo")
    runs = frame[frame["env"] == "Acrobot-v1"].set_index(["variant", "seed"])[
        "sample_efficiency_common"
    ]
    gain = runs["ppo"] - runs["mace_full"]  # fewer episodes are the improvement
    assert part["difference"] == pytest.approx(gain.mean())
    assert part["worth_mentioning"] == 100
    assert part["in_paper"] == 186 - 249  # of its Table 1: the learned β is the later one
    error = gain.std() / np.sqrt(12)
    t = scipy.stats.t(11)
    assert part["detectable"] == pytest.approx((t.ppf(0.975) + t.ppf(0.8)) * error)
    wins = np.mean([x < y for x in runs["mace_full"] for y in runs["ppo"]])
    ties = np.mean([x == y for x in runs["mace_full"] for y in runs["ppo"]])
    assert part["probability"] == pytest.approx(wins + ties / 2)
    # 2 parts of C1 to C5 each, 3 of C6, 4 of C7, 2 of C8, 3 of C9, 2 of C10.
    assert part["p_value"] <= part["p_holm"] <= min(1, 24 * part["p_value"])


def test_one_seed_has_estimates_but_no_tests_and_decides_nothing(study: Study) -> None:
    frame = table_for_claims(1, {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}, noise=0.02)
    assert set(verdicts(frame, study).values()) == {("inconclusive", "inconclusive")}
    records = json.loads(claims.as_json(claims.ledger(frame, study.metrics), cost={}))["claims"]
    part = records[0][ROBUST]["parts"][0]
    runs = frame[frame["env"] == "Acrobot-v1"].set_index("variant")["sample_efficiency_common"]
    assert part["difference"] == runs["ppo"] - runs["mace_full"]
    assert {part[name] for name in ("low", "high", "p_value", "p_holm", "detectable")} == {None}
    assert part["outcome"] == "open"
    assert f"| {part['difference']:.0f} (– to –) | – |" in claims.markdown(records, "one seed")


@pytest.mark.slow
def test_the_documented_study_of_one_seed_gets_its_ledger(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "reference" / "runs", tmp_path / "runs")
    command = "-m snakemake --cores 1 --allowed-rules metrics claims"
    command += f" --configfile config/reference.yaml --config results={tmp_path}"
    subprocess.run(
        [sys.executable, *command.split(), "--", f"{tmp_path}/claims.json"],
        check=True,
        capture_output=True,
        cwd=ROOT,
    )
    found = json.loads((tmp_path / "claims.json").read_text())
    assert found["cost"]["runs"] == 9
    assert {claim[ROBUST]["verdict"] for claim in found["claims"]} == {"inconclusive"}


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        (["holds", "holds"], "reproduced"),
        (["holds", "open"], "inconclusive"),
        (["open"], "inconclusive"),
        (["holds", "fails"], "contradicted"),
        (["open", "fails"], "contradicted"),
    ],
)
def test_verdict(outcomes: list[str], expected: str) -> None:
    assert claims.verdict(outcomes) == expected


def test_seeds_have_to_be_the_same(study: Study) -> None:
    frame = table_for_claims(5, dict.fromkeys(("ppo", "mace_fixed", "mace_full"), 0.0), noise=0.1)
    frame = frame[~((frame["variant"] == "ppo") & (frame["seed"] == 3))]
    with pytest.raises(ValueError, match="do not have the same seeds"):
        claims.ledger(frame, study.metrics)


def test_stagnation_correlation() -> None:
    returns = np.concatenate([np.arange(200.0), np.full(200, 200.0), 200 + 2 * np.arange(200.0)])
    rising = np.gradient(np.convolve(returns, np.ones(100) / 100, "full")[: len(returns)])
    assert claims.stagnation_correlation(returns, 0.4 - 0.1 * rising, 50) > 0.9
    assert claims.stagnation_correlation(returns, 0.4 + 0.1 * rising, 50) < -0.9
    assert claims.stagnation_correlation(returns, np.full(len(returns), 0.4), 50) == 0


def test_stratified_comparison() -> None:
    draws = np.random.default_rng(0)
    strata = [draws.normal(1.0, 1, 20), draws.normal(0.2, 3, 12)]
    found = stratified_comparison(strata, 0.95, 10_000, np.random.default_rng(0))
    means = [values.mean() for values in strata]
    assert found.difference == pytest.approx(np.mean(means))
    errors = [values.std() / np.sqrt(len(values)) for values in strata]
    wider = scipy.stats.t.ppf(0.975, 11) * np.sqrt(12 / 11)  # as for the smaller stratum
    half = wider * np.hypot(*errors) / 2
    assert found.low == pytest.approx(found.difference - half, abs=0.1 * half)
    assert found.high == pytest.approx(found.difference + half, abs=0.1 * half)
    signs = [draws.choice([-1, 1], (20_000, len(values))) for values in strata]
    flipped = np.mean([(s * v).mean(axis=1) for s, v in zip(signs, strata, strict=True)], axis=0)
    assert found.p_value == pytest.approx(np.mean(abs(flipped) >= found.difference), abs=0.02)
    one = paired_comparison(strata[0], np.zeros(20), 0.95, 1000, np.random.default_rng(3))
    assert stratified_comparison(strata[:1], 0.95, 1000, np.random.default_rng(3)) == one
