"""Pictures of every run: all seeds, and performance profiles."""

from job import job

with job("pictures", snakemake.log[0]):
    from pathlib import Path

    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results import pictures
    from mace_rl.results.figures import save_figure
    from mace_rl.results.metrics_table import read_metrics

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    table = read_metrics(snakemake.input[0], [tuple(run[:3]) for run in params.runs], settings)
    names = params.labels, params.colours
    curves = pictures.profiles(table, settings)
    write_atomically(snakemake.output.profiles, curves.to_csv(index=False))
    figures = {
        "every_seed": pictures.draw_every_seed(table, *names),
        "profiles": pictures.draw_profiles(curves, settings.confidence, *names),
    }
    for path in snakemake.output:
        if path != snakemake.output.profiles:
            save_figure(figures[Path(path).stem], path)
