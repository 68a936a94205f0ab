"""A figure over training, and its data: the curves of every run, and their means over seeds."""

from job import job

number = snakemake.wildcards.number
with job(f"Figure {number}", snakemake.log[0]):
    from mace_rl.files import write_atomically
    from mace_rl.runs.finished import read_runs
    from mace_rl.study.metrics_config import FigureConfig, MetricsConfig
    from mace_rl.study.show import curves as figures

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    layout = FigureConfig.model_validate(params.layout)
    shown = figures.quantity(number, settings)
    single_seeds = figures.seed_curves(read_runs(snakemake.input.records, params.runs), shown)
    curves = figures.mean_curves(single_seeds, shown, settings)
    write_atomically(output.single_seeds, single_seeds.to_csv(index=False))
    write_atomically(output.curves, curves.to_csv(index=False))
    look = figures.PlotStyle(layout, settings.confidence, params.labels, params.colours)
    figure = figures.draw_figure(curves, single_seeds, shown, look)
    for path in (output.pdf, output.png):
        figures.save_figure(figure, path)
