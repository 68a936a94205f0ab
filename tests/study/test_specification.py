"""The paper's claims asked of every reading: families, cut claims, and whether β moves."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from invented import (
    CLAIMS,
    QUESTIONED,
    QUICK,
    ROBUST,
    ROOT,
    STUDY,
    table_for_claims,
    table_for_questions,
)

from mace_rl.beta.meta import MetaAdaptation
from mace_rl.runs import run
from mace_rl.runs.finished import FinishedRun
from mace_study.compare.specification import STILL, asked_beta, family_of, in_tasks, specification
from tools.kept_runs import Kept
from tools.specification import end_of_beta

ADVANTAGE = {"ppo": 0.0, "mace_fixed": 0.05, "mace_full": 0.3, "mace_words": -0.2}
WHOLE = ["C1", "C2", "C5", "C6", "C10"]  # all parts are in Acrobot and CartPole
CUT = ["C7", "C8", "C9"]  # some are
TASKS = ("DeepSea10-v0", "FrozenLake8x8Deterministic-v0", "NoisyDeepSea6-v0")
TASKS += ("NoisyDeepSea7-v0", "LateDeepSea7-v0")  # of P1


@pytest.mark.parametrize("variant", ["mace_full", "mace_score", "mace_progress", "mace_words"])
def test_what_the_network_asks_for_is_found_again_from_the_records(
    run_config, tmp_path, monkeypatch, variant
):
    """Expected: the network's own outputs, noted while it trains."""
    outputs, set_beta = [], MetaAdaptation.next_beta

    def noted(controller):
        beta = set_beta(controller)
        outputs.append(controller.asked[1] if controller.asked else 0.0)
        return beta

    monkeypatch.setattr(MetaAdaptation, "next_beta", noted)
    config = run_config("CartPole-v1", variant, 3, episodes=130)
    run.run(config, tmp_path)
    expected = [1 / (1 + math.exp(-(math.log(0.4 / 0.6) + output))) for output in outputs]
    assert np.ptp(expected) > 1e-3
    found = FinishedRun(tmp_path)
    bound = np.isclose(found.episodes["beta"], 1 / (1 + np.exp([[-6], [6]])), rtol=1e-3).any(0)
    difference = abs(asked_beta(found.episodes["beta"].to_numpy(), found.config) - expected)
    assert difference[~bound].max() < 1e-4 and (~bound).sum() > 60
    assert difference.max() < 0.02  # of a logit that was cut off at ±6, with a perturbation of 2


def test_claims_are_whole_or_cut_to_the_environments_that_are_there():
    environments = {"Acrobot-v1", "CartPole-v1"}
    whole, cut = (
        next(iter(family_of(CLAIMS, environments, one).families.values())) for one in (True, False)
    )
    assert [*whole.claims] == WHOLE and [*cut.claims] == CUT
    for claim in cut.claims.values():
        for parts in claim.parts.values():
            assert {env for part in parts for env in part.environments} <= environments
    everything = {*STUDY.environments}
    assert len(next(iter(family_of(CLAIMS, everything, True).families.values())).claims) == 10
    assert not family_of(CLAIMS, everything, False).families


def test_each_reading_is_judged_by_its_own_runs_and_corrected_by_itself():
    table = table_for_claims(20, ADVANTAGE, 0.02)
    table = table[table["env"] != "HopperBulletEnv-v0"]
    words = table["variant"] == "mace_words"
    columns = [name for name in table if name.startswith("stagnation")]
    table.loc[words, columns] = np.random.default_rng(0).normal(0, 0.02, (words.sum(), 2))

    def asked(**deviations: float) -> pd.DataFrame:
        path = ROOT / STUDY.claims
        found = specification(table, QUICK, path, deviations, ROBUST)
        return found.set_index(["reading", "claim"])["verdict"]

    both = asked(mace_full=0.2, mace_words=0.2)
    for alone in (asked(mace_full=0.2), asked(mace_words=0.2)):
        pd.testing.assert_series_equal(alone, both.loc[[alone.index[0][0]]])
    assert both["mace_full", "C1"] == both["mace_full", "C9"] == "reproduced"
    assert both["mace_words", "C1"] == both["mace_words", "C10"] == "not reproduced"
    still = asked(mace_full=0.2, mace_words=0.04)
    assert still["mace_words", "C9"] == STILL
    assert (still.drop([("mace_words", "C9")]) == both.drop([("mace_words", "C9")])).all()


def test_a_claim_of_ours_is_asked_of_each_reading_alone():
    """P1 has four parts over five tasks: p is corrected for these, by hand for the smallest."""
    table = table_for_questions(12, mace_full=2.0, beta_1=5.0)
    other = table[table["variant"] == "mace_full"].assign(variant="mace_words")
    other["area_under_curve"] -= 4.0
    both = pd.concat([table, other])
    path = ROOT / STUDY.claims
    found = in_tasks(both, QUESTIONED, path, ["mace_full", "mace_words"], "P1", ROBUST)
    assert found["over"].tolist() == ["ppo", "beta_0.1", "beta_0.4", "beta_1"] * 2
    verdicts = found.groupby("reading")["verdict"].unique().map(list).to_dict()
    assert verdicts == {"mace_full": ["no"], "mace_words": ["no"]}
    own = found[found["reading"] == "mace_full"].set_index("over")
    assert own["outcome"].tolist() == ["shown"] * 3 + ["reversed"]
    five = [name for name in both["env"].unique() if name in TASKS]
    shares = []
    for env in five:
        wide = both[both["env"] == env].pivot(
            index="seed", columns="variant", values="area_under_curve"
        )
        scale = QUESTIONED.reference_return[env] - QUESTIONED.random_return[env]
        shares.append((wide["mace_full"] - wide["ppo"]).mean() / scale)
    assert own.loc["ppo", "difference"] == pytest.approx(np.mean(shares))
    alone = in_tasks(both, QUESTIONED, path, ["mace_words"], "P1", ROBUST)
    pd.testing.assert_frame_equal(alone, found.iloc[4:].reset_index(drop=True))


def test_the_end_of_a_run_is_its_last_tenth(run_config):
    """Of a β that nothing perturbs: as it is recorded."""
    config = run_config("CartPole-v1", "mace_words", 3, episodes=30)
    record = json.dumps({"config": config.settings()})
    betas = pd.DataFrame({"beta": np.repeat([0.9, 0.2, 0.5], [26, 2, 2])})
    assert end_of_beta(Kept(record, betas)) == pytest.approx((0.2 + 0.5 + 0.5) / 3)
    assert end_of_beta(Kept(record, betas), 1, 2) == pytest.approx(0.5)  # of every other episode
