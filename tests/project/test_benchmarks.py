"""benchmarks/: where time goes, the page, the guard, PureJaxRL."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from shared import ROOT

from benchmarks import breakdown, guard, page, purejaxrl
from benchmarks.measuring import CARTPOLE, FILE, HOPPER


@pytest.mark.slow
@pytest.mark.parametrize("environment", [CARTPOLE, HOPPER])
@pytest.mark.parametrize("variant", ["ppo", "mace_full"])
def test_profile_changes_nothing_and_misses_nothing(run_config, monkeypatch, environment, variant):
    from mace_rl.training.trainer import Trainer

    for _, module, name in breakdown.FUNCTIONS:  # put back after the test
        owner = importlib.import_module(module)
        monkeypatch.setattr(owner, name, getattr(owner, name))
    known = {} if variant == "ppo" else {"novelty": {"refresh_every": 8, "write_every": 1}}
    config = run_config(environment, variant, episodes=12, **known)
    plain, profiled = Trainer(config), Trainer(config)
    assert len(list(plain.run())) == 12
    watch = breakdown.Stopwatch("bookkeeping")
    breakdown.instrument(profiled, watch)
    assert len(list(profiled.run())) == 12
    assert profiled.records == plain.records
    expected = breakdown.SECTIONS | (breakdown.BONUS if variant == "mace_full" else {})
    assert watch.stop().keys() == expected.keys()


def test_purejaxrl_s_training_imports_nothing_but_what_its_environment_has():
    script = Path(purejaxrl.__file__).with_name("purejaxrl_training.py")
    command = [sys.executable, "-I", "-S", str(script), "folder", "{}", "0"]
    said = subprocess.run(command, capture_output=True, text=True).stderr
    assert said.splitlines()[-1] == "ModuleNotFoundError: No module named 'jax'"


@pytest.mark.slow
def test_purejaxrl_trains():
    """For real: in its environment, which is made first (800 MB), two updates of its own size."""
    try:
        purejaxrl.set_up()
    except purejaxrl.LeftOut as reason:
        pytest.skip(str(reason))  # where neither GitHub nor a clone, or no index, can be reached
    given = purejaxrl.configuration("purejaxrl_4x128", CARTPOLE, 2 * 4 * 128)
    reading = purejaxrl.train(given, seed=0)
    assert reading["steps"] == 1024
    assert 0 < reading["cpu_seconds"] < 60 and reading["seconds"] > 0
    assert reading["note"].startswith("jax 0.10.2, jaxlib 0.10.2, flax ")


def test_the_page_of_measurements_is_what_they_say(tmp_path):
    """Every section of it."""
    kept = ROOT / "benchmarks"
    shutil.copy(kept / FILE, tmp_path)
    assert page.write(tmp_path).read_text() == (kept / "README.md").read_text()


def test_the_guard_s_ratios_are_of_pairs():
    now, before = Path("now"), Path("before")
    slower = {1000: 1.1, 1001: 1.3, 1002: 0.9}  # by seed, which each pair has of its own
    slower[1003] = 9.0  # of the reading that compiles

    def read(tree, seed):
        asked.append((tree, seed))
        return 10.0 * (seed - 999) * (slower[seed] if tree == now else 1.0)

    asked = []
    found = guard.compare(before, now, read, 3)
    assert asked[:4] == [(before, 1003), (now, 1003), (before, 1000), (now, 1000)]
    assert asked[4:6] == [(now, 1001), (before, 1001)]
    assert guard.row("`ppo`", found) == "| `ppo` | 20.0 | 26.0 | 1.10 (0.90 to 1.30) |"


def test_the_guard_times_the_tables_of_a_tree(tmp_path):
    """Of one whose tables cost next to nothing, and of one that has none."""
    module = tmp_path / "tools" / "tables.py"
    module.parent.mkdir()
    (tmp_path / "tools" / "tables.py").write_text(
        "sum(range(10**7)); print('2 tables and figures of')"
    )
    assert 0.05 < guard.tables(tmp_path, 0) < 60
    module.write_text("raise SystemExit('nothing is kept')")
    with pytest.raises(SystemExit, match=r"tools\.tables ended with nothing is kept"):
        guard.tables(tmp_path, 0)


@pytest.mark.slow
def test_the_guard_reads_a_training_of_a_tree():
    assert 1 < guard.microseconds("ppo", CARTPOLE, 2048, ROOT, 1000) < 10_000
