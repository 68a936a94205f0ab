"""The kept verdicts, and the table as a draw, once more by code written from the pages alone.

docs/metrics.md ("The rule") and reference/worlds/protocol.md say what is computed here, config/
which parts and settings. What made the tables is not imported: a mistake would be needed twice.
"""

import itertools
import json
from functools import reduce
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy import stats

from tools import kept_runs, tables

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "reference" / "tables"
CLAIMS = yaml.safe_load((ROOT / "config" / "claims.yaml").read_text(encoding="utf-8"))
PAPER = CLAIMS["table1"]["values"]
JUDGED = [name for name in tables.STUDIES if (TABLES / name / "claims.json").exists()]
DRAWN = pd.read_csv(TABLES / "worlds" / "draws.csv").set_index("world")
RULES = {rule: rule.split(" / ") for rule in DRAWN["rule"].unique()}  # of both metrics
PUBLIC_CODE, AS_NAMED = RULES.values()
VARIANTS = ["ppo", "mace_fixed", "mace_full"]
NAMES = ["family", "claim", "way", "environments", "metric", "variant", "baseline"]  # of a part
DRAWS, THEIRS = 20_000, 10_000  # sign patterns and resamples, here and in what is kept
FIRST = {"sample_efficiency": 1, "sample_efficiency_common": 50, "convergence_steps": 100}
HANGS = (0.025, 0.12)  # a corrected p that another drawing can bring to the other side of 0.05


def merged(under: object, over: object) -> object:
    """Settings with others read over them: sections merge, all else is replaced."""
    if not (isinstance(under, dict) and isinstance(over, dict)):
        return over
    return under | {key: merged(under.get(key), value) for key, value in over.items()}


def settings(name: str) -> dict:
    paths = [ROOT / "config.yaml", *(ROOT / f"config/{file}.yaml" for file in tables.STUDIES[name])]
    return reduce(merged, (yaml.safe_load(path.read_text(encoding="utf-8")) for path in paths))


def seeds_of(study: dict, env: str) -> list[int]:
    seeds = study.get("environment_seeds", {}).get(env, study["seeds"])
    ends = (map(int, text.split("-")) for text in (seeds if isinstance(seeds, list) else [seeds]))
    return [seed for first, last in ends for seed in range(first, last + 1)]


def variants_in(study: dict, env: str) -> set[str]:
    if env not in study["environments"]:
        return set()
    return {*study.get("environment_variants", {}).get(env, study["variants"])}


def asked(study: dict) -> list[dict]:
    """The parts of all families for which a study has the runs, each by its `NAMES`."""
    learned, found = study["metrics"].get("learned", "mace_full"), []

    def as_learned(variant: str | None) -> str | None:
        return learned if variant == "mace_full" else variant

    for family, content in CLAIMS["families"].items():
        parts = []
        for (claim, said), way in itertools.product(content["claims"].items(), CLAIMS["ways"]):
            for part in said["parts"].get(way, []):
                envs, own = part["environments"], [part["metric"], part["variant"]]
                each = [envs] if part.get("together") else [[env] for env in envs]
                for where, over in itertools.product(each, part["over"] or [None]):
                    names = [family, claim, way, where, own[0], *map(as_learned, (own[1], over))]
                    parts.append(dict(zip(NAMES, names, strict=True)))
        if all(
            {part["variant"], part["baseline"]} - {None} <= variants_in(study, env)
            for part in parts
            for env in part["environments"]
        ):
            found += parts
    return found


def sign_flip(differences: list[np.ndarray], draws: np.random.Generator) -> list[float]:
    """How likely means of means are as low as these, if each difference can have any sign.

    differences: of each environment [seeds, cases]; a probability for each case.
    """
    exact = len(differences) == 1 and len(differences[0]) <= 13
    means: float | np.ndarray = 0.0
    for own in differences:
        n = len(own)
        drawn = draws.integers(0, 2, (DRAWS, n), np.int8)
        signs = 2.0 * (np.arange(2**n)[:, None] >> np.arange(n) & 1 if exact else drawn) - 1
        means = means + signs @ own / n / len(differences)
    observed = np.mean([own.mean(axis=0) for own in differences], axis=0)
    # Sums of whole numbers are often equal, but for rounding.
    count = np.sum(means <= observed + 1e-9 * np.abs(means).max(axis=0), axis=0)
    return [*(count / len(means) if exact else (count + 1) / (DRAWS + 1))]


