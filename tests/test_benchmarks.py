"""The benchmark: its arithmetic by hand-made numbers, and that it measures what it says."""

import importlib
import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from benchmarks import aggregate, breakdown, document, growth, settings, speed
from benchmarks.settings import ACROBOT, CARTPOLE, ENVIRONMENTS, FULL, HOPPER, OURS, VARIANTS
from benchmarks.stopwatch import Stopwatch


def result(env, contestant, repeat, target, rate, memory=400.0):
    """A row of results.csv."""
    return {
        "env": env,
        "contestant": contestant,
        "repeat": repeat,
        "target_steps": target,
        "steps": target,
        "seconds": target / rate,
        "cpu_seconds": target / rate,
        "steps_per_second": rate,
        "peak_memory_mb": memory,
        "cpu": "a processor",
        "versions": "python 3.11",
    }


@pytest.fixture
def results():
    """Two repeats of everything; the reference does 1000 and 2000 steps/s, "ppo" ten times that."""
    rows = []
    for repeat, speed_of_machine in enumerate((1.0, 2.0)):
        for env in ENVIRONMENTS:
            for contestant in settings.contestants(env):
                ours = contestant in OURS
                rate = (10_000 if ours else 1000) * speed_of_machine
                rows.append(result(env, contestant, repeat, 100, rate, 300 + repeat))
                if ours:
                    rows.append(result(env, contestant, repeat, 900, 2 * rate, 400 + repeat))
    return pd.DataFrame(rows)


# --- the order of measurements, and the clock -----------------------------------------------------


def test_everything_is_measured_once_in_every_repeat_and_begins_with_another():
    order = list(speed.schedule(5))
    expected = {(r, e, c) for r in range(5) for e in ENVIRONMENTS for c in settings.contestants(e)}
    assert len(order) == len(expected)
    assert set(order) == expected
    assert [repeat for repeat, _, _ in order] == sorted(repeat for repeat, _, _ in order)
    first = [next(c for r, e, c in order if (r, e) == (repeat, HOPPER)) for repeat in range(5)]
    assert len(set(first)) == 5


def test_a_whole_number_of_rollouts_so_that_everybody_does_the_same_steps():
    assert all(steps % 2048 == 0 for steps in FULL.steps.values())
    assert FULL.repeats >= 5


def test_clock_is_read_at_the_first_step_count_past_each_stop():
    progress = iter([3, 10, 11, 40, 50])
    readings = speed.read_clock(progress, [10, 20, 30])
    assert [reading["steps"] for reading in readings] == [10, 40, 40]
    assert [reading["target_steps"] for reading in readings] == [10, 20, 30]
    assert next(progress) == 50, "it stops there"
    for reading in readings:
        assert reading["steps_per_second"] == reading["steps"] / reading["seconds"]


def test_clock_complains_about_a_training_that_ends_too_early():
    with pytest.raises(RuntimeError, match="ended after 5 steps, before 10"):
        speed.read_clock(iter([2, 5]), [10])


# --- tables ---------------------------------------------------------------------------------------


def test_ratios_are_taken_within_a_repeat(results):
    early = aggregate.ratios(results, CARTPOLE, "ppo", "sb3_2048x4", last=False)
    late = aggregate.ratios(results, CARTPOLE, "ppo", "sb3_2048x4", last=True)
    assert early.tolist() == [10, 10]
    assert late.tolist() == [20, 20]


def test_speed_summary_by_hand(results):
    summary = aggregate.speed_summary(results).set_index(["env", "contestant", "target_steps"])
    row = summary.loc[ACROBOT, "mace_full", 900]
    assert (row["slowest"], row["steps_per_second"], row["fastest"]) == (20_000, 30_000, 40_000)
    assert (row["ratio_lowest"], row["ratio"], row["ratio_highest"]) == (20, 20, 20)
    assert (row["repeats"], row["peak_memory_mb"], row["cpu_share"]) == (2, 401, 1)


