"""The paper's Table 1 as one draw from a study, and the pictures of several: by enumeration."""

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from invented import CLAIMS, ENVIRONMENTS, PAPERS, QUICK, ROBUST, VARIANTS, table_for_claims
from matplotlib.figure import Figure
from shared import illegible, refusal

from mace_study.compare import single_seeds as d
from mace_study.compare.ledger import Judgement, to_json
from mace_study.compare.verdicts import ledger, verdict
from mace_study.show import worlds as pictures
from mace_study.show.curves import save_figure
from tools import worlds

TABLE1 = CLAIMS.table1
METRICS = TABLE1.public_code
CELLS = list(itertools.product(ENVIRONMENTS[:2], VARIANTS))


@pytest.fixture
def runs() -> pd.DataFrame:
    """Two environments with few values, so that many are equal; the first has one seed more."""
    draws = np.random.default_rng(0)
    rows = []
    for env, variant in CELLS:
        for seed in range(10 + (env == ENVIRONMENTS[0])):
            values = TABLE1.values[env][variant] + draws.integers(-2, 3, 2)
            rows.append((env, variant, seed, *values))
    return pd.DataFrame(rows, columns=["env", "variant", "seed", *METRICS])


def unusual(value: float, seeds: np.ndarray) -> bool:
    rank = scipy.stats.rankdata([value, *seeds])[0]  # 1 to n + 1, of equal ones the middle
    return not 0.05 < round((rank - 0.5) / (len(seeds) + 1), 9) < 0.95


def values(runs: pd.DataFrame, env: str, variant: str) -> np.ndarray:
    own = runs[(runs["env"] == env) & (runs["variant"] == variant)]
    return own[METRICS].to_numpy()


def test_a_number_is_unusual_if_nearly_all_seeds_are_on_one_side(runs: pd.DataFrame) -> None:
    runs.loc[(runs["env"] == "CartPole-v1") & (runs["variant"] == "ppo"), METRICS[0]] += 10
    table = d.numbers(runs, TABLE1)
    assert list(zip(table["env"], table["variant"], strict=True))[::2] == CELLS
    for row in table.to_dict("records"):
        column = METRICS.index(row["metric"])
        seeds = values(runs, row["env"], row["variant"])[:, column]
        paper = TABLE1.values[row["env"]][row["variant"]][column]
        assert (row["paper"], row["seeds"]) == (paper, len(seeds))
        assert row["unusual"] == unusual(paper, seeds)
        assert [row["low"], row["high"]] == list(np.percentile(seeds, [5, 95]))
    assert table["unusual"].sum() == 1


def test_how_often_a_draw_has_as_many_unusual_numbers(runs: pd.DataFrame) -> None:
    """Of 200,000 draws, each seed of which is looked at among the others."""
    runs.loc[runs["seed"] == 3, METRICS] += 5  # one seed is unusual throughout
    counts, draws = np.zeros(200_000, int), np.random.default_rng(1)
    for env, variant in CELLS:
        own = values(runs, env, variant)
        each = [
            sum(unusual(own[seed, k], np.delete(own[:, k], seed)) for k in range(2))
            for seed in range(len(own))
        ]
        counts += draws.choice(each, len(counts))
    found = d.draw(runs, TABLE1)
    assert found.numbers == 12
    assert found.chance_unusual == pytest.approx((counts >= found.unusual).mean(), abs=0.004)
    assert (counts >= found.limit).mean() < 0.05 < (counts >= found.limit - 1).mean()


def test_how_often_a_draw_is_as_favourable(runs: pd.DataFrame) -> None:
    """Over all combinations of seeds; in Acrobot and CartPole "full" is first in two columns."""
    shares = {}
    for env in ENVIRONMENTS[:2]:
        drawn = itertools.product(*(values(runs, env, variant) for variant in VARIANTS))
        table = np.array(list(drawn))  # [combinations, variants, columns]
        alone = (table == table.min(axis=1, keepdims=True)).sum(axis=1) == 1
        first = (table.argmin(axis=1)[:, None] == np.arange(3)[:, None]) & alone[:, None]
        counts = first.sum(axis=2)  # [combinations, variants]
        shares[env] = np.array([(counts == k).mean(axis=0) for k in range(3)])
    found = d.draw(runs, TABLE1)
    assert (found.favoured, found.first) == ("mace_full", 2)
    one = d.draw(runs[runs["env"] == "Acrobot-v1"], TABLE1)  # where PPO is first in as many
    assert (one.favoured, one.first, one.numbers) == ("mace_full", 1, 6)
    for expected, own in ((found.chance_first, -1), (found.chance_any, slice(None))):
        one, other = (np.atleast_2d(shares[env].T[own]).mean(axis=0) for env in ENVIRONMENTS[:2])
        both = one[2] + one[1] * (other[1] + other[2]) + one[0] * other[2]
        assert expected == pytest.approx(both)


