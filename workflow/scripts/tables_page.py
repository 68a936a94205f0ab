"""tables.md: every table of the study on one page, for reading beside its pictures."""

from job import job

with job("the page of tables", snakemake.log[0]):
    from mace_rl.files import write_atomically
    from mace_rl.study.metrics_config import MetricsConfig
    from mace_rl.study.show.markdown import read_data, tables_page

    params = snakemake.params
    settings = MetricsConfig.model_validate(params.settings)
    data, claims = read_data(dict(snakemake.input.items()), params.runs, settings)
    origin = f"`{params.command}`: {len(params.runs)} runs."
    page = tables_page(data, claims, params.pictures, settings, origin)
    write_atomically(snakemake.output[0], page)
