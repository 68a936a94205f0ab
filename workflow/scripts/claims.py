"""The ledger: what of the paper holds, and what of our own questions (docs/metrics.md)."""

from pathlib import Path

from job import job

from mace_rl.base.files import write_atomically
from mace_rl.runs.provenance import read_record
from mace_rl.training.records import read_table
from mace_study.compare import ledger, verdicts
from mace_study.compare.claims_config import parse_claims
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.betas import betas_columns
from mace_study.measure.metrics_csv import read_metrics
from mace_study.show import markdown, sections

with job(snakemake):
    found, given = snakemake.input, snakemake.params
    settings = MetricsConfig.model_validate(given.settings)
    paper = parse_claims(found.claims, settings.learned)
    runs = read_metrics(found.metrics, given.runs, settings)
    betas = read_table(found.betas, betas_columns(settings))
    runs = runs.merge(betas, how="left", on=["env", "variant", "seed"], validate="1:1")
    answers = verdicts.ledger(runs, settings, paper)
    hours = sum(read_record(Path(record))["seconds"] for record in found.records) / 3600
    cost = {"command": given.command, "runs": len(runs), "core_hours": hours}
    write_atomically(snakemake.output.json, ledger.to_json(cost, answers))
    origin = f"`{given.command}`: {len(runs)} runs, {hours:.1f} core-hours."
    page = markdown.page("Does it hold?", origin, sections.of_ledger(answers, paper))
    write_atomically(snakemake.output.markdown, page)
