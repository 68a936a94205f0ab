"""Figure 1 from its data."""

from job import job

with job("Figure 1", snakemake.log[0]):
    import pandas as pd

    from mace_rl.figures import FigureConfig, figure1, save_figure
    from mace_rl.metrics import MetricsConfig

    params = snakemake.params
    curves, single_seeds = (pd.read_csv(path) for path in snakemake.input)
    figure = figure1(
        curves,
        single_seeds,
        FigureConfig.model_validate(params.layout),
        MetricsConfig.model_validate(params.settings),
        params.labels,
        params.colours,
    )
    for path in snakemake.output:
        save_figure(figure, path)