def run_of(seconds_per_episode):
    steps = 10.0 * np.arange(1, len(seconds_per_episode) + 1)
    return pd.DataFrame(
        {
            "env": "walk",
            "episode": np.arange(1, len(seconds_per_episode) + 1),
            "env_steps": steps,
            "cpu_seconds": np.cumsum(seconds_per_episode),
            "memory_mb": steps,
        }
    )


def test_growth_ratio_compares_the_last_tenth_with_the_second():
    seconds = np.full(40, 1.0)
    assert math.isclose(aggregate.growth_ratio(run_of(seconds)), 1)
    seconds[:4] = 100  # the first tenth does not count
    seconds[-4:] = 3
    assert math.isclose(aggregate.growth_ratio(run_of(seconds)), 3)
    summary = aggregate.growth_summary(run_of(seconds)).iloc[0]
    assert (summary["memory_mb_second_tenth"], summary["memory_mb_end"]) == (80, 400)


JOBS = pd.DataFrame(
    {
        "env": CARTPOLE,
        "variant": "ppo",
        "seed": [0, 1, 2, 3],
        "training_seconds": [5.0, 5.0, 5.0, 5.0],
        "job_began": [103.0, 103.0, 110.0, 110.0],
        "job_ended": [110.0, 110.0, 116.0, 117.0],
        "peak_memory_mb": [350.0, 351.0, 352.0, 349.0],
        "workflow_began": 100.0,
        "workflow_ended": 122.0,
    }
)


def test_overhead_by_hand():
    found = aggregate.overhead(JOBS, cores=2)
    assert found["wall"] == 22
    assert (found["before"], found["after"]) == (3, 5)
    assert found["per_job"] == (2 * 14 - 20) / 4
    assert math.isclose(found["share"], 24 / 44)


def test_makespan_by_hand():
    assert aggregate.makespan([1, 5, 2, 3], cores=2) == 6  # 5 + 1 beside 3 + 2
    assert aggregate.makespan([4, 4, 4], cores=2) == 8
    assert aggregate.makespan([1, 2, 3], cores=1) == 6


def test_paper_budget_by_hand(results, monkeypatch):
    # The median rate of the last readings is 30,000 steps/s.
    monkeypatch.setattr(aggregate, "PAPER_STEPS", {CARTPOLE: 300_000})
    overhead = {"before": 3.0, "after": 5.0, "per_job": 2.0}
    study = aggregate.paper_budget(results, overhead, seeds=2, cores=2)
    assert study["jobs"] == 2 * len(VARIANTS)
    assert study["training"] == 60
    assert study["wall"] == 3 + 3 * 12 + 5
    assert math.isclose(study["share"], 1 - 60 / 88)


def test_report_is_written_from_the_data(results, tmp_path):
    times = [
        {"env": env, "contestant": name, "section": section, "microseconds_per_step": 1.0}
        for env in ENVIRONMENTS
        for name in OURS
        for section in breakdown.SECTIONS
    ]
    scale = replace(FULL, data=tmp_path, pictures=tmp_path, document=tmp_path / "performance.md")
    results.to_csv(tmp_path / "results.csv")
    pd.DataFrame(times).to_csv(tmp_path / "breakdown.csv")
    run_of(np.ones(20)).to_csv(tmp_path / "growth.csv")
    pd.concat(
        [JOBS.assign(env=env, variant=variant) for env in ENVIRONMENTS for variant in VARIANTS]
    ).to_csv(tmp_path / "workflow.csv")
    pd.DataFrame({"runs": [3000], "seconds": [12.3]}).to_csv(tmp_path / "planning.csv")
    importlib.import_module("benchmarks.__main__").draw(scale)
    text = scale.document.read_text(encoding="utf-8")
    assert "| our PPO, default ÷ stable-baselines3, CartPole-v1 | 10× (10 to 10) | 20× " in text
    assert "| peak memory of one training | 352 MB |" in text
    assert "| ppo | 352 | 352 | 352 |" in text
    assert (
        "| our PPO, an update per episode (default) | **15,000** (10,000 to 20,000) 10.0× |" in text
    )
    assert "| … later in training | **30,000** (20,000 to 40,000) 20.0× |" in text
    assert "| everybody | 100 | 100 | 100 |" in text
    assert "| planning (`snakemake -n`) of 3000 runs | 12 s |  | ≤ 60 s | ≤ 20 s |" in text
    assert "nan" not in text
    for picture in ("speed", "breakdown", "growth"):
        assert (tmp_path / f"{picture}.png").stat().st_size > 10_000
        assert f"]({picture}.png)" in text


