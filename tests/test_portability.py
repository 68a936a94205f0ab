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

DRAW = """
import sys
import numpy as np, pandas as pd
from mace_rl.config.results import FigureConfig, MetricsConfig
from mace_rl.config.study import read_study
from pathlib import Path
from mace_rl.results import figures

settings = read_study([Path("config.yaml")]).metrics
shown = figures.quantity("1", settings)
values = np.random.default_rng(0)
frames = {
    ("A-v1", variant, seed): pd.DataFrame(
        {"episode": np.arange(1, 121), "extrinsic_return": values.normal(size=120)}
    )
    for variant in ("ppo", "mace_full") for seed in (0, 1, 2)
}
seeds = figures.seed_curves(frames, shown)
curves = figures.mean_curves(seeds, shown, settings)
labels, colours = {"ppo": "PPO", "mace_full": "βéta"}, {"ppo": "tab:blue", "mace_full": "tab:green"}
figure = figures.draw_figure(
    curves, seeds, shown, FigureConfig(columns=1), settings.confidence, labels, colours
)
for end in ("png", "pdf"):
    figures.save_figure(figure, f"{sys.argv[1]}/figure.{end}")
"""


def start(code: str, *arguments: str, strange: bool) -> None:
    """A new process, with or without strange settings; its failure is the test's."""
    plain = {name: value for name, value in os.environ.items() if name not in STRANGE}
    subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=plain | (STRANGE if strange else {}),
        check=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0"])
def test_a_training_is_the_same(run_config, tmp_path: Path, environment: str) -> None:
    config = run_config(environment, "mace_full", 0, episodes=30).model_dump_json()
    for name in ("plain", "strange"):
        start(TRAIN, config, str(tmp_path / name), strange=name == "strange")
    one, other = (
        json.loads((tmp_path / n / files.RECORD).read_text()) for n in ("plain", "strange")
    )
    assert one["outputs"] == other["outputs"]
    assert one["arithmetic"] == other["arithmetic"]


@pytest.mark.slow
def test_a_figure_is_the_same(tmp_path: Path) -> None:
    for name in ("plain", "strange"):
        (tmp_path / name).mkdir()
        start(DRAW, str(tmp_path / name), strange=name == "strange")
    for file in ("figure.png", "figure.pdf"):
        assert (tmp_path / "plain" / file).read_bytes() == (
            tmp_path / "strange" / file
        ).read_bytes()
