"""The figures over training, with their data: each run's curve, and the means over seeds."""

from pathlib import Path

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.runs.finished import read_runs
from mace_study.config.metrics import MetricsConfig
from mace_study.show import curves

with job(snakemake):
    given, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(given.settings)
    frames = read_runs(snakemake.input.records, given.runs, given.run_settings)
    files = zip(output.curves, output.single_seeds, output.pdf, output.png, strict=True)
    for of_means, of_seeds, *pictures in files:
        number = Path(of_means).stem.removeprefix("figure")
        shown = curves.quantity(number, settings)
        seeds = curves.seed_curves(frames, shown)
        means = curves.mean_curves(seeds, shown, settings)
        write_atomically(of_seeds, seeds.to_csv(index=False))
        write_atomically(of_means, means.to_csv(index=False))
        figure = curves.draw_figure(means, seeds, shown, curves.plot_style(settings, **given.style))
        curves.save_figure(figure, *pictures)
