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
from invented import EPISODES, table_for_claims

from mace_rl.config.study import Study
from mace_rl.results import claims, claims_text
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


@pytest.mark.parametrize(
    ("seeds", "p_holm", "difference", "high", "expected"),
    [
        (10, 0.049, 3.0, 9.0, "holds"),
        (10, 0.049, 3.0, 4.9, "holds"),  # beyond chance, though not worth mentioning
        (10, 0.049, -3.0, 9.0, "fails"),
        (10, 0.05, 3.0, 4.9, "fails"),
        (10, 0.05, -3.0, 4.9, "fails"),
        (10, 0.05, 3.0, 5.0, "open"),
        (10, 0.05, -3.0, 5.0, "open"),
        (9, 0.001, 3.0, 9.0, "open"),
        (9, 0.001, -3.0, 4.9, "open"),
    ],
)
def test_a_part_comes_out_by_the_written_rule(
    seeds: int, p_holm: float, difference: float, high: float, expected: str
) -> None:
    """The margin is 5, and the p value that is not corrected says nothing."""
    finding = claims.Finding(
        environments=("CartPole-v1",),
        metric="final_return",
        variant="mace_full",
        baseline="ppo",
        unit="return",
        seeds=seeds,
        difference=difference,
        low=-99.0,
        high=high,
        p_value=0.0001,
        probability=0.5,
        probability_low=0.4,
        probability_high=0.6,
        detectable=1.0,
        worth_mentioning=5.0,
        in_paper=np.nan,
        p_holm=p_holm,
    )
    assert claims.outcome(finding) == expected


def test_what_seeds_cannot_tell_apart_is_inconclusive(study: Study) -> None:
    better = {"ppo": 0.0, "mace_fixed": 0.3, "mace_full": 0.6}
    found = verdicts(table_for_claims(12, better, noise=1.0), study)
    del found["C6"]  # which says that the fixed β is first
    assert set(found.values()) == {("inconclusive", "inconclusive")}


def test_all_parts_are_corrected_together_and_have_the_margin_of_what_they_measure(
    study: Study,
) -> None:
    frame = table_for_claims(12, {"ppo": 0.0, "mace_fixed": 0.05, "mace_full": 0.1}, noise=0.1)
    for how in (LITERAL, ROBUST):
        records = claims.ledger(frame, study.metrics)
        parts = [part for record in records for part in record[how]["parts"]]
        # 2 parts of C1 to C5 each, 3 of C6, 4 of C7, 2 of C8, 3 of C9, 2 of C10.
        count = len(parts)
        assert count == 24
        p = sorted(part["p_value"] for part in parts)
        holm = [max(min(1, p[i] * (count - i)) for i in range(k + 1)) for k in range(count)]
        expected = dict(zip(p, holm, strict=True))
        for part in parts:
            assert part["p_holm"] == pytest.approx(expected[part["p_value"]])
        assert len({round(part["p_holm"], 9) for part in parts}) > 5  # they are not all 1
        margins = {
            (part["metric"], *part["environments"]): part["worth_mentioning"] for part in parts
        }
        metrics = study.metrics
        for environment in EPISODES:
            assert margins["stagnation_correlation", environment] == 0.05
            span = metrics.reference_return[environment] - metrics.random_return_in(environment)
            assert margins["final_return", environment] == pytest.approx(span / 20)
        (over_all,) = {margins[key] for key in margins if len(key) == 4}
        assert over_all == 0.05


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


def test_one_seed_has_estimates_but_no_tests_and_decides_nothing(study: Study) -> None:
    frame = table_for_claims(1, {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}, noise=0.02)
    assert set(verdicts(frame, study).values()) == {("inconclusive", "inconclusive")}
    text = claims_text.as_json(claims.ledger(frame, study.metrics), cost={})
    records = json.loads(text)["claims"]
    part = records[0][ROBUST]["parts"][0]
    runs = frame[frame["env"] == "Acrobot-v1"].set_index("variant")["sample_efficiency_common"]
    assert part["difference"] == runs["ppo"] - runs["mace_full"]
    assert {part[name] for name in ("low", "high", "p_value", "p_holm", "detectable")} == {None}
    assert part["outcome"] == "open"
    assert f"| {part['difference']:.0f} (– to –) | – |" in claims_text.markdown(records, "one seed")


