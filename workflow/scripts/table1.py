"""Table 1 and its supplement, as data and as LaTeX."""

from job import job

with job("Table 1", snakemake.log[0]):
    from mace_rl.config.results import MetricsConfig
    from mace_rl.files import write_atomically
    from mace_rl.results import latex, tables
    from mace_rl.results.metrics_table import read_metrics

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    metrics = read_metrics(snakemake.input[0], [tuple(run[:3]) for run in params.runs], settings)
    for name, data, fragment in (
        ("table1", tables.table1, latex.table1_latex),
        ("supplement", tables.supplement, latex.supplement_latex),
    ):
        table = data(metrics, settings)
        write_atomically(output[f"{name}_data"], table.to_csv(index=False))
        write_atomically(output[name], fragment(table, params.labels, settings))
