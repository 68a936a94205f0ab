"""Verdicts, from tables in which the truth is known."""

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import (
    CLAIMS,
    EPISODES,
    LITERAL,
    PAPERS,
    QUESTIONED,
    QUESTIONS,
    QUICK,
    ROBUST,
    ROOT,
    STUDY,
    VARIANTS,
    table_for_claims,
    table_for_questions,
)
from shared import refused

from mace_rl.base.tables import RecordError
from mace_rl.config.section import ConfigError
from mace_study.compare import verdicts
from mace_study.compare.claims_config import parts_of, read_claims
from mace_study.compare.ledger import Finding, read_ledger, to_json
from mace_study.compare.verdicts import ledger
from mace_study.measure.betas import BEFORE
from mace_study.show.sections import of_ledger

EQUAL = dict.fromkeys(("ppo", "mace_fixed", "mace_full"), 0.0)
SMALL = {"ppo": 0.0, "mace_fixed": 0.05, "mace_full": 0.1}
PLAIN = {"ppo": 0.0, "mace_fixed": 0.1, "mace_full": 0.3}
FIXED = {"ppo": 0.0, "mace_fixed": 0.3, "mace_full": 0.1}
WORST = {"ppo": 0.2, "mace_fixed": 0.2, "mace_full": -0.1}
SLIGHT = {"ppo": 0.0, "mace_fixed": 0.01, "mace_full": 0.03}
BUT_C6 = [f"C{number}" for number in range(1, 11) if number != 6]  # which says that fixed is first
OF_FULL = [name for name in BUT_C6 if name != "C9"]  # C9 asks nothing of the others

# Of a `Finding`: what it is of, and what is between its interval and its corrected p values.
FOUND = ("CartPole-v1",), "final_return", "mace_full", "ppo", "return"
FIT = 0.0001, 0.5, 0.4, 0.6, 1.0, 5.0, np.nan, 0.0001


def found_of(frame: pd.DataFrame, claim: str) -> list[Finding]:
    answers = verdicts.ledger(frame, STUDY.metrics, PAPERS)
    (answer,) = (one for one in answers if one.claim == claim)
    return answer.ways[ROBUST].parts


TOO_FEW = "cannot tell (too few seeds)"


@pytest.mark.parametrize(
    ("seeds", "advantage", "noise", "which", "expected"),
    [
        (20, PLAIN, 0.02, BUT_C6, "reproduced"),
        (20, PLAIN, 0.02, ["C6"], "not reproduced"),  # it is before PPO, not before the learned
        (20, FIXED, 0.02, ["C6", "C9"], "reproduced"),
        (20, FIXED, 0.02, OF_FULL, "not reproduced"),
        (20, SLIGHT, 0.005, BUT_C6, "reproduced"),  # small and certain
        (20, WORST, 0.02, BUT_C6, "not reproduced"),
        (20, EQUAL, 0.02, [*BUT_C6, "C6"], "not reproduced"),  # nothing worth mentioning
        (12, SMALL, 0.3, BUT_C6, TOO_FEW),  # what seeds cannot tell apart
        (9, PLAIN, 0.02, [*BUT_C6, "C6"], TOO_FEW),  # too few decide nothing
        (1, PLAIN, 0.02, [*BUT_C6, "C6"], TOO_FEW),
    ],
)
def test_verdicts_where_the_truth_is_known(seeds, advantage, noise, which, expected) -> None:
    answers = verdicts.ledger(table_for_claims(seeds, advantage, noise), QUICK, PAPERS)
    found = {one.claim: {judged.verdict for judged in one.ways.values()} for one in answers}
    assert {name: found[name] for name in which} == {name: {expected} for name in which}


def test_every_combination_of_parts_has_the_verdict_of_the_protocol() -> None:
    outcomes = "shown", "reversed", "absent", "open", "no_room"
    for found in itertools.product(outcomes, repeat=3):
        kinds = set(found)
        if "reversed" in kinds:
            expected = "absent" if "shown" in kinds else "reversed"
        elif "absent" in kinds:
            expected = "absent"
        else:
            undecided = "open" if "open" in kinds else "no_room"
            expected = "shown" if kinds == {"shown"} else undecided
        assert verdicts.verdict(found) == expected


