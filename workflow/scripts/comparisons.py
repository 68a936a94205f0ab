"""comparisons.csv: is one variant better than another? And regret.csv, where it is asked for."""

from job import job

with job("comparisons", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.comparisons import comparisons, regret
    from mace_rl.results.metrics_table import read_metrics

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    metrics = read_metrics(snakemake.input[0], [tuple(run[:3]) for run in params.runs], settings)
    write_atomically(output.comparisons, comparisons(metrics, settings).to_csv(index=False))
    if settings.regret:
        write_atomically(output.regret, regret(metrics, settings).to_csv(index=False))
