"""The report: one page of everything."""

from pathlib import Path

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.config.agent import PPOConfig
from mace_rl.runs.provenance import read_record
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig
from mace_study.show import animations, curves, report, sections

with job(snakemake):
    found, given, output = snakemake.input, snakemake.params, Path(snakemake.output[0]).absolute()
    settings = MetricsConfig.model_validate(given.settings)
    paper = parse_claims(found.claims, settings.learned)
    data, answers = sections.read_data(dict(found.items()), given.runs, settings)
    ppo = {env: PPOConfig.model_validate(own) for env, own in given.ppo.items()}
    records = [read_record(Path(record)) for record in found.records]
    made = report.Provenance(given.command, given.configuration, ppo, records)
    shown = {}  # by environment and variant the folder of the first seed
    for (environment, variant, *_), record in zip(given.runs, found.records, strict=True):
        shown.setdefault((environment, variant), Path(record).parent)
    films = animations.animations(shown, given.style["labels"], output.parent, given.own)
    style = curves.plot_style(settings, **given.style)
    write_atomically(output, report.page(data, answers, paper, made, films, settings, style))
