"""The benchmark: what measuring must not change, and PureJaxRL for real."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import breakdown, purejaxrl
from benchmarks.measuring import CARTPOLE, HOPPER


@pytest.mark.slow
@pytest.mark.parametrize("environment", [CARTPOLE, HOPPER])
@pytest.mark.parametrize("variant", ["ppo", "mace_full"])
def test_profile_changes_nothing_and_misses_nothing(run_config, monkeypatch, environment, variant):
    from mace_rl.trainer import Trainer

    for _, module, name in breakdown.FUNCTIONS:  # put back after the test
        owner = importlib.import_module(module)
        monkeypatch.setattr(owner, name, getattr(owner, name))
    known = {} if variant == "ppo" else {"novelty": {"refresh_every": 8, "write_every": 1}}
    plain, profiled = (
        Trainer(run_config(environment, variant, episodes=12, **known)) for _ in range(2)
    )
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
