"""Slurm's profile, and what is asked of its queue. `make slurm-test` starts a cluster."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from snakemake.cli import parse_args

from mace_rl.runs import queueing

ROOT = Path(__file__).parents[1]
PROFILE = ROOT / "profiles" / "slurm" / "config.yaml"


def test_snakemake_knows_every_key_of_the_profile() -> None:
    _, arguments = parse_args(["--workflow-profile", str(PROFILE), "all"])
    assert arguments.executor == "slurm"
    assert arguments.retries == 3 and arguments.cores == 1 and arguments.slurm_requeue
    sizes = arguments.group_components
    assert sizes == {f"runs_{size}": size for size in sizes.values()}


def test_the_profile_has_all_of_the_default_one() -> None:
    default = yaml.safe_load((ROOT / "profiles" / "default" / "config.yaml").read_text())
    slurm = yaml.safe_load(PROFILE.read_text())
    # What is computed is of one machine: as many jobs as it has cores.
    wanted = {key: value for key, value in default.items() if not key.startswith(("__", "?"))}
    assert "rerun-triggers" in wanted
    assert {key: slurm.get(key) for key in wanted} == wanted


def test_minutes_grow_with_the_work(run_config) -> None:
    compiled, other = run_config("CartPole-v1"), run_config("HopperBulletEnv-v0")
    assert queueing.minutes(compiled, 0.0) == 2
    assert queueing.minutes(compiled, 30_000 * 60 * 5) == 7
    assert queueing.minutes(other, 3_000 * 60 * 5) == 7
    assert queueing.minutes(run_config("CartPole-v1", engine="torch"), 300 * 60 * 5) == 7


@pytest.mark.parametrize(
    ("minutes", "expected"), [(1, "b"), (12, "b"), (13, "a"), (60, "a"), (61, None), (9999, None)]
)
def test_an_entry_holds_as_many_runs_as_two_hours_do(minutes: int, expected: str | None) -> None:
    assert queueing.entry(minutes, {"a": 2, "b": 10}) == expected
    assert queueing.entry(minutes, {}) is None


@pytest.mark.slow
def test_a_thousand_short_runs_are_some_dozen_entries() -> None:
    command = [sys.executable, "-m", "snakemake", "-n", "all", "--workflow-profile", str(PROFILE)]
    command += ["--config", "environments=[CartPole-v1]", f"seeds={[*range(334)]}".replace(" ", "")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    runs = re.findall(r"^ +rule train:$", done.stdout + done.stderr, re.MULTILINE)
    entries = re.findall(r"Group job runs_(\d+) ", done.stdout + done.stderr)
    # 334 runs of PPO, 40 to an entry, and 668 with a bonus, 20 to an entry.
    assert len(runs) == 1002
    assert sorted(entries) == ["20"] * 34 + ["40"] * 9