@pytest.fixture(scope="module")
def small() -> SimpleNamespace:
    """A table of small differences, its runs in order, and each claim's judgements."""
    frame = table_for_claims(12, SMALL, noise=0.1)
    ways = {one.claim: one.ways for one in verdicts.ledger(frame, QUICK, PAPERS)}
    runs = frame.set_index(["env", "variant", "seed"]).sort_index()
    return SimpleNamespace(frame=frame, runs=runs, ways=ways)


def test_all_parts_are_corrected_together_and_have_their_margins(small) -> None:
    for how in (LITERAL, ROBUST):
        parts = [part for ways in small.ways.values() for part in ways[how].parts]
        # 2 parts of C1 to C5 each, 3 of C6, 4 of C7, 2 of C8, 3 of C9, 2 of C10.
        count = len(parts)
        assert count == 24
        for given, corrected in (("p_value", "p_holm"), ("p_equivalent", "p_equivalent_holm")):
            p = sorted(getattr(part, given) for part in parts)
            holm = [max(min(1, p[i] * (count - i)) for i in range(k + 1)) for k in range(count)]
            expected = dict(zip(p, holm, strict=True))
            for part in parts:
                assert getattr(part, corrected) == pytest.approx(expected[getattr(part, given)])
        assert len({round(part.p_holm, 9) for part in parts}) > 5  # they are not all 1
        margins = {(part.metric, *part.environments): part.worth_mentioning for part in parts}
        for environment in EPISODES:
            assert margins[BEFORE, environment] == 0.05
            span = QUICK.reference_return[environment] - QUICK.random_return_in(environment)
            assert margins["final_return", environment] == pytest.approx(span / 20)
        if how == ROBUST:
            assert [margins[key] for key in margins if len(key) == 4] == pytest.approx([0.05])


def test_a_reading_is_of_the_metric_with_the_longest_name_that_it_begins_with() -> None:
    rows = {"Own-v0": {key: [100, 900] for key in PAPERS.table1.variants}}
    own = {"metrics": ["convergence_steps", "convergence_steps_own"], "values": rows}
    table1 = PAPERS.table1.model_copy(update=own)
    for reading, expected in (("convergence_steps_own_2", {900}), ("convergence_steps_o", {100})):
        assert {*table1.values_of(["Own-v0"], reading).values()} == expected
    assert table1.values_of(["Own-v0"], "convergence") == {}


def test_a_seed_that_one_variant_lacks_is_an_error() -> None:
    frame = table_for_claims(12, PLAIN, noise=0.02)
    own = (frame["env"] == "CartPole-v1") & (frame["variant"] == "ppo") & (frame["seed"] == 5)
    with pytest.raises(RecordError, match=r"CartPole-v1, ppo, seed 5: there is no"):
        verdicts.ledger(frame[~own], STUDY.metrics, PAPERS)


def test_a_part_without_a_test_counts_where_all_are_corrected() -> None:
    frame = table_for_claims(12, PLAIN, noise=0.02)
    one_seed = frame[(frame["env"] != "HopperBulletEnv-v0") | (frame["seed"] == 0)]
    # By 2 of 2¹² sign patterns, as in most others; of 24 only C8's two parts have smaller p values.
    found = [part.p_holm for part in found_of(one_seed, "C1")]
    assert found == pytest.approx([22 * 2 / 2**12] * 2)


def test_variants_of_different_budgets_are_compared_within_the_shorter() -> None:
    """What neither reaches is no difference, and what a third variant has does not matter."""
    frame = table_for_claims(12, EQUAL, noise=0.0)
    for variant, budget in (("ppo", 4000), ("mace_full", 2000), ("mace_fixed", 500)):
        own = (frame["env"] == "CartPole-v1") & (frame["variant"] == variant)
        frame.loc[own, ["episodes", "sample_efficiency_common"]] = budget  # never reached
    over_ppo, over_fixed = found_of(frame, "C5")
    assert (over_ppo.difference, over_ppo.probability) == (0, 0.5)
    assert (over_ppo.worth_mentioning, over_fixed.worth_mentioning) == (200, 50)


