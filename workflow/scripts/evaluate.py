"""Every job but training: what is measured, compared and shown, a function for each rule.

Libraries are imported where they are used: most jobs do without most of them.
"""

from pathlib import Path

from job import job

from mace_rl.config.agent import PPOConfig
from mace_rl.files import write_atomically
from mace_rl.records import read_table
from mace_rl.runs.finished import read_runs
from mace_rl.runs.provenance import read_record
from mace_rl.study.claims_config import parse_claims
from mace_rl.study.metrics_config import FigureConfig, MetricsConfig

params, found, output = snakemake.params, snakemake.input, snakemake.output


def settings():
    return MetricsConfig.model_validate(params.settings)


def read_data():
    """The data and the ledger among the input files."""
    from mace_rl.study.show import sections

    paths = {name: path for name, path in found.items() if isinstance(path, str)}
    return sections.read_data(paths, params.runs, settings())


def plot_style():
    from mace_rl.study.measure.metrics import all_metrics
    from mace_rl.study.show.curves import PlotStyle

    layout, labels = FigureConfig.model_validate(params.layout), params.labels
    metrics = {metric.name: metric.label for metric in all_metrics(settings())}
    return PlotStyle(layout, settings().confidence, labels, params.colours, metrics)


def save(picture):
    from mace_rl.study.show.curves import save_figure

    for path in output:
        if path.endswith((".pdf", ".png")):
            save_figure(picture, path)


def metrics():
    """metrics.csv and betas.csv: what is measured on each run."""
    from mace_rl.study.measure.run_metrics import betas_table, metrics_table

    runs = read_runs(found.records, params.runs)
    for path, table in ((output.metrics, metrics_table), (output.betas, betas_table)):
        write_atomically(path, table(runs, settings()).to_csv(index=False))


def tables():
    """Table 1 and its supplement, comparisons, and all environments together."""
    from mace_rl.study.compare.aggregate import aggregate
    from mace_rl.study.compare.comparisons import comparisons
    from mace_rl.study.compare.summary import split, summary
    from mace_rl.study.measure.run_metrics import read_metrics
    from mace_rl.study.show.latex import table1_latex

    runs = read_metrics(found.metrics, params.runs, settings())
    paper = parse_claims(found.claims).table1
    table1, supplement = split(summary(runs, settings(), paper), paper)
    made = {"table1": table1, "supplement": supplement}
    made |= {"comparisons": comparisons(runs, settings()), "aggregate": aggregate(runs, settings())}
    for name, table in made.items():
        write_atomically(output[name], table.to_csv(index=False))
    write_atomically(output.table1_tex, table1_latex(table1, params.labels, settings(), paper))


def table2():
    """Table 2: the hyperparameters."""
    from mace_rl.study.show.latex import table2_latex

    write_atomically(output[0], table2_latex(ppo(), parse_claims(found.claims).table2))


def ppo():
    return {env: PPOConfig.model_validate(values) for env, values in params.ppo.items()}


def tables_page():
    """tables.md: every table of the study on one page, for reading beside its pictures."""
    from mace_rl.study.show import sections
    from mace_rl.study.show.markdown import page

    data, answers = read_data()
    paper = parse_claims(found.claims)
    shown = [*sections.of_ledger(answers, paper), *sections.of_runs(data, paper, settings(), {})]
    origin = f"`{params.command}`: {len(params.runs)} runs."
    text = page("The tables of this study", origin, shown, params.pictures)
    write_atomically(output[0], text)


def figure():
    """A figure over training, and its data: the curves of every run, and their means over seeds."""
    from mace_rl.study.show import curves

    shown = curves.quantity(snakemake.wildcards.number, settings())
    single_seeds = curves.seed_curves(read_runs(found.records, params.runs), shown)
    means = curves.mean_curves(single_seeds, shown, settings())
    write_atomically(output.single_seeds, single_seeds.to_csv(index=False))
    write_atomically(output.curves, means.to_csv(index=False))
    save(curves.draw_figure(means, single_seeds, shown, plot_style()))


def picture():
    """A picture of all runs at once, and its data."""
    from mace_rl.study.compare.ledger import read_ledger
    from mace_rl.study.compare.readings import readings
    from mace_rl.study.measure.run_metrics import read_metrics
    from mace_rl.study.show.pictures import PICTURES, Source

    paper, data, answers = parse_claims(found.claims), {}, []
    match snakemake.rule:
        case "picture":
            data["metrics"] = read_metrics(found.metrics, params.runs, settings())
        case "readings":
            frames = read_runs(found.records, params.runs)
            data["readings"] = readings(frames, settings(), paper.table1)
        case "forest":
            answers = read_ledger(found.ledger)
    made = PICTURES[snakemake.wildcards.picture]
    table = made.data(Source(data, answers, settings(), paper))
    write_atomically(output.data, table.to_csv(index=False))
    save(made.draw(table, plot_style()))


def claims():
    """The ledger: what of the paper holds, and what of our own questions (docs/protocol.md)."""
    from mace_rl.study.compare.ledger import to_json
    from mace_rl.study.compare.verdicts import ledger
    from mace_rl.study.measure.run_metrics import betas_columns, read_metrics
    from mace_rl.study.show.markdown import page
    from mace_rl.study.show.sections import of_ledger

    paper = parse_claims(found.claims)
    table = read_metrics(found.metrics, params.runs, settings())
    betas = read_table(found.betas, betas_columns(settings()))
    table = table.merge(betas, how="left", validate="1:1")
    answers = ledger(table, settings(), paper)
    hours = sum(read_record(Path(path))["seconds"] for path in found.records) / 3600
    cost = {"command": params.command, "runs": len(table), "core_hours": hours}
    write_atomically(output.json, to_json(cost, answers))
    origin = f"`{params.command}`: {len(table)} runs, {hours:.1f} core-hours."
    write_atomically(output.markdown, page("Does it hold?", origin, of_ledger(answers, paper)))


def report():
    """The report: one page of everything."""
    from mace_rl.study.show.animations import animations
    from mace_rl.study.show.report import Provenance, page

    data, answers = read_data()
    records = [Path(record) for record in found.records]
    first = {}  # of the seeds of an environment and variant
    for (env, variant, *_), record in zip(params.runs, records, strict=True):
        first.setdefault((env, variant), record.parent)
    read = list(map(read_record, records))
    made = Provenance(params.command, params.configuration, ppo(), read)
    films = animations(first, params.labels, Path(output[0]).parent, params.own)
    paper = parse_claims(found.claims)
    html = page(data, answers, paper, made, films, settings(), plot_style())
    write_atomically(output[0], html)


JOBS = {
    "metrics": metrics,
    "tables": tables,
    "table2": table2,
    "tables_page": tables_page,
    "figure": figure,
    "picture": picture,
    "readings": picture,
    "forest": picture,
    "claims": claims,
    "page": report,
}
with job(" ".join([snakemake.rule, *snakemake.wildcards]), snakemake.log[0]):
    JOBS[snakemake.rule]()
