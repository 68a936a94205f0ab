"""What is measured on each run, and what figures and readings show of all of them."""

from pathlib import Path

from job import job

from mace_rl.runs.finished import read_runs
from mace_study import results
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig

with job(snakemake):
    found, given, folder = snakemake.input, snakemake.params, Path(snakemake.output.metrics).parent
    settings = MetricsConfig.model_validate(given.settings)
    frames = read_runs(found.records, given.runs, given.run_settings)
    paper = parse_claims(found.claims, settings.learned) if given.read else None
    results.measure(frames, settings, folder, given.figures, paper)
