"""metrics.csv: what is measured on each run."""

from job import job

with job("metrics", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.metrics import metrics_table
    from mace_rl.results.records import read_episodes

    params = snakemake.params
    runs = {
        (env, variant, seed): read_episodes(path, episodes)
        for path, (env, variant, seed, episodes) in zip(snakemake.input, params.runs, strict=True)
    }
    wanted = [tuple(run[:3]) for run in params.runs]
    table = metrics_table(runs, wanted, MetricsConfig.model_validate(params.settings))
    write_atomically(snakemake.output[0], table.to_csv(index=False))
