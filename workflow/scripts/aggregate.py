"""aggregate.csv: all environments together, as scores between random and the best run."""

from job import job

with job("aggregate", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.aggregate import aggregate
    from mace_rl.results.metrics_table import read_metrics

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    metrics = read_metrics(snakemake.input[0], [tuple(run[:3]) for run in params.runs], settings)
    write_atomically(snakemake.output[0], aggregate(metrics, settings).to_csv(index=False))
