"""The benchmark: what measuring must not change, PureJaxRL for real, and its page."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import breakdown, page, purejaxrl
from benchmarks.measuring import FILE, FULL, QUICK
from mace_rl.results.paper import CARTPOLE, HOPPER


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


def test_the_page_is_that_of_the_measurements(tmp_path):
    shutil.copy(FULL.folder / FILE, tmp_path)
    assert page.write(tmp_path).read_bytes() == (FULL.folder / "README.md").read_bytes()


@pytest.mark.parametrize("contestant", purejaxrl.ROLLOUTS)
def test_purejaxrl_trains_whole_rollouts_with_our_settings(run_config, contestant):
    for scale in (FULL, QUICK):
        for environment in purejaxrl.ENVIRONMENTS:
            steps = scale.steps[environment]
            given = purejaxrl.configuration(contestant, environment, steps)
            rollout = given["NUM_ENVS"] * given["NUM_STEPS"]
            assert steps % rollout == rollout % given["NUM_MINIBATCHES"] == 0
    ours = run_config(environment, "ppo").ppo
    assert (given["LR"], given["GAMMA"]) == (ours.actor_learning_rate, ours.discount)
    assert (given["UPDATE_EPOCHS"], given["CLIP_EPS"]) == (ours.epochs, ours.clip)
    assert (given["GAE_LAMBDA"], given["ENT_COEF"]) == (ours.gae_lambda, ours.entropy_coefficient)
    assert given["MAX_GRAD_NORM"] == ours.max_gradient_norm
    assert ours.hidden_units == [64, 64], "as PureJaxRL has them"


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
        if "No matching distribution" not in str(reason):  # as where no index can be reached
            raise
        pytest.skip(str(reason))
    given = purejaxrl.configuration("purejaxrl_4x128", CARTPOLE, 2 * 4 * 128)
    reading = purejaxrl.train(given, seed=0)
    assert reading["steps"] == 1024
    assert 0 < reading["cpu_seconds"] < 60 and reading["seconds"] > 0
    assert reading["note"].startswith("jax 0.10.2, jaxlib 0.10.2, flax ")