def estimated(part: dict, runs: pd.DataFrame, study: dict, draws: np.random.Generator) -> dict:
    """The numbers of a part that claims.json has, by its names for them."""
    metric, together, paper = part["metric"], len(part["environments"]) > 1, np.nan
    of_episodes = metric.startswith(("sample_efficiency", "convergence_steps"))
    differences, margins, rooms, resampled = [], [], [], []
    for env in part["environments"]:
        here = runs[runs["env"] == env]
        values = here.pivot(index="seed", columns="variant", values=metric)
        values = values.loc[seeds_of(study, env)]
        baseline = values[part["baseline"]] if part["baseline"] else 0 * values[part["variant"]]
        difference = (values[part["variant"]] - baseline).to_numpy(float)
        if of_episodes:
            (scale,), window = set(here["episodes"]), study["metrics"]["moving_average"]
            floor = int(0.3 * (scale - window + 1)) + 1  # of the public code's rule
            difference, room = -difference, baseline.mean() - FIRST.get(metric, floor)
            margin = max(0.1 * baseline.mean(), 1 if metric == "sample_efficiency" else window)
        elif metric.startswith("stagnation"):
            scale, margin, room = 1, 0.05, 1 - baseline.mean()
        else:
            reference = study["metrics"]["reference_return"][env]
            scale = reference - study["metrics"]["random_return"][env]
            room = max(reference, values.max(axis=None)) - baseline.mean()
            margin = 0.05 * scale
        unit = scale if together else 1
        differences.append(difference / unit)
        margins.append(margin / unit)
        rooms.append(room / unit)
        chosen = draws.integers(len(difference), size=(DRAWS, len(difference)))
        resampled.append(differences[-1][chosen].mean(axis=1))
    n, margin = min(map(len, differences)), np.mean(margins)
    tail = stats.norm.cdf(np.sqrt(n / (n - 1)) * stats.t.ppf(0.025, n - 1))  # Hesterberg 2015
    low, high = np.quantile(np.mean(resampled, axis=0), [tail, 1 - tail])
    cases = [np.stack([own, -own, own - margin, -own - margin], axis=-1) for own in differences]
    *sides, less, more = sign_flip(cases, draws)
    if of_episodes and not together:
        column, printed = int(metric.startswith("convergence")), PAPER[part["environments"][0]]
        mine, theirs = (
            printed[name if name in printed else "mace_full"][column]  # the learned β's
            for name in (part["variant"], part["baseline"])
        )
        paper = theirs - mine
    reach = stats.t.ppf(0.975, n - 1) * np.std(differences[0], ddof=1) * np.sqrt(1 + 1 / n)
    mean = np.mean([own.mean() for own in differences])
    found = {"seeds": n, "difference": mean, "low": low, "high": high}
    found |= {"p_value": min(1, 2 * min(sides)), "p_equivalent": max(less, more)}
    found |= {"worth_mentioning": margin, "room": np.mean(rooms), "in_paper": paper}
    return found | {"predicted_low": paper - reach, "predicted_high": paper + reach}


def holm(p: pd.Series) -> pd.Series:
    ordered = p.sort_values()
    return (ordered * np.arange(len(p), 0, -1)).cummax().clip(upper=1)[p.index]


def judged(part: pd.Series) -> list[str]:
    """Outcome, size and replication of a part, by its numbers."""
    if part["seeds"] < 10:
        return ["open", "open", ""]
    low, high, margin, paper = part[["low", "high", "worth_mentioning", "in_paper"]]
    within = -margin < low and high < margin
    size = "small" if within else "worth mentioning" if max(low, -high) > margin else "open"
    replication = "" if np.isnan(paper) else "disagrees"
    if low <= paper <= high:
        replication = "agrees"
    elif part["predicted_low"] <= part["difference"] <= part["predicted_high"]:
        replication = "within one seed's chance"
    outcome = "absent" if part["p_equivalent_holm"] < 0.05 and within else "open"
    outcome = "no_room" if part["room"] < margin else outcome
    if part["p_holm"] < 0.05:
        outcome = "shown" if part["difference"] > 0 else "reversed"
    return [outcome, size, replication]


def concluded(parts: pd.DataFrame) -> str:
    """What a claim is, by its parts' outcomes."""
    outcomes = {*parts["outcome"]}
    if outcomes == {"shown"}:
        return "shown"
    if outcomes & {"reversed", "absent"}:
        return "absent" if "shown" in outcomes or "reversed" not in outcomes else "reversed"
    return "open" if "open" in outcomes else "no_room"


