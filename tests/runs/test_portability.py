"""The same bytes whatever a process is told of threads, language, time and its processor."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from invented import CLAIMS
from numba.core.registry import cpu_target
from shared import ROOT, VARIANTS, finish, provenance_of

from mace_rl.training.records import EpisodeRecord, RunKey, as_columns
from mace_study.compare.summary import split, summary
from mace_study.config.study import read_study
from mace_study.measure.metrics_csv import metrics_table
from mace_study.show import curves
from mace_study.show.latex import table1_latex

PRODUCTS = f"{ROOT / 'tests' / 'numerics' / 'test_matmul.py'}::test_every_element_is_one_chain"
HAS_AVX512 = "+avx512f" in cpu_target.target_context.codegen().magic_tuple()[2].split(",")
STRANGE = {"PYTHONHASHSEED": "12345", "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
STRANGE |= {"LC_ALL": "C", "LANG": "tr_TR.UTF-8", "TZ": "Asia/Kathmandu"}
STRANGE |= {"SOURCE_DATE_EPOCH": "1", "MPLBACKEND": "svg"}

AVX512 = "+avx512f,+avx512vl,+avx512dq,+avx512bw,+avx512cd,+avx2,+fma,+bmi,+bmi2"
TARGETS = {  # of numba's compiler
    "haswell": "+avx2,+fma,+bmi,+bmi2,+f16c,+lzcnt,+popcnt,+movbe",
    "skylake-avx512": AVX512,
    "znver5": AVX512,
}

TRAIN = """
import sys
from pathlib import Path
from mace_rl.config.run import RunConfig
from mace_rl.runs.run import run

run(RunConfig.model_validate_json(sys.argv[1]), Path(sys.argv[2]))
"""


def start(*command: str, **told: str) -> None:
    plain = {name: value for name, value in os.environ.items() if name not in STRANGE}
    subprocess.run([sys.executable, *command], env=plain | told, check=True)


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0"])
def test_a_training_is_the_same(run_config, tmp_path: Path, environment: str) -> None:
    config = run_config(environment, "mace_full", 0, episodes=40).model_dump_json()
    told = {"plain": {}, "strange": STRANGE}
    for name, features in TARGETS.items() if environment == "CartPole-v1" else ():
        if features != AVX512 or HAS_AVX512:
            told[name] = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features}
            start("-m", "pytest", "-q", PRODUCTS, **told[name])
    for name, given in told.items():
        start("-c", TRAIN, config, str(tmp_path / name), **given)
    outputs = [provenance_of(tmp_path / name)["outputs"] for name in told]
    assert outputs == outputs[:1] * len(told)


@pytest.mark.slow
def test_tables_and_figures_are_the_same() -> None:
    tests = [f"{__file__}::{name}" for name in ("test_table_1", "test_figures")]
    start("-m", "pytest", "-q", *tests, **STRANGE)


# --- docs/reduced ---------------------------------------------------------------------------------

EXPECTED = ROOT / "docs" / "reduced"
STUDY = read_study([ROOT / "config.yaml", ROOT / "config" / "reduced.yaml"])
METRICS = STUDY.metrics.within(STUDY.variants_of)


@pytest.fixture(scope="module")
def runs() -> dict[RunKey, pd.DataFrame]:
    records = {key: finish(STUDY.run_config(*key)).records for key in STUDY.runs()}
    return {key: pd.DataFrame(as_columns(EpisodeRecord, own)) for key, own in records.items()}


@pytest.mark.slow
def test_table_1(runs):
    metrics = metrics_table(runs, METRICS)
    table, _ = split(summary(metrics, METRICS, CLAIMS.table1), CLAIMS.table1)
    assert table.to_csv(index=False).encode() == (EXPECTED / "table1.csv").read_bytes()
    latex = table1_latex(table, STUDY.labels, METRICS, CLAIMS.table1)
    assert latex.encode() == (EXPECTED / "table1.tex").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("number", ["1", "2"])
def test_figures(runs, tmp_path, number):
    shown, layout = curves.quantity(number, STUDY.metrics), STUDY.figure.model_dump()
    single = curves.seed_curves(runs, shown)
    look = curves.plot_style(METRICS, layout, STUDY.labels, STUDY.colours)
    means = curves.mean_curves(single, shown, STUDY.metrics)
    name = f"figure{number}.png"
    curves.save_figure(curves.draw_figure(means, single, shown, look), tmp_path / name)
    assert (tmp_path / name).read_bytes() == (EXPECTED / name).read_bytes()


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", STUDY.environments)
def test_the_first_episodes_do_not_depend_on_the_budget(run_config, environment, variant):
    short, long = (finish(run_config(environment, variant, 3, episodes=n)) for n in (6, 10))
    assert short.records == long.records[:6]
    assert list(map(str, short.diagnostics)) == list(map(str, long.diagnostics[:6]))  # with NaN