def test_a_mean_over_environments_weighs_each_alike_whatever_its_scale_and_seeds() -> None:
    """Q7: three tasks, of which one has more seeds."""
    frame = table_for_questions(30, mace_full=0.3)
    frame = frame[(frame["env"] == "BarrenRegion-v0") | (frame["seed"] < 12)]
    found = verdicts.ledger(frame, QUESTIONED, QUESTIONS)
    (part,) = next(one for one in found if one.claim == "Q7").ways[ROBUST].parts
    areas = frame.set_index(["env", "variant", "seed"])["area_under_curve"].sort_index()
    expected = [
        (areas[env, "mace_full"] - areas[env, "mace_no_memory"]).mean()
        / (QUESTIONED.reference_return[env] - QUESTIONED.random_return[env])
        for env in ("BarrenRegion-v0", "NoisyMountainCar-v0", "NoisyDeepSea10-v0")
    ]
    assert part.difference == pytest.approx(np.mean(expected))
    assert (part.worth_mentioning, part.seeds) == (pytest.approx(0.05), 12)
    assert all(list(answer.ways) == [ROBUST] for answer in found)


def test_the_ledger_is_read_as_it_was_written(tmp_path: Path) -> None:
    answers = verdicts.ledger(table_for_claims(1, PLAIN, 0.1), STUDY.metrics, PAPERS)  # with NaN
    path = tmp_path / "claims.json"
    path.write_text(to_json({"runs": 9}, answers), encoding="utf-8")
    assert repr(read_ledger(path)) == repr(answers)
    whole = path.read_text(encoding="utf-8")
    for damaged in ("", "[]", whole[:-100], whole.replace('"parts"', '"part"')):
        path.write_text(damaged, encoding="utf-8")
        with pytest.raises(RecordError, match=r"claims\.json: not as the workflow writes it"):
            read_ledger(path)


@pytest.mark.parametrize(
    ("interval", "p_holm", "p_equivalent_holm", "expected", "changes"),
    [
        ((1, 4), 0.049, 0.001, ("shown", "small"), {}),  # not outranked by an absence
        ((6, 9), 0.049, 0.9, ("shown", "worth mentioning"), {}),
        ((3, 8), 0.049, 0.9, ("shown", "open"), {}),
        ((-9, -6), 0.049, 0.9, ("reversed", "worth mentioning"), {}),
        ((-3, 4), 0.05, 0.049, ("absent", "small"), {}),
        ((-3, 4), 0.05, 0.05, ("open", "small"), {}),
        ((-3, 5), 0.9, 0.001, ("open", "open"), {}),  # the interval reaches the margin
        ((-3, 4), 0.9, 0.001, ("absent", "small"), {"room": 5.0}),
        ((-3, 4), 0.9, 0.001, ("no_room", "small"), {"room": 4.99}),
        ((1, 4), 0.049, 0.001, ("shown", "small"), {"room": 4.0}),
        ((6, 9), 0.001, 0.001, ("open", "open"), {"seeds": 9, "room": 1.0}),
    ],
)
def test_a_part_has_direction_and_size(interval, p_holm, p_equivalent_holm, expected, changes):
    """The margin is 5, and p values that are not corrected say nothing."""
    given = 10, np.mean(interval), *interval, *FIT, p_holm, p_equivalent_holm
    finding = Finding(*FOUND, *given, room=99.0)
    found = verdicts.decided(replace(finding, **changes))
    assert (found.outcome, found.size, found.replication) == (*expected, "")


