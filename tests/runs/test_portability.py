"""The same bytes whatever a process is told of threads, language, time and its processor."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from numba.core.registry import cpu_target
from shared import ROOT, TRAIN, VARIANTS, finish, provenance_of

from mace_rl.training.records import EpisodeRecord, as_columns
from mace_study import results
from mace_study.config.study import read_study
from mace_study.plan import FIGURES, Plan

PRODUCTS = f"{ROOT / 'tests' / 'numerics' / 'test_matmul.py'}::test_every_element_is_one_chain"
_, CPU, FEATURES = cpu_target.target_context.codegen().magic_tuple()  # of this processor
STRANGE = {"PYTHONHASHSEED": "12345", "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
STRANGE |= {"LC_ALL": "C", "LANG": "tr_TR.UTF-8", "TZ": "Asia/Kathmandu"}
STRANGE |= {"SOURCE_DATE_EPOCH": "1", "MPLBACKEND": "svg"}

AVX512 = "+avx512f,+avx512vl,+avx512dq,+avx512bw,+avx512cd,+avx2,+fma,+bmi,+bmi2"
TARGETS = {  # of numba's compiler
    "haswell": "+avx2,+fma,+bmi,+bmi2,+f16c,+lzcnt,+popcnt,+movbe",
    "skylake-avx512": AVX512,
    "znver5": AVX512,
}


def start(*command: str, **told: str) -> None:
    plain = {name: value for name, value in os.environ.items() if name not in STRANGE}
    subprocess.run([sys.executable, *command], env=plain | told, check=True)


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["CartPole-v1", "HopperBulletEnv-v0"])
def test_a_training_is_the_same(run_config, tmp_path: Path, environment: str) -> None:
    config = run_config(environment, "mace_full", 0, episodes=40).model_dump_json()
    told = {"plain": {}, "strange": STRANGE}
    for name, features in TARGETS.items() if environment == "CartPole-v1" else ():
        # With AVX-512 this processor is itself one of the two makers'.
        other = CPU.startswith("znver") != name.startswith("znver")
        if features != AVX512 or (other and "+avx512f" in FEATURES.split(",")):
            told[name] = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features}
    for name, given in told.items():
        products = f"import pytest\nassert not pytest.main(['-q', {PRODUCTS!r}])\n"
        code = TRAIN + products * (name in TARGETS)
        start("-c", code, config, str(tmp_path / name), **given)
    outputs = [provenance_of(tmp_path / name)["outputs"] for name in told]
    assert outputs == outputs[:1] * len(told)


# --- docs/reduced ---------------------------------------------------------------------------------

EXPECTED = ROOT / "docs" / "reduced"
STUDY = read_study([ROOT / "config.yaml", ROOT / "config" / "reduced.yaml"])


def tabulate_and_draw(frames: Path, folder: Path) -> None:
    """What the workflow makes of the reduced study; frames: a pickle of its records."""
    folder.mkdir()
    plan = Plan(STUDY, ROOT)
    study = plan.with_episodes, plan.measured, plan.paper
    results.measure(pd.read_pickle(frames), plan.measured, folder, FIGURES, None)
    results.tabulate(folder, *study, STUDY.labels)
    results.draw(folder, FIGURES, *study, plan.style, judged=False, kinds=["png"])


@pytest.mark.slow
def test_the_reduced_study_gives_what_the_pages_have(tmp_path: Path) -> None:
    """Tables and figures also of a process that is told strange things."""
    records = {run: finish(STUDY.run_config(*run)).records for run in STUDY.runs()}
    frames = {run: pd.DataFrame(as_columns(EpisodeRecord, own)) for run, own in records.items()}
    pd.to_pickle(frames, tmp_path / "frames")
    tabulate_and_draw(tmp_path / "frames", tmp_path / "here")
    code = f"import sys; sys.path[:0] = {sys.path!r}; import mace_rl.base.cpu_features, pathlib\n"
    code += "from test_portability import tabulate_and_draw\n"
    code += "tabulate_and_draw(*map(pathlib.Path, sys.argv[1:]))\n"
    start("-c", code, str(tmp_path / "frames"), str(tmp_path / "strange"), **STRANGE)
    pairs = [(made, page) for made in ("here", "strange") for page in EXPECTED.iterdir()]
    different = [
        (made, page.name)
        for made, page in pairs
        if page.read_bytes() != (tmp_path / made / page.name).read_bytes()
    ]
    assert not different


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("environment", STUDY.environments)
def test_the_first_episodes_do_not_depend_on_the_budget(run_config, environment, variant):
    short, long = (finish(run_config(environment, variant, 3, episodes=n)) for n in (6, 10))
    assert short.records == long.records[:6]
    assert list(map(str, short.diagnostics)) == list(map(str, long.diagnostics[:6]))  # with NaN
