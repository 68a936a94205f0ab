"""The data of a figure: the curves of every run, and their means over seeds."""

from job import job

number = snakemake.wildcards.number
with job(f"the data of Figure {number}", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results.figures import mean_curves, quantity, seed_curves
    from mace_rl.runs.finished import read_runs

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    shown = quantity(number, settings)
    frames = read_runs(snakemake.input.records, params.runs)
    single_seeds = seed_curves(frames, shown)
    curves = mean_curves(single_seeds, shown, settings)
    write_atomically(output.single_seeds, single_seeds.to_csv(index=False))
    write_atomically(output.curves, curves.to_csv(index=False))
