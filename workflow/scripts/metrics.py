"""metrics.csv and betas.csv: what is measured on each run."""

from job import job

with job("metrics", snakemake.log[0]):
    from mace_rl.files import write_atomically
    from mace_rl.runs.finished import read_runs
    from mace_rl.study.measure.run_metrics import betas_table, metrics_table
    from mace_rl.study.metrics_config import MetricsConfig

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    runs = read_runs(snakemake.input.records, params.runs)
    for path, table in ((output.metrics, metrics_table), (output.betas, betas_table)):
        write_atomically(path, table(runs, settings).to_csv(index=False))
