"""The report: one page of everything."""

from pathlib import Path

from job import job

from mace_rl.runs.provenance import read_record
from mace_study import results
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig

with job(snakemake):
    found, given, output = snakemake.input, snakemake.params, Path(snakemake.output[0]).absolute()
    settings = MetricsConfig.model_validate(given.settings)
    records = [read_record(Path(record)) for record in found.records]
    how = given.command, given.configuration, given.ppo, records
    shown = [Path(record).parent for record in found.records], given.own
    study = output.parent, given.runs, settings, parse_claims(found.claims, settings.learned)
    results.write_report(*study, given.paged, given.judged, how, shown, given.style)
