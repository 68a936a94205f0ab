"""The benchmark: its arithmetic by hand-made numbers, and that it measures what it says."""

import importlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import (
    arithmetic,
    breakdown,
    growth,
    purejaxrl,
    report,
    settings,
    speed,
    start,
    summaries,
    tables,
    update,
    wrapper,
)
from benchmarks.settings import CARTPOLE, ENVIRONMENTS, FULL, HOPPER, OURS, QUICK, VARIANTS


def result(env, contestant, repeat, target, rate):
    """A row of results.csv."""
    row = {"env": env, "contestant": contestant, "repeat": repeat, "target_steps": target}
    times = {"seconds": target / rate, "cpu_seconds": target / rate, "steps_per_second": rate}
    origin = {"peak_memory_mb": 400.0, "cpu": "a processor", "versions": "python 3.11"}
    return row | {"steps": target} | times | origin


@pytest.fixture
def data(tmp_path):
    """A folder of measurements.

    Two repeats, the second twice as fast: the reference does 1000 and 2000 steps/s, ours ten times
    that and later 20 times. Four jobs of 5 s each on two cores, 3 s after the workflow's beginning
    and 5 s before its end. A walk whose last tenth takes three times as long as its second. In CPU
    time PureJaxRL is half as fast as ours; the processor was there for a tenth of the time.
    """
    rows = [
        result(env, contestant, repeat, target, 1000 * (repeat + 1) * factor)
        for repeat in range(2)
        for env in ENVIRONMENTS
        for contestant in settings.contestants(env)
        for target, factor in ([(100, 10), (900, 20)] if contestant in OURS else [(100, 1)])
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "results.csv")
    index = pd.MultiIndex.from_product(
        [ENVIRONMENTS, OURS, breakdown.ALL_SECTIONS], names=["env", "contestant", "section"]
    )
    times = pd.DataFrame({breakdown.TIME: 1.0}, index)
    times.reset_index().to_csv(tmp_path / "breakdown.csv")
    seconds, steps = np.ones(40), 10.0 * np.arange(1, 41)
    seconds[:4], seconds[-4:] = 100, 3  # the first tenth does not count
    walk = {"env": "walk", "env_steps": steps, "cpu_seconds": seconds.cumsum(), "memory_mb": steps}
    pd.DataFrame(walk).to_csv(tmp_path / "growth.csv")
    began, ended = [103.0, 103.0, 110.0, 110.0], [110.0, 110.0, 116.0, 117.0]
    jobs = pd.DataFrame({"training_seconds": 5.0, "job_began": began, "job_ended": ended})
    jobs = jobs.assign(env=CARTPOLE, variant="ppo", peak_memory_mb=350.0)
    jobs = jobs.assign(workflow_began=100.0, workflow_ended=122.0)
    everywhere = [jobs.assign(env=env, variant=name) for env in ENVIRONMENTS for name in VARIANTS]
    pd.concat(everywhere).to_csv(tmp_path / "workflow.csv")
    jobs.to_csv(tmp_path / "jobs.csv")
    pd.DataFrame({"runs": [3000], "seconds": [12.3]}).to_csv(tmp_path / "planning.csv")
    starts = [
        {"what": what, "repeat": repeat, "seconds": 2.0 * cpu, "cpu_seconds": cpu}
        for repeat in range(3)
        for what, cpu in ((start.HAND, 1.0 + repeat), (start.JOB, 2.0 + repeat))
    ]
    pd.DataFrame(starts).to_csv(tmp_path / "start.csv")
    index = pd.MultiIndex.from_product([wrapper.NAMES, wrapper.WHERE], names=["env", "where"])
    costs = [pd.DataFrame({wrapper.TIME: time}, index) for time in (1.0, 3.0)]
    pd.concat(costs).reset_index().to_csv(tmp_path / "wrapper.csv")
    peers = [
        result(env, contestant, repeat, 100, 1000 * (repeat + 1) * factor) | {"seconds": 1.0}
        for repeat in range(2)
        for env in purejaxrl.ENVIRONMENTS
        for contestants, factor in (
            (purejaxrl.OTHERS[:1], 1),
            (purejaxrl.OTHERS[1:], 10),
            (purejaxrl.ROLLOUTS, 5),
        )
        for contestant in contestants
    ]
    pd.DataFrame(peers).to_csv(tmp_path / "purejaxrl.csv")
    prices = [
        {"env": env, "contestant": contestant, "seed": 1000 + repeat, "arithmetic": kind}
        | {"steps_per_cpu_second": 1000.0 * (repeat + 1) * factor}
        | dict.fromkeys(arithmetic.LIBRARIES, kind.upper())
        for repeat in range(2)
        for env in ENVIRONMENTS
        for contestant in arithmetic.CONTESTANTS
        for kind, factor in zip(arithmetic.KINDS, (0.75, 1), strict=True)
    ]
    pd.DataFrame(prices).to_csv(tmp_path / "arithmetic.csv")
    one_update = [
        {"repeat": repeat, "kind": kind, "part": part, "microseconds": factor * (2 + repeat)}
        | {"digest": kind if "native" in kind and "numba" not in kind else "same"}
        for repeat in range(2)
        for kind, factor in zip(update.KINDS, (2.0, 1.0, 1.0, 1.5), strict=True)
        for part in ("forward", update.OWN_PRODUCTS)
    ]
    pd.DataFrame(one_update).to_csv(tmp_path / "update.csv")
    return tmp_path


