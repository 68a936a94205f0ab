"""The picture of Table 1 under every reading of its metrics, and its data."""

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.runs.finished import read_runs
from mace_study.compare.claims_config import parse_claims
from mace_study.compare.readings import readings
from mace_study.config.metrics import MetricsConfig
from mace_study.show import curves, pictures

with job(snakemake):
    found, given, output = snakemake.input, snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(given.settings)
    runs = read_runs(found.records, given.runs, given.run_settings)
    paper = parse_claims(found.claims, settings.learned)
    table = readings(runs, settings, paper.table1)
    write_atomically(output.data, table.to_csv(index=False))
    figure = pictures.draw_readings(table, curves.plot_style(settings, **given.style))
    curves.save_figure(figure, output.png, output.pdf)  # the first layout differs a little
