"""The mean return of training under every constant β, beside the learned one."""

from job import job

with job("the figure of the regret", snakemake.log[0]):
    from mace_rl.config.results import FigureConfig, MetricsConfig
    from mace_rl.results.figures import save_figure
    from mace_rl.results.metrics_table import read_metrics
    from mace_rl.results.pictures import draw_regret

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    table = read_metrics(snakemake.input[0], [tuple(run[:3]) for run in params.runs], settings)
    layout = FigureConfig.model_validate(params.layout)
    how = settings.regret, layout, settings
    figure = draw_regret(table, *how, params.labels, params.colours)
    for path in snakemake.output:
        save_figure(figure, path)