def test_the_price_of_portable_arithmetic_is_taken_within_a_repeat(data):
    table = tables.arithmetic_table(pd.read_csv(data / "arithmetic.csv"))
    assert "| ppo, CartPole-v1 | 1,125 (750 to 1,500) | 1,500 (1,000 to 2,000) |" in table
    assert table.count("| 0.75 (0.75 to 0.75) | 2 |") == len(ENVIRONMENTS) * 2
    assert "native: blas NATIVE" in table and "torch PORTABLE" in table


def test_the_table_of_an_update_marks_other_bits(data):
    line = tables.update_table(pd.read_csv(data / "update.csv")).splitlines()[2]
    cells = ["forward", "5.0 (4.0 to 6.0)", "2.5 (2.0 to 3.0)*", "2.5 (2.0 to 3.0)*"]
    assert line == f"| {' | '.join([*cells, '3.8 (3.0 to 4.5)', '0.50 (0.50 to 0.50)'])} |"


@pytest.mark.slow
def test_parts_of_an_update_are_measured_with_the_libraries_that_were_chosen(tmp_path, monkeypatch):
    update.measure_all(replace(QUICK, data=tmp_path))
    rows = pd.read_csv(tmp_path / "update.csv").set_index(["kind", "part"])
    assert (rows["microseconds"] > 0).all() and set(rows.index.levels[0]) == set(update.KINDS)
    monkeypatch.setattr(update, "ROUNDS", 1)
    here = {row["part"]: row["digest"] for row in update.measure()}
    assert here == rows.loc["portable", "digest"].to_dict(), "this process is portable"


