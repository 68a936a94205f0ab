"""comparisons.csv: is one variant better than another?"""

from job import job

with job("comparisons", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.comparisons import comparisons
    from mace_rl.results.metrics import read_metrics

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    metrics = read_metrics(
        snakemake.input[0], params.environments, params.variants, params.seeds, settings
    )
    write_atomically(snakemake.output[0], comparisons(metrics, settings).to_csv(index=False))