@pytest.mark.parametrize("name", JUDGED)
def test_verdicts_are_those_of_the_page(name: str) -> None:
    study, runs = settings(name), pd.read_csv(TABLES / name / "metrics.csv")
    if (TABLES / name / "betas.csv").exists():
        runs = runs.merge(pd.read_csv(TABLES / name / "betas.csv"), on=["env", "variant", "seed"])
    claims = json.loads((TABLES / name / "claims.json").read_text(encoding="utf-8"))["claims"]
    said = [(claim, way) for claim in claims for way in CLAIMS["ways"] if way in claim]
    theirs = [
        {"family": claim["family"], "claim": claim["claim"], "way": way} | part
        for claim, way in said
        for part in claim[way]["parts"]
    ]
    assert [{key: part[key] for key in NAMES} for part in theirs] == asked(study)

    draws = np.random.default_rng(0)
    ours = pd.DataFrame([estimated(part, runs, study, draws) for part in asked(study)])
    theirs = pd.DataFrame(theirs).astype(dict.fromkeys(ours, float))
    drawn, ends = ["p_value", "p_equivalent"], ["low", "high"]
    exact = ours.columns.drop(drawn + ends)
    np.testing.assert_allclose(theirs[exact], ours[exact], rtol=1e-9, atol=1e-12)
    width = ours["high"] - ours["low"]
    assert (theirs[ends] - ours[ends]).abs().div(width, axis=0).max(axis=None) < 0.06
    assert ((theirs["high"] - theirs["low"]) / width).mean() == pytest.approx(1, abs=0.015)
    for key in drawn:
        deviation = np.sqrt(2 * np.maximum(ours[key], theirs[key]) / THEIRS)
        assert ((ours[key] - theirs[key]).abs() < 5 * deviation).all()
        corrected = f"{key.removesuffix('_value')}_holm"
        family = [theirs["family"], theirs["way"]]
        again = theirs[key].groupby(family).transform(holm)
        np.testing.assert_allclose(theirs[corrected], again, rtol=1e-9)
        ours[corrected] = ours[key].groupby(family).transform(holm)

    for i, part in theirs.iterrows():
        assert judged(part) == [*part[["outcome", "size", "replication"]]]
        # What another drawing can turn: the outcome by a p, all by an end of an interval.
        hangs = int(part[["p_holm", "p_equivalent_holm"]].between(*HANGS).any())
        bounds = [part["worth_mentioning"], -part["worth_mentioning"], part["in_paper"]]
        gap = np.nanmin([abs(part[end] - bound) for end in ends for bound in bounds])
        assert judged(ours.loc[i])[hangs:] == judged(part)[hangs:] or gap < 0.02 * width[i]
    for claim, way in said:
        parts = theirs[(theirs["claim"] == claim["claim"]) & (theirs["way"] == way)]
        outcome, words = concluded(parts), CLAIMS["families"][claim["family"]]["words"]
        assert [claim[way]["outcome"], claim[way]["verdict"]] == [outcome, words[outcome]]


def by_public_code(episodes: pd.DataFrame, random_return: float, own: dict) -> list[int]:
    """`PUBLIC_CODE` of a run and, last, `AS_NAMED`'s; all episodes where it never gets there."""
    returns = episodes["extrinsic_return"].to_numpy(float)
    count, window = len(returns), own["moving_average"]
    end = returns[-round(own["final_fraction"] * count) :]
    learned = end.mean() > random_return + 2 * end.std(ddof=1) / np.sqrt(len(end))
    reached = np.flatnonzero(returns >= own["threshold"] * end.mean()) + 1
    sums = np.cumsum([0, *returns])
    means = (sums[window:] - sums[:-window]) / window
    flat = np.flatnonzero(np.abs(means[window:] - means[:-window]) / window < 0.05) + 1
    late = flat[flat > 0.3 * (count - window + 1)]
    bar = own["threshold"] * returns[-10:].mean()
    by_code = next((t + 1 for t in range(count) if returns[t] >= bar), count)
    return [by_code, [*late, count][0], [*reached, count][0] if learned else count]


def measured(name: str, study: dict, env: str, variant: str) -> np.ndarray:
    """`by_public_code` of all runs of a variant; metrics.csv has the same."""
    if variant == "mace_full":
        variant = study["metrics"].get("learned", variant)
    folder = ROOT / tables.KEPT / tables.ELSEWHERE.get(name, name)
    runs = kept_runs.read(folder / f"{env}.parquet", [variant])
    given = study["metrics"]["random_return"][env], study["metrics"]
    episodes = [runs[variant, seed].episodes for seed in seeds_of(study, env)]
    own = np.array([by_public_code(each, *given) for each in episodes])
    kept = pd.read_csv(TABLES / name / "metrics.csv").set_index(["env", "variant"])
    names = [*PUBLIC_CODE, AS_NAMED[0]]
    np.testing.assert_array_equal(kept.loc[(env, variant), names], own)
    return own


