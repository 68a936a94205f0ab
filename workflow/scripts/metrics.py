"""metrics.csv and betas.csv: what is measured on each run."""

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.runs.finished import read_runs
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.betas import betas_table
from mace_study.measure.metrics_csv import metrics_table

with job(snakemake):
    given = snakemake.params
    settings = MetricsConfig.model_validate(given.settings)
    runs = read_runs(snakemake.input.records, given.runs, given.run_settings)
    for path, table in zip(snakemake.output, (metrics_table, betas_table), strict=True):
        write_atomically(path, table(runs, settings).to_csv(index=False))
