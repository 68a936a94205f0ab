"""Every table of the study, its ledger, and the page of them."""

from pathlib import Path

from job import job

from mace_rl.runs.provenance import read_record
from mace_study import results
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig

with job(snakemake):
    found, given, folder = snakemake.input, snakemake.params, Path(snakemake.output.page).parent
    settings = MetricsConfig.model_validate(given.settings)
    paper, study = parse_claims(found.claims, settings.learned), (folder, given.runs, settings)
    results.tabulate(*study, paper, given.labels)
    if given.ppo:
        results.write_table2(folder, given.ppo, paper)
    if given.judged:
        seconds = sum(read_record(Path(record))["seconds"] for record in found.records)
        results.judge(*study, paper, given.command, seconds)
    results.write_page(*study, paper, given.tabulated, given.pictures, given.command, given.judged)
