"""tables.md: every table of the study on one page, for reading beside its pictures."""

from job import job

from mace_rl.base.files import write_atomically
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig
from mace_study.show import markdown, sections

with job(snakemake):
    given = snakemake.params
    settings = MetricsConfig.model_validate(given.settings)
    paper = parse_claims(snakemake.input.claims, settings.learned)
    data, answers = sections.read_data(dict(snakemake.input.items()), given.runs, settings)
    shown = [*sections.of_ledger(answers, paper), *sections.of_runs(data, paper, settings, {})]
    origin = f"`{given.command}`: {len(given.runs)} runs."
    page = markdown.page("The tables of this study", origin, shown, given.pictures)
    write_atomically(snakemake.output[0], page)
