"""What the report's page shows of a study's tables: numbers, marks, costs, sentences."""

import pandas as pd

from mace_rl.report.page import _costs, _table1, _too_few, duration, number, short
from mace_rl.results.claims import ROBUST


def test_the_lowest_mean_is_marked_but_never_that_of_seeds_that_all_failed() -> None:
    means = {"a": (10.4, 0), "b": (10.0, 1), "c": (11.6, 0), "d": (10.0, 3)}
    shared = {"env": "A-v0", "metric": "sample_efficiency", "seeds": 3, "paper": pd.NA}
    rows = [
        {"variant": name, "mean": mean, "censored": censored} | shared
        for name, (mean, censored) in means.items()
    ]
    (block,) = _table1(pd.DataFrame(rows))
    assert {name: cells[0]["best"] for name, cells in block["rows"].items()} == {
        "a": True,
        "b": True,
        "c": False,
        "d": False,
    }


def test_costs_are_of_all_runs_of_a_variant() -> None:
    records = [
        {
            "config": {"environment": "A-v0", "variant": variant, "seed": seed},
            "seconds": 10.0**seed * (1 + (variant == "full")),
            "peak_memory_mb": 300 + seed,
        }
        for variant in ("ppo", "full")
        for seed in range(3)
    ]
    runs = [record["config"] for record in records]
    metrics = pd.DataFrame(runs).rename(columns={"environment": "env"}).assign(env_steps=7)
    plain, full = _costs(records, metrics[::-1])
    assert plain == {
        "env": "A-v0",
        "variant": "ppo",
        "runs": 3,
        "steps": 21,
        "median": 10,
        "longest": 100,
        "seconds": 111,
        "memory": 302,
    }
    assert (full["variant"], full["seconds"]) == ("full", 222)


def test_numbers_as_they_are_printed() -> None:
    assert [
        number(-0.4),
        number(-1.25, 1),
        number(1234567),
        number(float("nan")),
        number(None),
    ] == [
        "0",
        "−1.2",
        "1\u202f234\u202f567",
        "–",
        "–",
    ]
    assert [duration(0.04), duration(90), duration(7200)] == ["0.0 s", "1.5 min", "2.0 h"]
    assert list(map(short, (0.9921, -83.0, 1841.9, 0.0))) == [
        "0.992",
        "−83.0",
        "1\u202f842",
        "0",
    ]


def test_too_few_seeds_are_said_of_environments_that_claims_are_about() -> None:
    def part(environments: list[str], seeds: int) -> dict[str, object]:
        return {"environments": environments, "seeds": seeds}

    claims = [
        {ROBUST: {"parts": [part(["A-v0"], 10), part(["B-v0"], 9)]}},
        {ROBUST: {"parts": [part(["B-v0", "C-v0"], 3)]}},
    ]
    assert _too_few({"claims": claims}, ["C-v0", "D-v0", "A-v0", "B-v0"]) == ["C-v0", "B-v0"]
    assert _too_few(None, ["A-v0"]) == []