@pytest.mark.slow
def test_the_documented_study_of_one_seed_gets_its_ledger(study: Study, tmp_path: Path) -> None:
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
    seconds = [json.loads(path.read_text())["seconds"] for path in tmp_path.rglob("run.json")]
    assert found["cost"]["runs"] == len(seconds) == 9
    assert found["cost"]["core_hours"] == pytest.approx(sum(seconds) / 3600)
    assert {claim[ROBUST]["verdict"] for claim in found["claims"]} == {"inconclusive"}
    (parts,) = (claim[ROBUST]["parts"] for claim in found["claims"] if claim["claim"] == "C9")
    assert len(parts) == 3
    window = study.metrics.moving_average
    for part in parts:
        (run,) = (tmp_path / "runs" / part["environments"][0] / "mace_full").glob("seed*")
        records = pd.read_csv(run / "episodes.csv")
        average = records["extrinsic_return"].rolling(window).mean()
        rise = average.diff(window) / window
        expected = (-rise).corr(records["beta"].shift(-1), method="spearman")
        assert part["difference"] == pytest.approx(expected)


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


def test_variants_of_different_budgets_are_compared_within_the_shorter(study: Study) -> None:
    """What neither reaches is no difference, and what a third variant has does not matter."""
    equal = dict.fromkeys(("ppo", "mace_fixed", "mace_full"), 0.0)
    frame = table_for_claims(12, equal, noise=0.0)
    cartpole = frame["env"] == "CartPole-v1"
    for variant, budget in (("ppo", 4000), ("mace_full", 2000), ("mace_fixed", 500)):
        own = cartpole & (frame["variant"] == variant)
        frame.loc[own, ["episodes", "sample_efficiency_common"]] = budget  # never reached
    records = claims.ledger(frame, study.metrics)
    found = {record["claim"]: record[ROBUST]["parts"] for record in records}
    over_ppo, over_fixed = found["C5"]
    assert (over_ppo["difference"], over_ppo["probability"]) == (0, 0.5)
    assert (over_ppo["worth_mentioning"], over_fixed["worth_mentioning"]) == (100, 25)


def test_the_verdicts_are_of_95_percent_intervals_whatever_tables_have(study: Study) -> None:
    frame = table_for_claims(12, {"ppo": 0.0, "mace_fixed": 0.05, "mace_full": 0.1}, noise=0.1)
    wide = study.metrics.model_copy(update={"confidence": 0.5})
    assert claims.ledger(frame, wide) == claims.ledger(frame, study.metrics)


def test_a_part_without_a_test_counts_where_all_are_corrected(study: Study) -> None:
    frame = table_for_claims(12, {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}, noise=0.02)
    one_seed = frame[(frame["env"] != "HopperBulletEnv-v0") | (frame["seed"] == 0)]
    parts = claims.ledger(one_seed, study.metrics)[0][ROBUST]["parts"]
    # By 2 of 2¹² sign patterns, as in most others; of 24 only C8's two parts have smaller p values.
    assert [part["p_holm"] for part in parts] == pytest.approx([22 * 2 / 2**12] * 2)


def test_seeds_have_to_be_the_same(study: Study) -> None:
    frame = table_for_claims(5, dict.fromkeys(("ppo", "mace_fixed", "mace_full"), 0.0), noise=0.1)
    frame = frame[~((frame["variant"] == "ppo") & (frame["seed"] == 3))]
    with pytest.raises(ValueError, match="do not have the same seeds"):
        claims.ledger(frame, study.metrics)


def test_stagnation_goes_with_the_beta_of_the_next_episode() -> None:
    """A β that is made of it is correlated perfectly, and an episode away from it less."""
    returns = np.random.default_rng(0).normal(size=300)
    window = 5
    average = pd.Series(returns).rolling(window).mean()
    rise = (average - average.shift(window)).to_numpy()  # from episode 2 · window on
    stagnation = np.full(300, 7.0)
    stagnation[2 * window :] = -rise[2 * window - 1 : -1]  # of the episode before
    found = [
        claims.stagnation_correlation(returns, np.roll(0.4 + 0.1 * stagnation, shift), window)
        for shift in (0, -1, 1)
    ]
    assert found[0] == pytest.approx(1)
    assert max(found[1:]) < 0.9
    assert claims.stagnation_correlation(returns, 0.4 - 0.1 * stagnation, window) == pytest.approx(
        -1
    )
    assert claims.stagnation_correlation(returns, np.full(300, 0.4), window) == 0


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


def test_strata_of_few_seeds_have_students_interval_with_the_freedom_of_the_smallest() -> None:
    draws = np.random.default_rng(0)
    strata = [draws.normal(1.0, 1, 5), draws.normal(0.2, 3, 12), draws.normal(0, 2, 12)]
    found = stratified_comparison(strata, 0.95, 1000, np.random.default_rng(0))
    error = np.sqrt(sum(scipy.stats.sem(values) ** 2 for values in strata)) / 3
    centre = np.mean([values.mean() for values in strata])
    expected = scipy.stats.t.interval(0.95, 4, centre, error)
    assert (found.low, found.high) == pytest.approx(expected)