@pytest.mark.slow
def test_runs_that_have_not_learned_never_reach_the_threshold() -> None:
    study = settings("tasks")  # in this task a strong bonus keeps most runs from learning
    for variant in study["variants"]:
        measured("tasks", study, "NoisyDeepSea7-v0", variant)


def places(values: np.ndarray, among: np.ndarray, left_out: int = 0) -> np.ndarray:
    """Mid-ranks among seeds, over their number + 1; `left_out`: each of `values` is one of them."""
    less, equal = (op(among, values[:, None]).sum(axis=1) for op in (np.less, np.equal))
    return (less + (equal - left_out + 1) / 2) / (len(among) - left_out + 1)


def unusual(place: np.ndarray) -> np.ndarray:
    return (place <= 0.05) | (place >= 0.95)


def first(values: list[np.ndarray]) -> list[np.ndarray]:
    """How likely each variant is alone the lowest in 0, 1, 2 columns, of all combinations."""
    shares = []
    for i, own in enumerate(values):
        before, behind = (own[:, None] < other for other in values[:i] + values[i + 1 :])
        columns = (before[:, :, None] & behind[:, None]).sum(axis=-1)
        shares.append(np.bincount(columns.ravel(), minlength=3) / columns.size)
    return shares


@pytest.mark.slow
@pytest.mark.parametrize("world", DRAWN.index.unique())
def test_the_table_as_a_draw_is_that_of_the_page(world: str) -> None:
    study = settings(world)
    runs = {
        (env, variant): measured(world, study, env, variant)
        for env in study["environments"]
        for variant in VARIANTS
    }
    for rule in RULES:
        drawn_by_rule(world, rule, study, runs)


def drawn_by_rule(world: str, rule: str, study: dict, runs: dict) -> None:
    columns = [[*PUBLIC_CODE, AS_NAMED[0]].index(metric) for metric in RULES[rule]]
    rows, columns_first = [], 0
    many = {key: np.ones(1) for key in ("unusual", "first", "any")}  # chances of 0, 1, 2 …
    for env in study["environments"]:
        values, printed = [], [np.array([PAPER[env][variant]]) for variant in VARIANTS]
        for variant, paper in zip(VARIANTS, printed, strict=True):
            own = runs[env, variant][:, columns]
            middle = np.quantile(own, [0.05, 0.5, 0.95], axis=0).T
            for i, place in enumerate(places(paper, own)[0]):
                number = [env, variant, RULES[rule][i], paper[0, i], len(own)]
                rows.append([*number, *middle[i], place, unusual(place)])
            odd = unusual(places(own, own, left_out=1)).sum(axis=1)
            many["unusual"] = np.convolve(many["unusual"], np.bincount(odd, minlength=3) / len(own))
            values.append(own)
        shares, columns_first = first(values), columns_first + first(printed)[-1].argmax()
        many["first"] = np.convolve(many["first"], shares[-1])
        many["any"] = np.convolve(many["any"], np.mean(shares, axis=0))
    numbers = pd.read_csv(TABLES / "worlds" / "numbers.csv").query(
        "world == @world and rule == @rule"
    )
    numbers = numbers.drop(columns=["world", "rule"]).reset_index(drop=True)
    ours = pd.DataFrame(rows, columns=numbers.columns)
    pd.testing.assert_frame_equal(ours, numbers, check_dtype=False, rtol=1e-9, atol=0)

    least = {key: share[::-1].cumsum()[::-1] for key, share in many.items()}  # of at least 0, 1 …
    count = int(ours["unusual"].sum())
    drawn = {"unusual": count, "numbers": len(ours), "chance_unusual": least["unusual"][count]}
    drawn |= {"limit": np.argmax(least["unusual"] < 0.05), "first": columns_first}
    drawn |= {f"chance_{key}": least[key][columns_first] for key in ("first", "any")}
    kept = DRAWN[DRAWN["rule"] == rule].loc[world].drop("rule")
    assert kept["favoured"] == VARIANTS[-1]
    assert kept.drop("favoured").to_dict() == pytest.approx(drawn, rel=1e-9)