def test_what_could_not_improve_could_not_be_asked() -> None:
    """Acrobot's PPO needs 60 episodes of a possible 50, and ends where the best run does."""
    frame = table_for_claims(12, EQUAL, noise=0.02)
    draws, acrobot = np.random.default_rng(5), frame["env"] == "Acrobot-v1"
    frame.loc[acrobot, "sample_efficiency_common"] = draws.integers(58, 63, acrobot.sum())
    frame.loc[acrobot, "final_return"] = draws.normal(-86, 1, acrobot.sum())
    answers = verdicts.ledger(frame, QUICK, PAPERS)
    judged = {one.claim: one.ways[ROBUST] for one in answers}
    assert judged["C1"].outcome == "no_room"
    assert judged["C1"].verdict == "cannot tell (nothing to gain)"
    assert [part.outcome for part in judged["C7"].parts] == ["no_room"] * 2 + ["absent"] * 2
    assert judged["C7"].verdict == "not reproduced"  # for Hopper's sake
    frame.loc[~acrobot, "final_return"] = draws.normal(900, 900, (~acrobot).sum())
    judged = {one.claim: one for one in verdicts.ledger(frame, QUICK, PAPERS)}
    assert judged["C7"].ways[ROBUST].verdict == "cannot tell (too few seeds)"


def test_a_part_is_what_paired_statistics_say_with_margin_room_and_replication(small) -> None:
    runs, answers = small.runs, small.ways
    efficiency = runs.loc["Acrobot-v1", "sample_efficiency_common"]
    (part, _), mean = answers["C1"][ROBUST].parts, efficiency["ppo"].mean()
    assert (part.variant, part.baseline) == ("mace_full", "ppo")
    assert (part.worth_mentioning, part.room) == pytest.approx((mean / 10, mean - 50))
    gain = efficiency["ppo"] - efficiency["mace_full"]  # fewer episodes are the improvement
    assert part.difference == pytest.approx(gain.mean())
    assert part.in_paper == 186 - 249  # of its Table 1: the learned β is the later one
    t = scipy.stats.t(11)
    assert part.detectable == pytest.approx((t.ppf(0.975) + t.ppf(0.8)) * gain.sem())
    u = scipy.stats.mannwhitneyu(efficiency["ppo"], efficiency["mace_full"]).statistic
    assert part.probability == pytest.approx(u / 144)
    # Verdicts are of 95 % intervals, whatever those of the tables have.
    wide = QUICK.model_copy(update={"confidence": 0.5})
    assert verdicts.ledger(small.frame, wide, PAPERS)[0].ways[ROBUST].parts[0] == part
    chance = scipy.stats.t.interval(0.95, 11, -63, gain.std() * (13 / 12) ** 0.5)
    assert (part.predicted_low, part.predicted_high) == pytest.approx(chance)
    assert part.low > -63 and chance[0] < part.difference < chance[1]
    assert part.replication == "within one seed's chance"
    for changed, said in (("in_paper", "agrees"), ("predicted_low", "disagrees")):
        one = replace(part, **{changed: part.difference + (changed != "in_paper")})
        assert verdicts.decided(one).replication == said
    best = max(-85.0, runs.loc["Acrobot-v1", "final_return"].max())
    part = answers["C7"][ROBUST].parts[0]
    assert part.room == pytest.approx(best - runs.loc[("Acrobot-v1", "ppo"), "final_return"].mean())
    assert (part.worth_mentioning, part.replication) == (pytest.approx(414.1 / 20), "")
    part, needed = answers["C8"][LITERAL].parts[0], runs["sample_efficiency"]  # episodes, together
    shares = [needed[env, "ppo"].mean() / budget for env, budget in EPISODES.items()]
    assert part.worth_mentioning == pytest.approx(np.mean(shares) / 10)
    assert part.room == pytest.approx(np.mean(shares) - np.mean([1 / e for e in EPISODES.values()]))
    assert answers["C9"][ROBUST].parts[0].room == 1


@pytest.mark.parametrize(
    ("how", "metric", "window"),
    [(LITERAL, "convergence_steps_public_code", 50), (ROBUST, "convergence_steps", 400)],
)
def test_a_rule_with_its_own_window_has_the_margin_of_that(small, how, metric, window) -> None:
    wide = QUICK.model_copy(update={"moving_average": 400})
    answers = {one.claim: one.ways for one in verdicts.ledger(small.frame, wide, PAPERS)}
    mean = small.runs.loc["Acrobot-v1", "ppo"][metric].mean()
    part = answers["C2"][how].parts[0]
    assert (part.metric, part.worth_mentioning) == (metric, max(mean / 10, window))


