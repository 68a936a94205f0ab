"""What decides the ranking: every reading of Table 1's metrics, as data and picture."""

from job import job

with job("readings", snakemake.log[0]):
    from mace_rl.files import write_atomically
    from mace_rl.runs.finished import read_runs
    from mace_rl.study.compare.readings import draw_readings, readings
    from mace_rl.study.metrics_config import FigureConfig, MetricsConfig
    from mace_rl.study.show.curves import PlotStyle, save_figure

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    frames = read_runs(snakemake.input.records, params.runs)
    table = readings(frames, settings)
    write_atomically(output.table, table.to_csv(index=False))
    layout = FigureConfig.model_validate(params.layout)
    look = PlotStyle(layout, settings.confidence, params.labels, params.colours)
    figure = draw_readings(table, settings, look)
    for path in (output.png, output.pdf):
        save_figure(figure, path)
