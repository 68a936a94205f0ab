"""The report: one page of everything."""

from pathlib import Path

from job import job

with job("the report", snakemake.log[0]):
    from mace_rl.config.agent import PPOConfig
    from mace_rl.files import write_atomically
    from mace_rl.runs.provenance import read_record
    from mace_rl.study.metrics_config import FigureConfig, MetricsConfig
    from mace_rl.study.show.animations import animations
    from mace_rl.study.show.curves import PlotStyle
    from mace_rl.study.show.markdown import read_data
    from mace_rl.study.show.report import Provenance, page

    params, records = snakemake.params, [Path(record) for record in snakemake.input.records]
    settings = MetricsConfig.model_validate(params.settings)
    found = {name: path for name, path in snakemake.input.items() if isinstance(path, str)}
    data, claims = read_data(found, params.runs, settings)
    first = {}  # of the seeds of an environment and variant
    for (env, variant, *_), record in zip(params.runs, records, strict=True):
        first.setdefault((env, variant), record.parent)
    making = Provenance(
        command=params.command,
        configuration=params.configuration,
        ppo={env: PPOConfig.model_validate(values) for env, values in params.ppo.items()},
        records=list(map(read_record, records)),
    )
    films = animations(first, params.labels, Path(snakemake.output[0]).parent, params.own)
    look = PlotStyle(FigureConfig(columns=3), settings.confidence, params.labels, params.colours)
    html = page(data, claims, making, films, settings, look)
    write_atomically(snakemake.output[0], html)
