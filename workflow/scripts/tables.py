"""Table 1 and its supplement, comparisons, and all environments together."""

from job import job

with job("tables", snakemake.log[0]):
    from mace_rl.files import write_atomically
    from mace_rl.study.compare import summary
    from mace_rl.study.compare.aggregate import aggregate
    from mace_rl.study.compare.comparisons import comparisons
    from mace_rl.study.measure.run_metrics import read_metrics
    from mace_rl.study.metrics_config import MetricsConfig
    from mace_rl.study.show.latex import table1_latex

    params, output = snakemake.params, snakemake.output
    settings = MetricsConfig.model_validate(params.settings)
    metrics = read_metrics(snakemake.input[0], params.runs, settings)
    means = summary.summary(metrics, settings)
    made = {
        "table1": summary.table1(means),
        "supplement": summary.supplement(means),
        "comparisons": comparisons(metrics, settings),
        "aggregate": aggregate(metrics, settings),
    }
    for name, table in made.items():
        write_atomically(output[name], table.to_csv(index=False))
    write_atomically(output.table1_tex, table1_latex(made["table1"], params.labels, settings))
