"""The same bytes whatever the process is told of threads, hashes, language and time."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mace_rl import files

STRANGE = {
    "PYTHONHASHSEED": "12345",
    "OMP_NUM_THREADS": "2",
    "OPENBLAS_NUM_THREADS": "2",
    "LC_ALL": "C",
    "LANG": "tr_TR.UTF-8",
    "TZ": "Asia/Kathmandu",
    "SOURCE_DATE_EPOCH": "1",
    "MPLBACKEND": "svg",
}

TRAIN = """
import sys
from pathlib import Path
from mace_rl.config.run import RunConfig
from mace_rl.runs.run import run

run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]))
"""


def start(*command: str, strange: bool) -> None:
    """A new process, with or without strange settings; its failure is the test's."""
    plain = {name: value for name, value in os.environ.items() if name not in STRANGE}
    environment = plain | (STRANGE if strange else {})
    subprocess.run([sys.executable, *command], env=environment, check=True)


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0"])
def test_a_training_is_the_same(run_config, tmp_path: Path, environment: str) -> None:
    config = run_config(environment, "mace_full", 0, episodes=30).model_dump_json()
    for name in ("plain", "strange"):
        start("-c", TRAIN, config, str(tmp_path / name), strange=name == "strange")
    one, other = (
        json.loads((tmp_path / n / files.RECORD).read_text()) for n in ("plain", "strange")
    )
    assert one["outputs"] == other["outputs"]


@pytest.mark.slow
def test_tables_and_figures_are_the_same() -> None:
    """As tests/test_reduced.py has them, byte for byte."""
    tests = str(Path(__file__).with_name("test_reduced.py"))
    start("-m", "pytest", "-q", tests, "-k", "table_1 or figures", strange=True)
