"""A picture of all runs at once, and its data."""

from job import job

name = snakemake.wildcards.picture
with job(f"the picture {name}", snakemake.log[0]):
    import json
    from pathlib import Path

    from mace_rl.files import write_atomically
    from mace_rl.study.measure.run_metrics import read_metrics
    from mace_rl.study.metrics_config import FigureConfig, MetricsConfig
    from mace_rl.study.show.curves import PlotStyle, save_figure
    from mace_rl.study.show.pictures import PICTURES

    params, output, source = snakemake.params, snakemake.output, Path(snakemake.input[0])
    settings = MetricsConfig.model_validate(params.settings)
    layout = FigureConfig.model_validate(params.layout)
    if source.suffix == ".json":
        found = json.loads(source.read_text(encoding="utf-8"))["claims"]
    else:
        found = read_metrics(source, params.runs, settings)
    table = PICTURES[name].data(found, settings)
    write_atomically(output.data, table.to_csv(index=False))
    look = PlotStyle(layout, settings.confidence, params.labels, params.colours)
    figure = PICTURES[name].draw(table, look)
    for path in (output.pdf, output.png):
        save_figure(figure, path)