@pytest.mark.parametrize(
    ("outcomes", "place"),
    [
        ("shown shown", 0),  # the smaller p
        ("no_room shown", 0),
        ("shown open", 1),
        ("shown reversed", 1),
        ("shown absent", 1),
        ("absent reversed", 1),
        ("shown absent reversed", 2),
    ],
)
def test_the_number_of_a_cell_is_of_a_part_that_decides(outcomes, place) -> None:
    (answer, *_) = ledger(table_for_claims(12, dict.fromkeys(VARIANTS, 0.0), 0.02), QUICK, PAPERS)
    some = itertools.cycle(answer.ways[ROBUST].parts)
    given = zip(some, outcomes.split(), (0.01, 0.03, 0.02), strict=False)
    parts = [replace(part, outcome=one, p_holm=p, difference=p) for part, one, p in given]
    judged = Judgement(verdict(outcomes.split()), "", parts)
    table = pictures.verdicts({"tuned": [replace(answer, ways={ROBUST: judged})]})
    assert list(table["difference"]) == [parts[place].difference]


@pytest.mark.slow
def test_worlds_are_brought_together(tmp_path, monkeypatch) -> None:
    """Three worlds: nothing differs, the learned β is better by far, and the first once more."""
    settings = QUICK.model_copy(update={"bootstrap_repetitions": 4000})
    advantages = {"tuned": 0.0, "plain": 0.2, "published": 0.0}
    ledgers = {}
    for world, better in advantages.items():
        advantage = {"ppo": 0.0, "mace_fixed": 0.0, "mace_full": better}
        table = table_for_claims(12, advantage, noise=0.02)
        ledgers[world] = ledger(table, settings, PAPERS)
        folder = tmp_path / world
        folder.mkdir()
        same = {"sample_efficiency_public_code": table["sample_efficiency"]}  # both are drawn
        table.assign(**same).to_csv(folder / "metrics.csv")
        (folder / "claims.json").write_text(to_json({}, ledgers[world]), encoding="utf-8")
        columns = {"episode": [1, 2000], "mean": [0.0, 1.0], "lower": 0.0, "upper": 1.0, "n": 12}
        cells = itertools.product(ENVIRONMENTS, VARIANTS)
        curves = [pd.DataFrame({"env": env, "variant": name, **columns}) for env, name in cells]
        pd.concat(curves).to_csv(folder / "figure1.csv", index=False)
    figures: list[Figure] = []

    def save(figure: Figure, path: Path) -> None:
        figures.append(figure)
        save_figure(figure, path)

    monkeypatch.setattr(worlds, "save_figure", save)
    assert set(worlds.make(tmp_path)) == {path.name for path in (tmp_path / "worlds").iterdir()}
    found = pd.read_csv(tmp_path / "worlds/verdicts.csv").query("measured == @ROBUST")
    found = found.set_index(["world", "claim"])["verdict"]
    for world, answers in ledgers.items():
        assert found[world].to_dict() == {one.claim: one.ways[ROBUST].verdict for one in answers}
    assert found["plain", "C1"] == "reproduced"
    (tmp_path / "tuned/claims.json").unlink()  # as while Hopper's runs are not all there
    shutil.rmtree(tmp_path / "plain")
    for name in ("metrics", "figure1"):  # nor even CartPole's
        own = pd.read_csv(tmp_path / f"published/{name}.csv")
        own[own["env"] == "Acrobot-v1"].to_csv(tmp_path / f"published/{name}.csv")
    worlds.make(tmp_path)
    assert len(figures) == 6
    assert [illegible(figure) for figure in figures] == [[]] * 6
    assert set(pd.read_csv(tmp_path / "worlds/verdicts.csv")["world"]) == {"published"}
    draws = pd.read_csv(tmp_path / "worlds/draws.csv")[["world", "numbers", "first"]]
    assert draws.to_numpy().tolist() == [["tuned", 18, 4], ["published", 6, 1]] * 2  # by both rules
    whole = pd.read_csv(tmp_path / "published/metrics.csv")
    whole[:-1].to_csv(tmp_path / "published/metrics.csv", index=False)
    said = refusal(monkeypatch, str(tmp_path), tool=worlds)
    assert "published/metrics.csv: the runs of Acrobot-v1 are not complete: " in said