# The file of what a paper says.

SEVENTH = " " * 12 + "- {<<: *full, environments: [Acrobot-v1, HopperBulletEnv-v0], "
SEVENTH += "metric: final_return}\n"
MISTAKES = [  # one text for another, and what is said of it
    ("metric: final_return", "metric: final_retrun", ["C6.parts", "'final_retrun'", "'final_re"]),
    ("- &full {", "- &full {tugether: true, ", ["tugether", "C1.parts", "'together'"]),
    ("over: [ppo, mace_fixed]", "over: [mace_full]", ["C1.parts", "the variant itself"]),
    ("robust: *above", "rubust: *above", ["C7.parts", "'rubust'", "'robust'"]),
    ("          robust: *above\n", "", ["C7.parts", "'robust'] as the first"]),
    ("  robust: decides,", "  claim: x\n  robust: decides,", ["ways has 'claim'", "claims.json"]),
    ("    C2:", "    Q1:", ["elsewhere.claims.Q1", "twice"]),
    ("mace_full: [249, 586]", "mace_full: [249]", ["Acrobot-v1.mace_full is [249]", "2 numbers"]),
    (
        "public_code: [sample_efficiency_public_code, ",
        "public_code: [",
        ["table1.public_code", "in this order"],
    ),
    ("  discount:", "  discuont:", ["table2", "'discuont'", "'discount'"]),
    ("GAE Parameter (λ)", "漢", ["table2.others is '漢'", "LaTeX"]),
    ("shown: reproduced, ", "", ["the paper's claims.words.shown", "missing"]),
    ("over: [ppo, mace_fixed]", "over: [ppo, ppo]", ["C1.parts", "'ppo' should be there once"]),
    (SEVENTH, f"{SEVENTH}{SEVENTH}", ["C7.parts.by the paper's words and code has a part twice"]),
]


@pytest.mark.parametrize(("old", "new", "said"), MISTAKES)
def test_a_mistake_in_the_file_of_claims_is_named(tmp_path: Path, old, new, said) -> None:
    text = (ROOT / STUDY.claims).read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "claims.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with refused(ConfigError, f"^{path}") as caught:
        read_claims(STUDY, path)
    assert [words for words in said if words not in str(caught.value)] == []


def test_what_a_study_lacks_for_a_family() -> None:
    for title, family in CLAIMS.families.items():
        parts = [part for _, part in parts_of(family)]
        names = {name for part in parts for name in (*part.environments, part.variant, *part.over)}
        whole = {env: [*names] for env in {env for part in parts for env in part.environments}}
        assert CLAIMS.lacking(whole, QUESTIONED)[title] == []
        for name in names:
            left = [*names - {name}]
            without = {env: left for env in whole if env != name}
            assert CLAIMS.lacking(without, QUESTIONED)[title] == [name]
        one = parts[0]  # whose variant one environment lacks
        less = whole | {one.environments[0]: [*names - {one.variant}]}
        assert CLAIMS.lacking(less, QUESTIONED)[title] == [one.variant]
        bare = QUESTIONED.model_copy(update={"reference_return": {}})
        (first, *_) = CLAIMS.lacking(whole, bare)[title]
        assert first.startswith(("sample_efficiency_common", "metrics.reference_return."))


@pytest.mark.parametrize(
    ("seeds", "in_hopper", "said"),
    [
        (9, 9, "No claim can have a verdict: that takes 10 seeds, and there are 9."),
        (10, 5, "Parts with fewer than 10 seeds stay open."),
        (10, 10, "The rule: docs/metrics.md."),  # alone
    ],
)
def test_too_few_seeds_are_named_where_claims_are_judged(seeds, in_hopper, said):
    table = table_for_claims(seeds, dict.fromkeys(VARIANTS, 0.0), 0.1)
    table = table[(table["env"] != "HopperBulletEnv-v0") | (table["seed"] < in_hopper)]
    notes = [one.note for one in of_ledger(ledger(table, QUICK, PAPERS), PAPERS) if one.level == 2]
    assert notes and all(note.endswith(said) for note in notes)
