"""Table 1 and its supplement, comparisons, and all environments together."""

from job import job

from mace_rl.base.files import write_atomically
from mace_study.compare.aggregate import aggregate
from mace_study.compare.claims_config import parse_claims
from mace_study.compare.comparisons import comparisons
from mace_study.compare.summary import split, summary
from mace_study.config.metrics import MetricsConfig
from mace_study.measure.metrics_csv import read_metrics
from mace_study.show.latex import table1_latex

with job(snakemake):
    given, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(given.settings)
    paper = parse_claims(snakemake.input.claims, settings.learned).table1
    runs = read_metrics(snakemake.input.metrics, given.runs, settings)
    made = {"comparisons": comparisons(runs, settings), "aggregate": aggregate(runs, settings)}
    made["table1"], made["supplement"] = split(summary(runs, settings, paper), paper)
    for name, table in made.items():
        write_atomically(output[name], table.to_csv(index=False))
    write_atomically(output.table1_tex, table1_latex(made["table1"], given.labels, settings, paper))
