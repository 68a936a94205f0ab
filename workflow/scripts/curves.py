"""The data of Figure 1: learning curves of every run, and their means over seeds."""

from job import job

with job("learning curves", snakemake.log[0]):
    from mace_rl.figures import learning_curves, seed_curves
    from mace_rl.files import write_atomically
    from mace_rl.metrics import MetricsConfig
    from mace_rl.records import read_episodes

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    frames = {
        (env, variant, seed): read_episodes(path, episodes)
        for path, (env, variant, seed, episodes) in zip(snakemake.input, params.runs, strict=True)
    }
    single_seeds = seed_curves(frames, settings.moving_average)
    curves = learning_curves(single_seeds, settings)
    write_atomically(output.single_seeds, single_seeds.to_csv(index=False))
    write_atomically(output.curves, curves.to_csv(index=False))