def test_the_loops_of_an_update_compute_what_the_library_does():
    found = {}
    for name, (compute, results) in update.parts().items():
        compute()
        found[name] = [result.copy() for result in results()]
    for ours, library in zip(found[update.OWN_PRODUCTS], found[update.PRODUCTS], strict=True):
        np.testing.assert_allclose(ours, library, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_arithmetic_is_measured_as_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(speed, "WARM_UP_STEPS", 64)
    for kind in arithmetic.KINDS:
        row = arithmetic.with_arithmetic(kind, "ppo", CARTPOLE, 1000, 64)
        assert row["arithmetic"] == kind and row["steps_per_cpu_second"] > 0
        assert (row["numba"] == "haswell") or kind == "native"
    assert os.environ["NUMBA_CPU_NAME"] == "haswell"


def test_everything_is_measured_once_in_every_repeat_and_begins_with_another():
    everybody = {environment: settings.contestants(environment) for environment in ENVIRONMENTS}
    order = list(speed.schedule(5, everybody))
    expected = {(r, e, c) for r in range(5) for e in ENVIRONMENTS for c in settings.contestants(e)}
    assert (len(order), set(order)) == (len(expected), expected)
    assert [repeat for repeat, _, _ in order] == sorted(repeat for repeat, _, _ in order)
    first = [next(c for r, e, c in order if (r, e) == (repeat, HOPPER)) for repeat in range(5)]
    assert len(set(first)) == 5
    assert all(steps % 2048 == 0 for steps in FULL.steps.values()), "whole rollouts of everybody"


def test_clock_is_read_at_the_first_step_count_past_each_stop():
    progress = iter([3, 10, 11, 40, 50])
    readings = speed.read_clock(progress, [10, 20, 30])
    assert [reading["steps"] for reading in readings] == [10, 40, 40]
    assert [reading["target_steps"] for reading in readings] == [10, 20, 30]
    assert next(progress) == 50, "it stops there"
    with pytest.raises(RuntimeError, match="ended after 5 steps, before 10"):
        speed.read_clock(iter([2, 5]), [10])


def test_paper_budget_by_hand(data, monkeypatch):
    monkeypatch.setattr(summaries, "PAPER_STEPS", {CARTPOLE: 300_000})
    monkeypatch.setattr(summaries, "STUDY_SEEDS", 2)
    results, jobs = pd.read_csv(data / "results.csv"), pd.read_csv(data / "jobs.csv")
    budget = summaries.paper_budget(results, jobs)
    per_job = (2 * 14 - 20) / 4
    assert (budget["before"], budget["after"], budget["per_job"]) == (3, 5, per_job)
    # The median rate of the last readings is 30,000 steps/s: six jobs of 10 s on two cores.
    assert (budget["jobs"], budget["training"]) == (6, 60)
    assert budget["wall"] == 3 + 3 * (10 + per_job) + 5
    assert budget["share"] == pytest.approx(1 - 60 / (2 * budget["wall"]))
    assert summaries.makespan([1, 5, 2, 3], cores=2) == 6  # 5 + 1 beside 3 + 2


def test_report_is_written_from_the_data(data):
    report.measure_all(replace(FULL, data=data, pictures=data, document=data / "performance.md"))
    text = (data / "performance.md").read_text(encoding="utf-8")
    for line in (
        "| our PPO, default ÷ stable-baselines3, CartPole-v1 | 10× (10 to 10) | 20× (20 to 20) |",
        "| our PPO, an update per episode (default) | **15,000** (10,000 to 20,000) 10.0× |",
        "| … later in training | **30,000** (20,000 to 40,000) 20.0× |",
        "| everybody | 100 | 100 | 100 |",
        "| peak memory of one training of 200 episodes | 350 MB |",
        "| ppo | 350 | 350 | 350 |",
        "| walk | 40 | 400 | 1110000.0 | 3.000 | 80 | 400 |",
        "| a job of the workflow, s | 3.00 (2.00 to 4.00) | 6.00 (4.00 to 8.00) |",
        "| job ÷ by hand | 1.50 (1.33 to 2.00) | 1.50 (1.33 to 2.00) |",
        "| planning (`snakemake -n`) of 3000 runs | 12 s |  | ≤ 60 s | ≤ 20 s |",
        f"| CartPole-v1 |{' 2.0 (1.0 to 3.0) |' * 5}",
        f"| PureJaxRL PPO, 1 × 2048 |{' **7,500** (5,000 to 10,000) 5.0× |' * 2}\n\n",
        f"| mace_full, Acrobot-v1 |{' 2.00 (2.00 to 2.00) |' * 3}\n\na processor; ",
    ):
        assert line in text
    assert "nan" not in text
    for picture in ("speed", "breakdown", "growth"):
        assert (data / f"{picture}.png").stat().st_size > 10_000
        assert f"]({picture}.png)" in text
    with pytest.raises(ValueError, match="0 places for 'speed'"):
        report.filled("no markers here", {"speed": "a table"})


def test_a_report_of_what_was_not_measured_is_refused(tmp_path: Path) -> None:
    scale = replace(QUICK, data=tmp_path)
    (tmp_path / "results.csv").touch()
    with pytest.raises(SystemExit, match=r"report: not measured yet: breakdown, growth, .*update "):
        report.measure_all(scale)


def test_stopwatch_books_nested_time_once_and_what_raises(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("benchmarks.breakdown.time.perf_counter", lambda: now[0])

    class Work:
        def outer(self):
            now[0] += 1
            with pytest.raises(ZeroDivisionError):
                self.inner()
            now[0] += 1

        def inner(self):
            now[0] += 10
            raise ZeroDivisionError

    work, watch = Work(), breakdown.Stopwatch("rest")
    watch.wrap("inner", work, "inner")
    watch.wrap("outer", work, "outer")
    now[0] += 0.5
    work.outer()
    assert watch.stop() == {"rest": 0.5, "outer": 2, "inner": 10}


@pytest.mark.slow
@pytest.mark.parametrize("environment", [CARTPOLE, HOPPER])
@pytest.mark.parametrize("variant", ["ppo", "mace_full"])
def test_profile_changes_nothing_and_misses_nothing(run_config, monkeypatch, environment, variant):
    from mace_rl.train import Trainer

    for _, module, name in breakdown.FUNCTIONS:  # put back after the test
        owner = importlib.import_module(module)
        monkeypatch.setattr(owner, name, getattr(owner, name))
    plain, profiled = (Trainer(run_config(environment, variant, episodes=12)) for _ in range(2))
    assert len(list(plain.run())) == 12
    watch = breakdown.Stopwatch("bookkeeping")
    breakdown.instrument(profiled, watch)
    assert len(list(profiled.run())) == 12
    assert profiled.records == plain.records
    expected = breakdown.SECTIONS | (breakdown.BONUS if variant == "mace_full" else {})
    assert watch.stop().keys() == expected.keys()


@pytest.mark.slow
def test_wrapper_plays_the_trainer_s_episodes(monkeypatch):
    played = []
    replay = wrapper.replay
    monkeypatch.setattr(wrapper, "replay", lambda *given: played.append(given[1]) or replay(*given))
    found = wrapper.measure("DeepSea10-v0", 1000, 200)  # `replay` refuses episodes that go on
    assert found.keys() == wrapper.WHERE.keys() and np.isfinite(list(found.values())).all()
    assert {len(actions) for actions in played} == {10}
    assert 0 < found["trainer"] < found["critic"] and found["vector"] > 0


@pytest.mark.parametrize("walk", growth.WALKS)
def test_walks_have_the_shapes_they_stand_for_and_one_length(register, walk):
    from mace_rl.environments.environment import Environment

    growth.register()
    seed = np.random.SeedSequence(0)
    env, model = Environment(walk, seed), Environment(growth.WALKS[walk], seed)
    assert env.observation_size == model.observation_size
    assert (env.action_space, env.max_steps) == (model.action_space, model.max_steps)
    env.env.reset()
    ends = [env.env.step(env.action_space.sample())[2:4] for _ in range(env.max_steps)]
    assert ends == [(False, False)] * (env.max_steps - 1) + [(False, True)]