def test_document_without_a_place_for_a_table_is_an_error():
    with pytest.raises(ValueError, match="0 places for 'speed'"):
        document.filled("no markers here", {"speed": "a table"})
    once = document.filled("a\n<!-- t -->\n<!-- end of t -->\nb\n", {"t": "old"})
    twice = document.filled(once, {"t": r"new \1"})
    assert twice == "a\n<!-- t -->\n\nnew \\1\n\n<!-- end of t -->\nb\n"


# --- what is measured -----------------------------------------------------------------------------


def test_stopwatch_books_nested_time_once(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("benchmarks.stopwatch.time.perf_counter", lambda: now[0])

    def work(seconds, then=lambda: None):
        now[0] += seconds
        then()
        now[0] += seconds

    watch = Stopwatch("rest")
    inner = watch.wrapped("inner", lambda: work(5))
    outer = watch.wrapped("outer", lambda: work(1, inner))
    work(0.25, outer)
    assert watch.stop() == {"rest": 0.5, "outer": 2, "inner": 10}


def test_stopwatch_books_what_raises(monkeypatch):
    watch = Stopwatch("rest")
    with pytest.raises(ZeroDivisionError):
        watch.wrapped("inner", lambda: 1 / 0)()
    assert watch.stop().keys() == {"rest", "inner"}


@pytest.mark.parametrize("environment", [CARTPOLE, HOPPER])
@pytest.mark.parametrize("variant", ["ppo", "mace_full"])
def test_profile_changes_nothing_and_misses_nothing(run_config, monkeypatch, environment, variant):
    from mace_rl.train import Trainer

    def train(watch=None):
        trainer = Trainer(run_config(environment, variant, episodes=4))
        if watch:
            breakdown.instrument(trainer, watch)
        for _ in trainer.run():
            pass
        return trainer.records

    for _, module, name in breakdown.FUNCTIONS:  # put back after the test
        owner = importlib.import_module(f"mace_rl.{module}")
        monkeypatch.setattr(owner, name, getattr(owner, name))
    plain = train()
    watch = Stopwatch("bookkeeping")
    assert train(watch) == plain
    with_bonus = {section for section, *_ in breakdown.METHODS_WITH_BONUS}
    expected = set(breakdown.SECTIONS) - (set() if variant == "mace_full" else with_bonus)
    assert watch.stop().keys() == expected | {"update: critics"}


@pytest.mark.parametrize(
    ("walk", "length"), [("AcrobotLikeWalk-v0", 500), ("HopperLikeWalk-v0", 1000)]
)
def test_walks_have_the_shapes_they_stand_for_and_one_length(register, walk, length):
    from mace_rl.environments import Environment

    growth.register()
    env, model = Environment(walk, seed=0), Environment(growth.WALKS[walk], seed=0)
    assert env.observation_size == model.observation_size
    assert env.action_space == model.action_space
    assert env.max_steps == model.max_steps == length
    for _ in range(2):
        env.env.reset()
        ends = [env.env.step(env.action_space.sample())[2:4] for _ in range(length)]
        assert ends == [(False, False)] * (length - 1) + [(False, True)]


def test_the_peer_is_locked_with_hashes():
    folder = settings.ROOT / "benchmarks"
    requirement = (folder / "requirements.txt").read_text().splitlines()[-1]
    lock = (folder / "environment.lock").read_text()
    assert f"{requirement} \\\n    --hash=sha256:" in lock
    assert "torch" not in lock, "shared with the project"
