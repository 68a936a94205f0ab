"""The figures and all other pictures of the study."""

from pathlib import Path

from job import job

from mace_study import results
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig

with job(snakemake):
    given, folder = snakemake.params, Path(snakemake.input.metrics).parent
    settings = MetricsConfig.model_validate(given.settings)
    paper = parse_claims(snakemake.input.claims, settings.learned)
    results.draw(folder, given.names, given.runs, settings, paper, given.style, given.judged)
