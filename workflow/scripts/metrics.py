"""metrics.csv: what is measured on each run."""

from job import job

with job("metrics", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.metrics_table import metrics_table
    from mace_rl.runs.finished import read_runs

    params = snakemake.params
    runs = read_runs(snakemake.input.records, params.runs)
    wanted = [tuple(run[:3]) for run in params.runs]
    table = metrics_table(runs, wanted, MetricsConfig.model_validate(params.settings))
    write_atomically(snakemake.output[0], table.to_csv(index=False))
