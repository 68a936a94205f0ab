"""A figure over training, and its data: the curves of every run, and their means over seeds."""

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.runs.finished import read_runs
from mace_study.config.metrics import MetricsConfig
from mace_study.show import curves

with job(snakemake):
    given, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(given.settings)
    shown = curves.quantity(snakemake.wildcards.number, settings)
    seeds = curves.seed_curves(read_runs(snakemake.input.records, given.runs), shown)
    means = curves.mean_curves(seeds, shown, settings)
    write_atomically(output.single_seeds, seeds.to_csv(index=False))
    write_atomically(output.curves, means.to_csv(index=False))
    figure = curves.draw_figure(means, seeds, shown, curves.plot_style(settings, **given.style))
    curves.save_figure(figure, output.pdf, output.png)
