"""The verdicts on the paper's claims, from tables in which the truth is known."""

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import EPISODES, table_for_claims

from mace_rl.config.study import Study
from mace_rl.results import claims
from mace_rl.results.claims import CLAIMS, CORRELATION, LITERAL, ROBUST

EQUAL = dict.fromkeys(("ppo", "mace_fixed", "mace_full"), 0.0)
SMALL = {"ppo": 0.0, "mace_fixed": 0.05, "mace_full": 0.1}
PLAIN = {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}
FIXED = {"ppo": 0.0, "mace_fixed": 0.3, "mace_full": 0.1}
VAST = {"ppo": 0.0, "mace_fixed": 0.3, "mace_full": 0.6}
BUT_C6 = [claim.name for claim in CLAIMS if claim.name != "C6"]  # which says that fixed is first


def parts_of(frame: pd.DataFrame, study: Study, claim: str, how: str = ROBUST) -> list[dict]:
    (record,) = (one for one in claims.ledger(frame, study.metrics) if one["claim"] == claim)
    return record[how]["parts"]


@pytest.mark.parametrize(
    ("seeds", "advantage", "noise", "which", "expected"),
    [
        (20, PLAIN, 0.02, BUT_C6, "reproduced"),
        (20, PLAIN, 0.02, ["C6"], "contradicted"),
        (20, FIXED, 0.02, ["C6", "C9"], "reproduced"),  # C9 asks nothing of the others
        (20, FIXED, 0.02, ["C1", "C2", "C3", "C4", "C5", "C7", "C8", "C10"], "contradicted"),
        (20, EQUAL, 0.02, [*BUT_C6, "C6"], "contradicted"),  # nothing worth mentioning
        (12, VAST, 1.0, BUT_C6, "inconclusive"),  # what seeds cannot tell apart
        (9, EQUAL, 0.0, [*BUT_C6, "C6"], "inconclusive"),  # too few decide nothing
        (9, PLAIN, 0.02, [*BUT_C6, "C6"], "inconclusive"),
        (1, PLAIN, 0.02, [*BUT_C6, "C6"], "inconclusive"),
    ],
)
def test_verdicts_where_the_truth_is_known(
    study: Study, seeds: int, advantage: dict, noise: float, which: list[str], expected: str
) -> None:
    settings = study.metrics.model_copy(update={"bootstrap_repetitions": 1000})
    records = claims.ledger(table_for_claims(seeds, advantage, noise), settings)
    found = {
        record["claim"]: {record[how]["verdict"] for how in (LITERAL, ROBUST)} for record in records
    }
    assert {name: found[name] for name in which} == {name: {expected} for name in which}


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
        *(("CartPole-v1",), "final_return", "mace_full", "ppo", "return", seeds, difference),
        *(-99.0, high, 0.0001, 0.5, 0.4, 0.6, 1.0, 5.0, np.nan, p_holm),
    )
    assert (finding.worth_mentioning, finding.p_value) == (5, 0.0001)
    assert claims.outcome(finding) == expected


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


def test_all_parts_are_corrected_together_and_have_the_margin_of_what_they_measure(
    study: Study,
) -> None:
    records = claims.ledger(table_for_claims(12, SMALL, noise=0.1), study.metrics)
    for how in (LITERAL, ROBUST):
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
        for environment in EPISODES:
            assert margins[CORRELATION, environment] == 0.05
            reference = study.metrics.reference_return[environment]
            span = reference - study.metrics.random_return_in(environment)
            assert margins["final_return", environment] == pytest.approx(span / 20)
        assert [margins[key] for key in margins if len(key) == 4] == [0.05]  # over all


def test_a_part_is_what_paired_statistics_say(study: Study) -> None:
    frame = table_for_claims(12, SMALL, noise=0.1)
    part = parts_of(frame, study, "C1")[0]
    assert (part["variant"], part["baseline"]) == ("mace_full", "ppo")
    runs = frame[frame["env"] == "Acrobot-v1"].set_index(["variant", "seed"])
    times = runs["sample_efficiency_common"]
    gain = times["ppo"] - times["mace_full"]  # fewer episodes are the improvement
    assert part["difference"] == pytest.approx(gain.mean())
    assert part["worth_mentioning"] == 100
    assert part["in_paper"] == 186 - 249  # of its Table 1: the learned β is the later one
    t = scipy.stats.t(11)
    assert part["detectable"] == pytest.approx((t.ppf(0.975) + t.ppf(0.8)) * gain.sem())
    u = scipy.stats.mannwhitneyu(times["ppo"], times["mace_full"]).statistic
    assert part["probability"] == pytest.approx(u / 144)
    # Verdicts are of 95 % intervals, whatever those of the tables have.
    wide = study.metrics.model_copy(update={"confidence": 0.5})
    assert claims.ledger(frame, wide)[0][ROBUST]["parts"][0] == part


def test_one_seed_has_estimates_but_no_tests(study: Study) -> None:
    frame = table_for_claims(1, PLAIN, noise=0.02)
    part = parts_of(frame, study, "C1")[0]
    runs = frame[frame["env"] == "Acrobot-v1"].set_index("variant")["sample_efficiency_common"]
    assert part["difference"] == runs["ppo"] - runs["mace_full"]
    assert {part[name] for name in ("low", "high", "p_value", "p_holm", "detectable")} == {None}


def test_a_part_without_a_test_counts_where_all_are_corrected(study: Study) -> None:
    frame = table_for_claims(12, PLAIN, noise=0.02)
    one_seed = frame[(frame["env"] != "HopperBulletEnv-v0") | (frame["seed"] == 0)]
    # By 2 of 2¹² sign patterns, as in most others; of 24 only C8's two parts have smaller p values.
    found = [part["p_holm"] for part in parts_of(one_seed, study, "C1")]
    assert found == pytest.approx([22 * 2 / 2**12] * 2)


def test_variants_of_different_budgets_are_compared_within_the_shorter(study: Study) -> None:
    """What neither reaches is no difference, and what a third variant has does not matter."""
    frame = table_for_claims(12, EQUAL, noise=0.0)
    for variant, budget in (("ppo", 4000), ("mace_full", 2000), ("mace_fixed", 500)):
        own = (frame["env"] == "CartPole-v1") & (frame["variant"] == variant)
        frame.loc[own, ["episodes", "sample_efficiency_common"]] = budget  # never reached
    over_ppo, over_fixed = parts_of(frame, study, "C5")
    assert (over_ppo["difference"], over_ppo["probability"]) == (0, 0.5)
    assert (over_ppo["worth_mentioning"], over_fixed["worth_mentioning"]) == (100, 25)
