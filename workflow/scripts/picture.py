"""A picture of all runs at once, or of the ledger, and its data."""

from job import job

from mace_rl.base.files import write_atomically
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig
from mace_study.show import curves, pictures
from mace_study.show.sections import read_data

with job(snakemake):
    given, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(given.settings)
    data = read_data(dict(snakemake.input.items()), given.runs, settings)
    paper = parse_claims(snakemake.input.claims, settings.learned)
    source = pictures.Source(*data, settings, paper)
    picture = pictures.PICTURES[snakemake.wildcards.picture]
    table = picture.data(source)
    write_atomically(output.data, table.to_csv(index=False))
    figure = picture.draw(table, curves.plot_style(settings, **given.style))
    curves.save_figure(figure, output.pdf, output.png)
