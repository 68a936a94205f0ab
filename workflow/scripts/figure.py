"""A figure from its data."""

from job import job

number = snakemake.wildcards.number
with job(f"Figure {number}", snakemake.log[0]):
    import pandas as pd

    from mace_rl.config.results import FigureConfig, MetricsConfig
    from mace_rl.results.figures import draw_figure, quantity, save_figure

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    figure = draw_figure(
        *(pd.read_csv(path) for path in snakemake.input),
        quantity(number, settings),
        FigureConfig.model_validate(params.layout),
        settings.confidence,
        params.labels,
        params.colours,
    )
    for path in snakemake.output:
        save_figure(figure, path)
